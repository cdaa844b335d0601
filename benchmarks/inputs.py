"""Synthetic inputs with the size of Stable Diffusion's features, from which a pose can be estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from pipeline.functional import rigid
from pipeline.functional.masks import cell_mask
from pipeline.functional.similarity import cell_norms, map_norms
from pipeline.graph.context import stack_crops
from pipeline.items.features import CropFeatures, FittedArrays
from pipeline.items.fit import Fit
from pipeline.items.online import Query, TemplateView
from pipeline.items.views import Crops, Geometry
from pipeline.spec import Runtime
from pipeline.stages.crop.square import Square
from pipeline.stages.extract.coordinates import Coordinates
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic.objects import make_object

SD15 = {2: (1280, 8), 5: (1280, 16), 8: (640, 32), 11: (320, 64)}
"""layer -> (channels, cells per side) of SD 1.5's maps (hook=pre) at 512 px."""

TOY = {2: (96, 8), 5: (96, 16), 8: (64, 32), 11: (48, 64)}
"""The same cells with fewer channels, for tests."""

TEMPLATES = 300
_NOISE = 0.5  # standard deviations of the features; makes query and template differ
_OBJECT = 1  # seed; fills half of its crop, more than most objects
_TURN_DEG = 8.0  # between the best template and the query


@dataclass(frozen=True, eq=False)
class Bank:
    """Templates in memory, float16 as in the store. ``views``: all layers of the first ones; others have layer 2."""

    features: Float[Tensor, "n c h w"]
    mask: Bool[Tensor, "n S S"]
    T_cam_obj: Float[np.ndarray, "n 4 4"]
    views: tuple[TemplateView, ...]

    @cached_property
    def norms(self) -> Float[Tensor, " n"]:
        """Lengths of the flattened maps."""
        return map_norms(self.features)

    def maps(self, layer: int) -> torch.Tensor:
        """Features of the only layer that benchmarks match."""
        return self.features

    @cached_property
    def cell_norms(self) -> Float[Tensor, "n h w"]:
        """Lengths of the cells."""
        return cell_norms(self.features)

    @cached_property
    def cell_mask(self) -> Bool[Tensor, "n h w"]:
        """Foreground cells."""
        return cell_mask(self.mask, cells=self.features.shape[-1])

    def view(self, index: int) -> TemplateView:
        """Everything about one template."""
        return self.views[index]

    def render(
        self, T_cam_obj: Float[np.ndarray, "4 4"], A_crop_img: Float[np.ndarray, "3 3"], K: Float[np.ndarray, "3 3"]
    ) -> TemplateView:
        """Not used by the benchmark."""
        raise NotImplementedError

    def fitted(self, fit: Fit) -> FittedArrays:
        """Not used by the benchmark."""
        raise NotImplementedError(fit.kind)


@dataclass(frozen=True, eq=False)
class Scene:
    """A query, the bank it is matched against, and its true pose."""

    query: Query
    bank: Bank
    T_true: Float[np.ndarray, "4 4"]


def scene(shapes: Mapping[int, tuple[int, int]], *, device: str = "cpu", views: int = 4, seed: int = 0) -> Scene:
    """A query view of a procedural object, and ``TEMPLATES`` templates, the first of which is the nearest.

    Features are random mixtures of Fourier features of the cells' object points, plus noise.
    """
    mesh, renderer = make_object(_OBJECT), Raycast(count=TEMPLATES, viewpoints="fibonacci")
    K, T_cam_obj, size_hw = renderer.cameras(mesh)
    turn = rigid.rotation_between(np.array([0.0, 0, 1]), np.array([np.sin(np.radians(_TURN_DEG)), 0, 1]))
    T_true = T_cam_obj[0] @ rigid.rigid(turn, np.zeros(3))
    poses = np.concatenate([T_true[None], T_cam_obj[:views]])
    _, depth_mm = renderer.render(mesh, K, poses, size_hw)
    crop, rgb = Square(), np.zeros((*size_hw, 3), dtype=np.uint8)
    whole = (-0.5, -0.5, size_hw[1] - 0.5, size_hw[0] - 0.5)
    geometry = Geometry(list(depth_mm), np.repeat(K[None], len(poses), 0), poses)
    crops = Crops(**stack_crops([crop(rgb, depth > 0, whole, K) for depth in depth_mm]), geometry=geometry)
    maps = {layer: m.to(device) for layer, m in _mixed_features(crops, shapes, seed=seed).items()}
    masks = torch.from_numpy(crops.mask).to(device)
    each = [CropFeatures({layer: m[i] for layer, m in maps.items()}, masks[i]) for i in range(len(poses))]
    template = tuple(TemplateView(each[i], crops.A_crop_img[i], depth_mm[i], K, poses[i]) for i in range(1, len(poses)))
    generator = torch.Generator().manual_seed(seed)
    others = torch.randn((TEMPLATES - views, *maps[2].shape[1:]), generator=generator).half().to(device)
    bank_mask = torch.cat([masks[1:], masks[1:2].expand(TEMPLATES - views, -1, -1)])
    bank = Bank(torch.cat([maps[2][1:], others]), bank_mask, T_cam_obj, template)
    return Scene(Query(each[0], crops.A_crop_img[0], K), bank, T_true)


def _mixed_features(crops: Crops, shapes: Mapping[int, tuple[int, int]], *, seed: int) -> dict[int, Tensor]:
    """float16 maps with the channels and cells of each layer, with unit variance on the object."""
    generator = torch.Generator().manual_seed(seed)
    found = Coordinates(bandwidth_mm=15.0).load(Runtime(device="cpu"))(crops, tuple(shapes))
    maps = {}
    for layer, (channels, cells) in shapes.items():
        pooled = avg_pool2d(found[layer], found[layer].shape[-1] // cells)
        mix = torch.randn((channels, pooled.shape[1]), generator=generator)
        signal = torch.einsum("kc,nchw->nkhw", mix, pooled)
        seen = (pooled.abs().sum(1, keepdim=True) > 0).float()
        noise = torch.randn(signal.shape, generator=generator)
        maps[layer] = (signal + _NOISE * noise * seen).half()
    return maps
