"""crops -> histograms of oriented gradients: a baseline without weights (Dalal and Triggs, CVPR 2005)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.backbones.batching import Footprint, Passes, maps_bytes
from pipeline.backbones.extractor import Extractor
from pipeline.backbones.grid import CELLS, count_cells
from pipeline.functional.gradients import append_neighbours, cell_means, oriented_energy, smooth_histograms
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Fraction, NonNegative, Positive, PositiveFloat, Runtime, spec

_CROP_PX = 256  # a batch is sized for crops of this side
_CPU_PASS = 4  # crops; the bytes do not depend on it


@spec
class Hog(Extractor):
    """Gradient histograms of each cell and its 8 neighbours, normalised by local energy.

    ``signed``: edges from dark to bright and from bright to dark fall into different bins. ``context_cells``: distance
    of the neighbours. ``silhouette``: weight of gradients at the mask's border, where the background was blackened.
    ``contrast``: gradients below this many grey levels (0..1) per pixel count as noise.
    """

    kind: ClassVar[str] = "extract.hog"
    version: ClassVar[int] = 1
    model: ClassVar[str] = "hog"

    orientations: Positive = 8
    signed: bool = True
    context_cells: NonNegative = 1
    silhouette: Fraction = 1.0
    contrast: PositiveFloat = 0.02

    @property
    def channels(self) -> int:
        """Length of a cell's descriptor."""
        return self.orientations * (9 if self.context_cells else 1)

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w). Raises BadInput for a layer other than 2, 5, 8, 11."""
        return self.channels, count_cells(layer), count_cells(layer)

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint:
        """As Extractor.footprint: gradients of three channels, energies by orientation, and maps with their context."""
        maps = 2 * maps_bytes([self.feature_shape(layer) for layer in layers])
        return Footprint(0, 0, 4 * (28 + 3 * self.orientations) * crop_size**2 + maps, max_batch=32, cpu_pass=_CPU_PASS)

    def load(self, runtime: Runtime) -> HogBackbone:
        """The spec on the runtime's device; there are no weights."""
        return HogBackbone(self, runtime)


class HogBackbone:
    """A Hog spec on a device."""

    def __init__(self, spec: Hog, runtime: Runtime) -> None:
        self.spec, self.device = spec, torch.device(runtime.torch_device())
        footprint = spec.footprint(tuple(CELLS), _CROP_PX)
        self.passes = Passes.choose(footprint, runtime, self.device)

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32."""
        run_pass = partial(self._run_pass, cells={layer: count_cells(layer) for layer in layers})
        return self.passes.run(run_pass, crops, layers)

    @torch.no_grad()
    def _run_pass(self, crops: Crops, cells: Mapping[int, int]) -> FeatureMaps:
        rgb, mask = (torch.from_numpy(np.ascontiguousarray(x)).to(self.device) for x in (crops.rgb, crops.mask))
        s = self.spec
        energy = oriented_energy(rgb, mask, orientations=s.orientations, signed=s.signed, silhouette=s.silhouette)
        # always through the finest cells, so that a layer has the same bytes whichever other layers are requested
        finest = cell_means(energy, cells=max(CELLS.values()))
        return {k: self._compute_map(cell_means(finest, cells=n)) for k, n in cells.items()}

    def _compute_map(self, histograms: Float[Tensor, "n o h w"]) -> Float[Tensor, "n c h w"]:
        return append_neighbours(
            smooth_histograms(histograms), distance=self.spec.context_cells, contrast=self.spec.contrast
        )
