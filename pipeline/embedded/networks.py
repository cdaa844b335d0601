"""Architecture of the embedded model: configurations of U-Net and VAE, descriptor head, latents."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from pipeline.backbones.stable_diffusion.decoder import Hook, map_shape, read_decoder_maps
from pipeline.backbones.stable_diffusion.features import encode_latent, to_network_image
from pipeline.backbones.stable_diffusion.loading import build_untrained
from pipeline.embedded.plan import TrainingFolder
from pipeline.functional.aggregation import Aggregation
from pipeline.stages.extract.embedded import PROMPT

LAYERS, MATCH_LAYER, DIM, TIMESTEP = (2, 5, 8, 11), 8, 64, 50
IMAGE_PX = 128
HOOK: Hook = "pre"
UNET: dict[str, Any] = {
    "sample_size": 32,
    "in_channels": 8,
    "out_channels": 8,
    "block_out_channels": (32, 64, 96, 96),
    "layers_per_block": 2,
    "cross_attention_dim": PROMPT[-1],
    "attention_head_dim": (1, 2, 3, 3),
    "norm_num_groups": 8,
    "down_block_types": ("DownBlock2D", "DownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
    "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D", "UpBlock2D"),
}
VAE: dict[str, Any] = {
    "block_out_channels": (16, 32, 32),
    "layers_per_block": 1,
    "norm_num_groups": 8,
    "latent_channels": 8,
    "scaling_factor": 1.0,
    "down_block_types": ("DownEncoderBlock2D",) * 3,
    "up_block_types": ("UpDecoderBlock2D",) * 3,
}


def build_unet() -> Any:
    """A U-Net with random weights."""
    return build_untrained(UNET, VAE)[0]


def build_vae() -> Any:
    """A VAE with random weights."""
    return build_untrained(UNET, VAE)[1]


class DescriptorNetwork(nn.Module):
    """A U-Net, the head that aggregates its maps, and the logarithmic scales of the losses' cosines."""

    def __init__(self, unet: nn.Module) -> None:
        super().__init__()
        self.unet = unet
        self.head = Aggregation({k: map_shape(UNET, layer=k, hook=HOOK, latent_size=32)[0] for k in LAYERS}, DIM)
        self.log_scale = nn.Parameter(torch.tensor([15.0, 20.0, 20.0]).log())

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Descriptors, and the map of the layer that templates are matched by."""
        with mixed_precision(latent.device):
            text = zero_prompt(1, latent.device)
            maps = read_decoder_maps(self.unet, latent, TIMESTEP, text, layers=LAYERS, hook=HOOK)
            maps = {k: m.float() for k, m in maps.items()}
            return self.head(maps), maps[MATCH_LAYER]


class LatentEncoder:
    """Pictures -> latents of unit variance, by the trained autoencoder."""

    def __init__(self, folder: TrainingFolder, device: torch.device) -> None:
        saved = folder.load_checkpoint("autoencoder", device)
        self.vae = build_vae().to(device, memory_format=torch.channels_last)
        self.vae.load_state_dict(saved["average"])
        self.vae.eval().requires_grad_(False)
        self.config = VAE | {"scaling_factor": saved["scaling_factor"]}

    @torch.no_grad()
    def __call__(self, rgb: Tensor) -> Tensor:
        """Latents without noise."""
        with mixed_precision(rgb.device):
            latent = encode_latent(self.vae, self.config, to_network_image(rgb, size=IMAGE_PX))
        return latent.float().contiguous(memory_format=torch.channels_last)


def zero_prompt(count: int, device: torch.device) -> Tensor:
    """The prompt embedding: the model is trained without text."""
    return torch.zeros(PROMPT, device=device).expand(count, -1, -1)


def mixed_precision(device: torch.device) -> torch.autocast:
    """Autocast to bfloat16."""
    return torch.autocast(device.type, dtype=torch.bfloat16)
