"""crops -> feature maps of CleanDIFT: Stable Diffusion trained to give its features without noise.

Stracke et al., CVPR 2025 (CleanDIFT: Diffusion Features without Noise).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar, Literal

from pipeline.backbones.stable_diffusion.other_unet import OtherUnet, find_unet
from pipeline.backbones.stable_diffusion.pretrained import PretrainedDiffusion
from pipeline.backbones.stable_diffusion.source import open_weights
from pipeline.backbones.stable_diffusion.weights import Weights
from pipeline.spec import NonNegative, spec

_FIELD = "extract.unet"


@spec
class CleanDift(PretrainedDiffusion):
    """CleanDIFT's U-Net with the VAE and text encoder of the Stable Diffusion that it was trained from.

    ``weights``: that Stable Diffusion, as in ``StableDiffusion``. ``unet``: a hub id or a folder with the published
    files, of which the one for ``weights`` is taken, or one such file; the recipe holds the digest of its tensors.
    ``timestep``: the network was trained with one for all images, which its file does not hold.
    """

    kind: ClassVar[str] = "extract.cleandift"
    version: ClassVar[int] = 1

    weights: str = "stable-diffusion-v1-5/stable-diffusion-v1-5"
    unet: str = "CompVis/cleandift"
    timestep: NonNegative = 261
    noise: Literal["none"] = "none"

    @cached_property
    def source(self) -> Weights:
        """As PretrainedDiffusion.source, with CleanDIFT's U-Net."""
        base = open_weights(self.weights, self.revision)
        is_sd2 = base.read_config("unet").get("use_linear_projection", False)
        file = f"cleandift_{'sd21' if is_sd2 else 'sd15'}_unet.safetensors"
        return OtherUnet(base, find_unet(self.unet, file, field=_FIELD, name=self.name))

    def recipe(self) -> dict[str, Any]:
        """As PretrainedDiffusion.recipe; its digest includes the U-Net's tensors."""
        return {name: value for name, value in super().recipe().items() if name != "unet"}
