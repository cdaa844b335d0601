"""crops, geometry -> object coordinates as features: an oracle that leaves only the errors of the geometry stages."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from pydantic import Field

from pipeline.backbones.batching import Footprint, Passes, maps_bytes
from pipeline.backbones.extractor import Extractor
from pipeline.backbones.grid import CELLS, count_cells
from pipeline.errors import BadInput
from pipeline.functional import camera, rigid
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import NonNegative, PositiveFloat, Runtime, spec

FINEST = max(CELLS.values())
_CPU_PASS = 4  # crops; the bytes do not depend on it


@spec
class Coordinates(Extractor):
    """Random Fourier features of the object point at each cell's centre; background cells are zero.

    The cosine of two cells d mm apart on the object is exp(-d^2 / (2 bandwidth_mm^2)) in expectation over the
    frequencies (Rahimi and Recht, NeurIPS 2007), with a standard error of at most channels^(-1/2).
    All layers have the finest layer's cells, because interpolating coarse maps would add errors of their own. Each
    layer draws its own frequencies.
    """

    kind: ClassVar[str] = "extract.coordinates"
    version: ClassVar[int] = 1
    needs_geometry: ClassVar[bool] = True
    notice: ClassVar[str] = "oracle: features are the true object coordinates; the figures show geometry errors alone"
    model: ClassVar[str] = "coordinates"

    bandwidth_mm: PositiveFloat = 10.0
    channels: Annotated[int, Field(ge=2, multiple_of=2)] = 64
    seed: NonNegative = 0

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w). Raises BadInput for a layer other than 2, 5, 8, 11."""
        count_cells(layer)
        return self.channels, FINEST, FINEST

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint:
        """As Extractor.footprint: the float64 points of a map's cells, and the maps."""
        maps = 2 * maps_bytes([self.feature_shape(layer) for layer in layers])
        return Footprint(0, 0, 8 * FINEST**2 * (12 + 2 * self.channels) + maps, max_batch=64, cpu_pass=_CPU_PASS)

    def load(self, runtime: Runtime) -> CoordinatesBackbone:
        """The spec on the runtime's device; there are no weights."""
        return CoordinatesBackbone(self, runtime)


class CoordinatesBackbone:
    """A Coordinates spec on a device."""

    def __init__(self, spec: Coordinates, runtime: Runtime) -> None:
        self.device = torch.device(runtime.torch_device())
        footprint = spec.footprint(tuple(CELLS), 0)
        self.passes = Passes.choose(footprint, runtime, self.device)
        self.spec = spec

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32. Raises BadInput for crops without geometry."""
        run_pass = partial(self._run_pass, layers=layers)
        return self.passes.run(run_pass, crops, layers)

    def _run_pass(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        views = [cell_points(crops, i, cells=FINEST) for i in range(len(crops))]
        return {layer: torch.from_numpy(self._compute_maps(views, layer)).to(self.device) for layer in layers}

    def _compute_maps(
        self, views: Sequence[tuple[Float[np.ndarray, "hw 3"], Bool[np.ndarray, " hw"]]], layer: int
    ) -> Float32[np.ndarray, "n c h w"]:
        draws = np.random.default_rng([self.spec.seed, layer]).standard_normal((3, self.spec.channels // 2))
        frequencies = draws / self.spec.bandwidth_mm
        features = np.stack([fourier_features(xyz, frequencies) * seen[:, None] for xyz, seen in views])
        return features.reshape(len(views), FINEST, FINEST, -1).transpose(0, 3, 1, 2).astype(np.float32)


def cell_points(crops: Crops, i: int, *, cells: int) -> tuple[Float[np.ndarray, "hw 3"], Bool[np.ndarray, " hw"]]:
    """Object points (mm) at the cell centres of crop i, in row-major order, and which cells lie on the object.

    Each point lies on the ray through the exact centre, at the depth of the nearest pixel, as in ``lift``.
    """
    if crops.geometry is None:
        needed = "depth, camera and pose of every view, which templates and ground truth have"
        raise BadInput("extract=coordinates", found="crops without geometry", needed=needed)
    depth_mm, size = crops.geometry.depth_mm[i], crops.mask.shape[-1]
    grid = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 2)
    px_crop = camera.cell_to_px(torch.from_numpy(grid).double(), size=size, cells=cells).numpy()
    px_img = camera.apply_homography(np.linalg.inv(crops.A_crop_img[i]), px_crop)
    depth = sample_nearest(depth_mm, px_img, outside=0.0)
    seen = sample_nearest(crops.mask[i], px_crop, outside=False) & (depth > 0)
    points_cam = camera.unproject(crops.geometry.K[i], px_img, depth)
    return rigid.transform(rigid.inverse(crops.geometry.T_cam_obj[i]), points_cam), seen


def sample_nearest(
    values: Float32[np.ndarray, "H W"] | Bool[np.ndarray, "H W"], px: Float[np.ndarray, "m 2"], *, outside: float | bool
) -> np.ndarray:
    """Values at the pixels that contain the points; ``outside`` for points outside the image."""
    column, row = np.floor(px + 0.5).astype(int).T
    height, width = values.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = np.full(len(px), outside, dtype=values.dtype)
    found[inside] = values[row[inside], column[inside]]
    return found


def fourier_features(
    points: Float[np.ndarray, "m 3"], frequencies: Float[np.ndarray, "3 half"]
) -> Float[np.ndarray, "m c"]:
    """(cos w.x, sin w.x) over all w, of unit length."""
    phase = points @ frequencies
    return np.concatenate([np.cos(phase), np.sin(phase)], axis=1) / np.sqrt(frequencies.shape[1])
