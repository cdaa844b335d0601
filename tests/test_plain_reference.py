"""The package's steps against the paper written plainly with scikit-learn, SciPy, OpenCV: benchmarks/reference.py."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks import reference
from benchmarks.inputs import TOY, scene
from benchmarks.online import Plain
from benchmarks.presets import LETTER, PAPER
from pipeline.configuration import build_stages
from pipeline.functional import camera, rigid
from pipeline.functional.kmeans import kmeans
from pipeline.functional.masks import cell_mask, foreground
from pipeline.functional.similarity import global_cosine, l2_normalize
from pipeline.route import trace_pose


@pytest.fixture(scope="module")
def made():
    return scene(TOY)


@pytest.fixture(scope="module")
def plain(made):
    return Plain(made)


@pytest.fixture(scope="module")
def pair(made):
    template = made.bank.view(0)
    return PAPER.fuse(made.query.crop, template.crop)


@pytest.mark.parametrize("cells", [8, 16, 32, 64])
def test_cells_inside_a_mask_are_the_references(made, cells):
    ours = cell_mask(made.query.crop.mask, cells=cells).numpy()
    np.testing.assert_array_equal(ours, reference.cell_mask(made.query.crop.mask.numpy(), cells))


def test_similarities_of_all_templates_are_the_references(made, plain):
    ours = global_cosine(made.query.crop.maps[2], made.bank.features).numpy()
    # float32 sums of 6,144 products
    np.testing.assert_allclose(ours, reference.retrieve(plain.query[2], plain.bank), atol=1e-5)


def test_fused_maps_have_the_references_inner_products(pair, plain):
    template, template_mask, *_ = plain.view(0)
    query_map, template_map = reference.co_project(
        plain.query, template, plain.query_mask, template_mask, dims=plain.dims
    )
    theirs = np.einsum("dhw,dhw->hw", query_map, template_map)
    # signs of axes are free, products are not; float32 against float64
    ours = torch.einsum("dhw,dhw->hw", pair.query, pair.template).numpy()
    np.testing.assert_allclose(ours, theirs, atol=2e-4 * np.abs(theirs).max())


def test_k_means_ends_at_the_references_centres(pair):
    points = l2_normalize(pair.query.flatten(1).T[foreground(pair.query_mask)]).contiguous()
    label, centre = kmeans(points, count=40, seed=3, iterations=30)
    their_label, their_centre = reference.k_means(points.double().numpy(), count=40, seed=3, iterations=30)
    # a point in between two centres may go to either in float32, which moves centres by little
    assert np.mean(label.numpy() == their_label) > 0.99
    assert np.median(np.abs(centre.numpy() - their_centre)) < 1e-3


def test_correspondences_in_given_clusters_are_the_references(pair):
    clusters = PAPER.cluster(pair)
    ours = PAPER.correspond(pair, clusters, crop_size=128)
    query_px, template_px = reference.correspond(
        pair.query.double().numpy(),
        pair.template.double().numpy(),
        pair.template_mask.numpy(),
        clusters.query_label.numpy(),
        clusters.template_label.numpy(),
        clusters.pairs.numpy(),
        crop_size=128,
    )
    there = {tuple(np.rint(px).astype(int)): at for px, at in zip(query_px, template_px, strict=True)}
    mine = {
        tuple(np.rint(px).astype(int)): at
        for px, at in zip(ours.query_px.numpy(), ours.template_px.numpy(), strict=True)
    }
    shared = there.keys() & mine.keys()
    assert len(shared) >= 0.99 * max(len(there), len(mine))  # equal similarities may be told apart otherwise
    off = np.array([np.linalg.norm(there[px] - mine[px]) for px in shared])
    assert np.mean(off < 1e-3) > 0.99


READINGS = [pytest.param(PAPER, reference.DZOP, id="dzop"), pytest.param(LETTER, reference.LETTER, id="dzop_paper")]


def cells_of_pairs(query_label, template_label, pairs) -> set[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Cells of both clusters of every pair."""
    labels = query_label.ravel(), template_label.ravel()
    return {tuple(tuple(np.flatnonzero(label == k)) for label, k in zip(labels, pair, strict=True)) for pair in pairs}


@pytest.mark.parametrize(("stages", "reading"), READINGS)
def test_features_lead_to_the_references_clusters_and_correspondences(made, plain, stages, reading):
    template, template_mask, *_ = plain.view(0)
    maps = reference.co_project(
        plain.query, template, plain.query_mask, template_mask, dims=plain.dims, reading=reading
    )
    masks = [reference.cell_mask(mask, maps[0].shape[-1]) for mask in (plain.query_mask, template_mask)]
    their_clusters = reference.cluster(*maps, *masks, reading=reading)
    theirs = reference.correspond(*maps, masks[1], *their_clusters, crop_size=128, reading=reading)

    pair = stages.fuse(made.query.crop, made.bank.view(0).crop)
    clusters = stages.cluster(pair)
    ours = stages.correspond(pair, clusters, crop_size=128)
    labels = clusters.query_label.numpy(), clusters.template_label.numpy(), clusters.pairs.numpy()
    assert cells_of_pairs(*labels) == cells_of_pairs(*their_clusters)
    np.testing.assert_array_equal(ours.query_px.numpy(), theirs[0])
    np.testing.assert_allclose(ours.template_px.numpy(), theirs[1], atol=1e-4)  # px; float32 weights against float64


@pytest.mark.parametrize(("stages", "reading"), READINGS)
def test_the_same_points_give_the_references_pose(stages, reading):
    points, K = (
        np.random.default_rng(0).uniform(-50, 50, (80, 3)),
        np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]),
    )
    px = camera.project(K, rigid.transform(rigid.look_at(np.array([300.0, 200.0, 250.0])), points))
    px[::4] += 60.0
    ours = stages.solve(points, px, K).T_cam_obj
    np.testing.assert_allclose(ours, reference.solve(points, px, K, reading=reading), atol=1e-6)


def composed(*overrides: str) -> dict:
    with initialize_config_dir(str(Path(__file__).parents[1] / "conf"), version_base="1.3"):
        return OmegaConf.to_container(compose("config", overrides=list(overrides)), resolve=True)


def test_the_preset_is_the_yaml():
    stages = build_stages(composed("method=dzop_paper", "extract=hog"))
    for name in ("crop", "match", "fuse", "cluster", "correspond", "solve", "choose", "refine"):
        assert getattr(stages, name) == getattr(LETTER, name), name


@pytest.mark.parametrize(
    ("overrides", "noise"),
    [
        (("method=dzop_paper", "extract=stable_diffusion"), "shared"),
        (("method=dzop_sd",), "none"),
        (("method=dzop_sd", "extract.noise=independent"), "independent"),
    ],
)
def test_the_letter_keeps_the_shared_noise_and_dzop_sd_adds_none(overrides, noise):
    extract = composed(*overrides)["extract"]
    assert (extract["_target_"].rsplit(".", 1)[1], extract["noise"]) == ("StableDiffusion", noise)


@pytest.mark.parametrize(("stages", "reading"), READINGS)
def test_the_whole_route_ends_at_the_references_pose(made, plain, stages, reading):
    best = trace_pose(stages, made.query, made.bank).best
    template_id, T_reference = plain.pose(reading)
    assert best.template_id == template_id == 0
    assert best.solution is not None
    points = best.points_obj[best.solution.inliers]
    ours, theirs, true = (
        camera.project(made.query.K, rigid.transform(T, points))
        for T in (best.solution.T_cam_obj, T_reference, made.T_true)
    )
    # matches of equal similarity may be listed in another order, and RANSAC then draws others
    assert np.median(np.linalg.norm(ours - theirs, axis=1)) < 0.3
    assert np.median(np.linalg.norm(ours - true, axis=1)) < 1.5
