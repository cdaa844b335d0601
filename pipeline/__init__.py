"""Zero-shot 6DoF object poses from diffusion features."""

__version__ = "0.1.0"
