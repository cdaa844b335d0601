"""crops -> feature maps of Stable Diffusion's decoder (Rombach et al., CVPR 2022)."""

from __future__ import annotations

from typing import ClassVar

from pipeline.backbones.stable_diffusion.pretrained import PretrainedDiffusion
from pipeline.spec import spec


@spec
class StableDiffusion(PretrainedDiffusion):
    """Stable Diffusion 1.x or 2.x; the paper reads layers 2, 5, 8 and 11 at timestep 50."""

    kind: ClassVar[str] = "extract.stable_diffusion"
    version: ClassVar[int] = 2

    weights: str = "stable-diffusion-v1-5/stable-diffusion-v1-5"
