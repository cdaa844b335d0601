"""crops -> feature maps of BK-SDM, Stable Diffusion with fewer blocks (Kim et al., ECCV 2024)."""

from __future__ import annotations

from typing import ClassVar

from pipeline.backbones.stable_diffusion.pretrained import PretrainedDiffusion
from pipeline.spec import spec


@spec
class BkSdm(PretrainedDiffusion):
    """BK-SDM: Stable Diffusion without some of its blocks, distilled from it.

    Layers are numbered by their position in this decoder, not by the blocks of Stable Diffusion that they stand for:
    an up block has 2 resnets instead of 3. Base and Small have 8 layers, Tiny has 6.
    """

    kind: ClassVar[str] = "extract.bk_sdm"
    version: ClassVar[int] = 1

    weights: str = "nota-ai/bk-sdm-small"
