"""One object's stored templates as the online route reads them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float

from pipeline.functional.masks import cell_mask
from pipeline.functional.similarity import cell_norms, map_norms
from pipeline.items.features import FittedArrays
from pipeline.items.fit import Fit
from pipeline.items.online import TemplateView

Pose = Float[np.ndarray, "4 4"]
Matrix = Float[np.ndarray, "3 3"]


@dataclass(eq=False)
class StoredBank:
    """One object's templates as input of the online route. Views are read one by one; the last few stay in memory."""

    layer: int
    maps: Callable[[int], torch.Tensor]
    masks: Callable[[], torch.Tensor]
    view: Callable[[int], TemplateView]
    render: Callable[[Pose, Matrix, Matrix], TemplateView]
    poses: Callable[[], np.ndarray]
    fitted: Callable[[Fit], FittedArrays]

    @cached_property
    def features(self) -> torch.Tensor:
        """Maps of the match layer, float16: an object's largest array, read on first use."""
        return self.maps(self.layer)

    @cached_property
    def norms(self) -> torch.Tensor:
        """L2 norms of the flattened maps, float32; computed on first use."""
        return map_norms(self.features)

    @cached_property
    def cell_norms(self) -> torch.Tensor:
        """L2 norms of the cells, float32; computed on first use."""
        return cell_norms(self.features)

    @cached_property
    def cell_mask(self) -> torch.Tensor:
        """Foreground cells; computed on first use."""
        return cell_mask(self.mask, cells=self.features.shape[-1])

    @cached_property
    def mask(self) -> torch.Tensor:
        """Crop masks of all templates; read on first use."""
        return self.masks()

    @cached_property
    def T_cam_obj(self) -> np.ndarray:
        """Poses of all templates; read on first use."""
        return self.poses()
