"""crops -> feature maps by layer. One file per variant; their contract and shared code are in pipeline/backbones."""

from pipeline.backbones.extractor import Backbone, Extractor

__all__ = ["Backbone", "Extractor"]
