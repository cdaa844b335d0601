"""crops -> feature maps of DINOv3's vision transformers (Simeoni et al., 2025)."""

from __future__ import annotations

from typing import ClassVar

from pipeline.backbones.vit.features import VitFeatures
from pipeline.backbones.vit.transformer import Facet
from pipeline.spec import Dtype, Positive, spec


@spec
class DinoV3(VitFeatures):
    """DINOv3 ViT of patch 16 (S, S+, B: 12 blocks, L: 24, H+: 32, 7B: 40); register tokens are dropped from the maps.

    Needs transformers 4.56. Positions are rotations of queries and keys inside the attention (RoPE); the facets "query"
    and "key" are without them. Their frequencies stay float32 in every dtype.
    """

    kind: ClassVar[str] = "extract.dinov3"
    version: ClassVar[int] = 1
    model_types: ClassVar[tuple[str, ...]] = ("dinov3_vit",)

    weights: str = "facebook/dinov3-vitl16-pretrain-lvd1689m"
    facet: Facet = "token"
    input_size: Positive = 512
    norm_last: bool = True
    dtype: Dtype = "bfloat16"
