"""Pins: a change of keys would orphan caches, a change of results without a raised version would mix old and new.

When one of these fails on purpose, raise the variant's ``version`` and write the new values with
``python tests/test_pins.py``.
"""

import atexit
import json
import shutil
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from array_bank import match, match_truth
from make_vit import write_vit
from test_configuration import VARIANTS, loaded

from pipeline.fits import fit_arrays, foreground_cells
from pipeline.functional import camera, rigid
from pipeline.items.features import Clusters, CropFeatures, FusedPair, PairGeometry
from pipeline.items.matches import TrueMatches
from pipeline.items.online import Truth
from pipeline.items.views import Crops, Geometry
from pipeline.spec import Runtime, build, digest

PINS = Path(__file__).with_name("pins.json")
# need files, are others in disguise, or change with the weights that ship
UNPINNED = {
    "extract/stable_diffusion",
    "extract/bk_sdm",
    "extract/dinov3",
    "extract/cleandift",
    "detect/json",
    "detect/photo",
    "render/auto",
    "extract/embedded",
    "fuse/learned",
    "fuse/auto",
}
RNG_SEED = 5


@cache
def toy_weights(model_type: str) -> str:
    """A small transformer with random weights, the same bytes in every run."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return str(write_vit(folder / model_type, model_type))


def stand_ins(name: str) -> dict:
    """Fields for variants whose defaults are weights that nobody has here."""
    if name == "extract/dino":
        return {"weights": toy_weights("vit"), "stride": 4, "binned": [11], "input_size": 64}
    if name == "extract/dinov2":
        return {"weights": toy_weights("dinov2_with_registers"), "input_size": 112}
    if name == "extract/fusion":
        layers = [[2, 5], [11, 8]]
        return {"first": variant("extract/hog"), "second": variant("extract/pixels"), "layers": layers}
    return {}


def variant(name: str):
    path = next(path for path in VARIANTS if f"{path.parent.name}/{path.stem}" == name)
    cls, values = loaded(path)
    if name == "detect/cnos":  # what weights it stands on is no part of it: a descriptor without, and SAM's left out
        spec = build(cls, values | {"describe": variant("extract/pixels")}, where=name)
        vars(spec.proposals)["weights_digest"] = ""
        return spec
    return build(cls, values | stand_ins(name), where=name)


def toy_maps(count: int = 0) -> dict[int, torch.Tensor]:
    generator = torch.Generator().manual_seed(RNG_SEED)
    shapes = {2: (12, 4, 4), 5: (10, 8, 8), 8: (8, 16, 16), 11: (6, 16, 16)}
    return {k: torch.randn((count, *s) if count else s, generator=generator) for k, s in shapes.items()}


def disc(size: int) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return (x - size / 2) ** 2 + (y - size / 2.2) ** 2 < (0.4 * size) ** 2


def toy_pair(fuse=None) -> FusedPair:
    query = CropFeatures(toy_maps(), disc(64))
    template = CropFeatures({k: m.flip(-1) for k, m in toy_maps().items()}, disc(64).flip(-1))
    if fuse is None:
        return with_saliency(variant("fuse/concat")(query, template))
    fit = fuse.fit
    arrays = (
        {} if fit is None else fit_arrays(fit, foreground_cells(template.maps[fit.layer][None], template.mask[None]))
    )
    return fuse(query, template, arrays)


def with_saliency(fused: FusedPair) -> FusedPair:
    ramp = torch.linspace(0, 1, fused.query.shape[-1])
    salient = 0.7 * ramp + 0.3 * ramp[:, None]
    return replace(fused, query_saliency=salient, template_saliency=salient.flip(-1))


def one_cluster(pair: FusedPair) -> Clusters:
    return Clusters(pair.query_mask.long() - 1, pair.template_mask.long() - 1, torch.tensor([[0, 0]]))


def toy_crops() -> Crops:
    rng = np.random.default_rng(RNG_SEED)
    rgb = np.kron(rng.integers(0, 256, (1, 16, 16, 3)), np.ones((1, 8, 8, 1))).astype(np.uint8)
    depth = np.full((128, 128), 500.0, np.float32)
    K = np.array([[200.0, 0, 63.5], [0, 200.0, 63.5], [0, 0, 1]])
    geometry = Geometry([depth], K[None], rigid.rigid(np.eye(3)[None], np.array([[0.0, 0, 500]])))
    return Crops(
        rgb * disc(128).numpy()[None, :, :, None].astype(np.uint8), disc(128).numpy()[None], np.eye(3)[None], geometry
    )


def toy_points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(RNG_SEED)
    points, K = rng.uniform(-50, 50, (60, 3)), np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
    T = rigid.look_at(np.array([300.0, 200.0, 250.0]))
    px = camera.project(K, rigid.transform(T, points)) + rng.normal(0, 0.5, (60, 2))
    px[::4] += rng.uniform(-80, 80, (15, 2))
    return points, px, K


def summary(name: str) -> list[float]:
    """A few numbers that any change of results would move."""
    stage, spec = name.split("/")[0], variant(name)
    if name == "match/oracle":
        views = rigid.look_at(np.random.default_rng(RNG_SEED).normal(size=(40, 3)) * 300)
        found = match_truth(spec, views[7] @ rigid.look_at(np.array([[9.0, 3, 3]]))[0], np.eye(4)[None], views)
        return [*found.index.tolist(), *found.score.tolist(), found.margin]
    if name == "correspond/oracle":
        px = torch.arange(40, dtype=torch.float64).reshape(20, 2) * 1.6
        found = spec(toy_pair(), one_cluster(toy_pair()), crop_size=64, truth=TrueMatches(px, px + 0.25, disc(64)))
        return [float(len(found.similarity)), *found.query_px[:3].flatten().tolist()]
    if stage == "match":
        bank = toy_maps(9)[spec.layer]
        found = match(spec, toy_maps()[spec.layer] + bank[3], disc(64), bank, disc(64).expand(9, 64, 64))
        return [*found.index.tolist(), *found.score.tolist(), found.margin]
    if stage == "fuse":
        pair = toy_pair(spec)
        # axes of nearly equal variance may turn into one another, which leaves products as they are
        inner = torch.einsum("dhw,dhw->hw", pair.query, pair.template)
        return [float(len(pair.query)), *inner[4:12:3, 4:12:3].flatten().tolist()]
    if stage == "cluster":
        found = spec(toy_pair())
        return [float(len(found.pairs)), float((found.query_label >= 0).sum()), float(found.query_label.double().std())]
    if stage == "correspond":
        pair = toy_pair()
        found = spec(pair, one_cluster(pair), crop_size=64)
        return [float(len(found.similarity)), *found.similarity[:3].tolist(), *found.template_px[:3].flatten().tolist()]
    if stage == "solve":
        solution = spec(*toy_points())
        return [float(solution.inliers.sum()), *solution.T_cam_obj[:3].round(4).flatten().tolist()]
    if stage == "choose":
        pair = toy_pair()
        x, y = (camera.cell_to_px(pair.template_mask.nonzero().flip(1).double(), size=64, cells=16).numpy() - 31.5).T
        points, K_crop = np.stack([x, y, 0 * x], axis=1), np.array([[-400.0, 0, 31.5], [0, 400.0, 31.5], [0, 0, 1]])
        poses = [rigid.rigid(np.eye(3), np.array([shift, 0.0, 400.0])) for shift in (0.0, 3.0, 9.0)]
        truth = Truth(poses[1], np.eye(4)[None]) if spec.needs_truth else None
        return [spec(T, 25, PairGeometry(pair, points, K_crop, 64), truth) for T in poses]
    if stage == "refine":
        pair = toy_pair()
        x, y = (camera.cell_to_px(pair.template_mask.nonzero().flip(1).double(), size=64, cells=16).numpy() - 31.5).T
        bumps = np.random.default_rng(RNG_SEED).uniform(-5, 5, len(x))
        start = rigid.rigid(np.eye(3), np.array([1.0, -0.6, 404.0]))
        K_crop = np.array([[-400.0, 0, 31.5], [0, 400.0, 31.5], [0, 0, 1]])  # the query mirrors the template
        found = spec(start, PairGeometry(pair, np.stack([x, y, bumps], axis=1), K_crop, 64))
        return [float(np.array_equal(found, start)), *found[:3].round(4).flatten().tolist()]
    if stage == "crop":
        rgb = toy_crops().rgb[0]
        crop = spec(rgb, disc(128).numpy(), (0.0, 0.0, 127.0, 127.0), toy_crops().geometry.K[0])
        return [float(crop.rgb.mean()), float(crop.mask.mean()), *crop.A_crop_img[:2].flatten().tolist()]
    if stage == "extract":
        maps = spec.load(Runtime(device="cpu"))(toy_crops(), [2, 11])
        return [v for m in maps.values() for v in (float(m.shape[1]), float(m.float().mean()), float(m.float().std()))]
    raise AssertionError(f"no toy input for {name}")


def pinned(name: str) -> dict:
    spec = variant(name)
    pin = {"version": type(spec).version, "key": digest(spec.recipe())}
    if name.split("/")[0] not in (
        "render",
        "detect",
        "segment",
    ):  # their outputs are pinned by known answers in their own tests
        pin["output"] = summary(name)
    return pin


NAMES = [n for n in (f"{path.parent.name}/{path.stem}" for path in VARIANTS) if n not in UNPINNED]


@pytest.mark.parametrize("name", NAMES)
def test_keys_and_results_are_those_of_their_version(name: str):
    then, now = json.loads(PINS.read_text())[name], pinned(name)
    assert (now["version"], now["key"]) == (then["version"], then["key"])
    if "output" in then:
        # float32 sums differ between processors by some 1e-6; a change of method moves far more
        np.testing.assert_allclose(now["output"], then["output"], rtol=2e-3, atol=2e-3)


if __name__ == "__main__":
    PINS.write_text(json.dumps({name: pinned(name) for name in NAMES}, indent=1) + "\n")
