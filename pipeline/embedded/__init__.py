"""The small latent diffusion model that ships with the package, and its training.

seed -> objects (shapes) -> views (views) -> pictures (surfaces, pictures) -> batches (batches)
batches -> autoencoder, denoiser, descriptors (networks, losses, training_stages, training) -> weights (export)
"""
