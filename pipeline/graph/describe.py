"""image, mask -> query of the online route, computed now and not stored."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from pipeline.graph.context import Context
from pipeline.items.features import CropFeatures
from pipeline.items.online import Query
from pipeline.items.views import Crops, Image


def describe_mask(
    context: Context, photo: Image, mask: Bool[np.ndarray, "H W"] | None, bbox_xyxy: tuple[float, float, float, float]
) -> Query:
    """An object in an image, cropped and described now, not stored. Raises NoPose where it cannot be cropped."""
    stages = context.stages
    area = None if mask is None else stages.crop.clean_query(mask)
    crop = stages.crop(photo.rgb, area, bbox_xyxy, photo.K)
    maps = context.maps(Crops(crop.rgb[None], crop.mask[None], crop.A_crop_img[None]), stages.layers)
    features = {layer: context.tensor(values[0]) for layer, values in maps.items()}
    return Query(CropFeatures(features, context.tensor(crop.mask)), crop.A_crop_img, photo.K, rgb=crop.rgb)
