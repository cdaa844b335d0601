"""Stable Diffusion: features of its U-Net's decoder, its noise, and its weights in every published format."""
