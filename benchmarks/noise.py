"""How the noise of diffusion features leaks positions: matches between two views of an object, by kind of noise.

Objects are procedural. For each cell inside the query's mask, the most similar cell of the template is found by the
descriptors of fuse=pca, without clusters. Right: the object point of the template's cell projects within 2 cells of the
query's. Same cell: both have the same position in their crops, which noise that is shared by all images causes. Views
differ by 15 degrees; in the last column the template shows another object, and every match is wrong.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from pipeline.backbones.stable_diffusion.features import DiffusionFeatures
from pipeline.backbones.stable_diffusion.noise import NoiseMode
from pipeline.functional import camera, rigid
from pipeline.functional.masks import foreground
from pipeline.functional.similarity import l2_normalize
from pipeline.graph.context import stack_crops
from pipeline.items.features import CropFeatures
from pipeline.items.views import Crops, Geometry
from pipeline.spec import Runtime
from pipeline.stages.crop.square import Square
from pipeline.stages.extract.embedded import Embedded
from pipeline.stages.extract.random_sd import RandomSD
from pipeline.stages.fuse.pca import Pca
from pipeline.stages.lift import lift
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic.objects import make_object

SEEDS = range(700, 706)  # of the objects; training and validation objects come from other generators
PAIRS = 3  # of views of an object
TURN_DEG = 15.0
RIGHT_CELLS = 2.0
BACKBONES: dict[str, DiffusionFeatures] = {"embedded, pure": Embedded(weights="pure"), "random weights": RandomSD()}
NOISES: tuple[tuple[NoiseMode, int], ...] = (("shared", 1), ("independent", 1), ("independent", 4), ("none", 1))
"""Kind of noise, samples averaged."""


@dataclass(frozen=True, eq=False)
class Described:
    """One view with its features."""

    crop: CropFeatures
    A_crop_img: Float[np.ndarray, "3 3"]
    depth_mm: Float[np.ndarray, "H W"]
    K: Float[np.ndarray, "3 3"]
    T_cam_obj: Float[np.ndarray, "4 4"]


def compare(seeds: Sequence[int] = SEEDS, pairs: int = PAIRS) -> str:
    """A table in Markdown: a line per backbone and kind of noise."""
    crops = [render_pairs(seed, pairs) for seed in seeds]
    lines = ["| features | noise | right | same cell | same cell of another object |", "|---" * 5 + "|"]
    for name, backbone in BACKBONES.items():
        for noise, ensemble in NOISES:
            found = [describe(backbone, noise, ensemble, views) for views in crops]
            own = np.mean([score(views[i], views[i + 1]) for views in found for i in range(0, 2 * pairs, 2)], axis=0)
            others = zip(found, found[1:] + found[:1], strict=True)
            same = np.mean([score(views[0], other[0])[1] for views, other in others])
            kind = noise if ensemble == 1 else f"{noise}, {ensemble} samples averaged"
            lines.append(f"| {name} | {kind} | {own[0]:.3f} | {own[1]:.3f} | {same:.3f} |")
    return "\n".join(lines)


def render_pairs(seed: int, pairs: int) -> Crops:
    """Views of an object in pairs: a view, and one turned by TURN_DEG about a random axis."""
    mesh, renderer = make_object(seed), Raycast(count=pairs, viewpoints="superfibonacci")
    K, T_cam_obj, size_hw = renderer.cameras(mesh)
    poses = np.concatenate(list(_turn(T_cam_obj, seed)))
    rgb, depth_mm = renderer.render(mesh, K, poses, size_hw)
    crops = [Square()(image, depth > 0, (0.0, 0.0, 1.0, 1.0), K) for image, depth in zip(rgb, depth_mm, strict=True)]
    geometry = Geometry(list(depth_mm), np.repeat(K[None], len(poses), 0), poses)
    return Crops(**stack_crops(crops), geometry=geometry)


def _turn(T_cam_obj: Float[np.ndarray, "n 4 4"], seed: int) -> Iterator[Float[np.ndarray, "2 4 4"]]:
    rng = np.random.default_rng(seed)
    for T in T_cam_obj:
        axis, around = rng.normal(size=(2, 3))
        a = axis / np.linalg.norm(axis)
        b = np.cross(a, around) / np.linalg.norm(np.cross(a, around))
        turned = np.cos(np.radians(TURN_DEG)) * a + np.sin(np.radians(TURN_DEG)) * b
        yield np.stack([T, T @ rigid.rigid(rigid.rotation_between(a, turned), np.zeros(3))])


def describe(backbone: DiffusionFeatures, noise: NoiseMode, ensemble: int, crops: Crops) -> list[Described]:
    """Features of all views with one kind of noise."""
    chosen = replace(backbone, noise=noise, ensemble=ensemble)
    maps = chosen.load(Runtime(device="cpu"))(crops, Pca().layers)
    seen, masks = crops.geometry, torch.from_numpy(crops.mask)
    assert seen is not None
    features = [CropFeatures({k: m[i] for k, m in maps.items()}, mask) for i, mask in enumerate(masks)]
    return list(map(Described, features, crops.A_crop_img, seen.depth_mm, seen.K, seen.T_cam_obj))


def score(query: Described, template: Described) -> tuple[float, float]:
    """Share of matches that are right, and that have the same position in both crops."""
    pair, size = Pca()(query.crop, template.crop), query.crop.mask.shape[-1]
    cells = pair.query.shape[-1]
    inside = [foreground(mask) for mask in (pair.query_mask, pair.template_mask)]
    q, t = (l2_normalize(m.flatten(1).T[at]) for m, at in zip((pair.query, pair.template), inside, strict=True))
    xy = [camera.grid_xy(at, width=cells) for at in (inside[0], inside[1][(q @ t.T).argmax(1)])]
    query_px, template_px = (camera.cell_to_px(p.double(), size=size, cells=cells).numpy() for p in xy)
    points = lift(template_px, template.A_crop_img, template.depth_mm, template.K, template.T_cam_obj)
    seen = camera.project(query.K, rigid.transform(query.T_cam_obj, points))
    off = np.linalg.norm(camera.apply_homography(query.A_crop_img, seen) - query_px, axis=1) / (size / cells)
    known = np.isfinite(off)
    same = (xy[0] == xy[1]).all(1).numpy()
    return float((off[known] < RIGHT_CELLS).mean()), float(same.mean())


if __name__ == "__main__":
    argparse.ArgumentParser(prog="python -m benchmarks.noise", description=__doc__).parse_args()
    torch.set_num_threads(1)
    print(compare())
