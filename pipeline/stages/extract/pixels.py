"""crops -> their own pixels, downsampled: a baseline that any learned features should beat."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from torch.nn.functional import interpolate, pixel_unshuffle

from pipeline.backbones.batching import Footprint, Passes, maps_bytes
from pipeline.backbones.extractor import Extractor
from pipeline.backbones.grid import CELLS, count_cells
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Positive, Runtime, spec

_CROP_PX = 256  # a batch is sized for crops of this side
_CPU_PASS = 4  # crops; the bytes do not depend on it


@spec
class Pixels(Extractor):
    """The ``side`` x ``side`` colours of each cell, in [-1, 1], neither learned nor invariant to anything."""

    kind: ClassVar[str] = "extract.pixels"
    version: ClassVar[int] = 1
    model: ClassVar[str] = "pixels"

    side: Positive = 2

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w). Raises BadInput for a layer other than 2, 5, 8, 11."""
        return 3 * self.side**2, count_cells(layer), count_cells(layer)

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint:
        """As Extractor.footprint: the colours and the maps."""
        maps = maps_bytes([self.feature_shape(layer) for layer in layers])
        return Footprint(0, 0, 24 * crop_size**2 + maps, max_batch=64, cpu_pass=_CPU_PASS)  # float32 colours, twice

    def load(self, runtime: Runtime) -> PixelsBackbone:
        """The spec on the runtime's device; there are no weights."""
        return PixelsBackbone(self, runtime)


class PixelsBackbone:
    """A Pixels spec on a device."""

    def __init__(self, spec: Pixels, runtime: Runtime) -> None:
        self.spec, self.device = spec, torch.device(runtime.torch_device())
        footprint = spec.footprint(tuple(CELLS), _CROP_PX)
        self.passes = Passes.choose(footprint, runtime, self.device)

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32; each colour is an average over its part of the cell."""
        run_pass = partial(self._run_pass, layers=layers)
        return self.passes.run(run_pass, crops, layers)

    def _run_pass(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        rgb = torch.from_numpy(np.ascontiguousarray(crops.rgb)).to(self.device)
        image, side = rgb.permute(0, 3, 1, 2).float() / 127.5 - 1, self.spec.side
        return {layer: pixel_unshuffle(_resize(image, side * count_cells(layer)), side) for layer in layers}


def _resize(image: torch.Tensor, size: int) -> torch.Tensor:
    shrinks = size < image.shape[-1]
    return interpolate(image, (size, size), mode="bilinear", align_corners=False, antialias=shrinks)
