"""The small latent diffusion model that ships with the package, and how it is trained.

objects -> views (shapes, views) -> pictures -> autoencoder, denoiser, descriptors (training) -> weights
"""
