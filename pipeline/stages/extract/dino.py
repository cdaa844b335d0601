"""crops -> feature maps of DINO's vision transformers (Caron et al., ICCV 2021)."""

from __future__ import annotations

from typing import ClassVar

from pipeline.backbones.vit.features import VitFeatures
from pipeline.spec import NonNegative, spec


@spec
class Dino(VitFeatures):
    """DINO ViT-S/8 or ViT-B/8 (12 blocks; S/16 and B/16 as well); keys, which Amir et al., ECCVW 2022 found best.

    ZS6D (Ausserlechner et al., ICRA 2024) reads keys at stride 4, layer 11 for templates, layer 9 in bins for
    correspondences, and the saliency of Amir et al.'s four heads.
    """

    kind: ClassVar[str] = "extract.dino"
    version: ClassVar[int] = 1
    model_types: ClassVar[tuple[str, ...]] = ("vit",)

    weights: str = "facebook/dino-vits8"
    saliency_heads: tuple[NonNegative, ...] | None = (0, 2, 4, 5)
