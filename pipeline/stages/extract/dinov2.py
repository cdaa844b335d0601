"""crops -> feature maps of DINOv2's vision transformers, with registers or without.

Oquab et al., TMLR 2024 (DINOv2); Darcet et al., ICLR 2024 (Vision Transformers Need Registers).
"""

from __future__ import annotations

from typing import ClassVar

from pipeline.backbones.vit.features import VitFeatures
from pipeline.backbones.vit.transformer import Facet
from pipeline.spec import Positive, spec


@spec
class DinoV2(VitFeatures):
    """DINOv2 ViT-S, B, L or g of patch 14 (12, 12, 24 or 40 blocks); register tokens are dropped from the maps.

    FoundPose (Ornek et al., ECCV 2024) reads the tokens of layer 18 of ViT-L with registers at 420 px, after the last
    norm.
    """

    kind: ClassVar[str] = "extract.dinov2"
    version: ClassVar[int] = 1
    model_types: ClassVar[tuple[str, ...]] = ("dinov2", "dinov2_with_registers")

    weights: str = "facebook/dinov2-with-registers-large"
    facet: Facet = "token"
    input_size: Positive = 420
    norm_last: bool = True
