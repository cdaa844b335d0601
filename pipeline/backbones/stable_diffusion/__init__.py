"""Stable Diffusion: its U-Net decoder's features, the noise it is given, and every form its weights come in."""
