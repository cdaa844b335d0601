"""FoundPose as a composition of stages, with HOG in DINOv2's place; what it fits to an object is kept in the store."""

import json

import numpy as np
import pytest
from array_bank import match, query_of
from command import CommandResult, run_dzop
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from test_sweep_files import CONF
from tiny_bop import edit_json, write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.configuration import build_stages
from pipeline.fits import chain
from pipeline.functional.masks import erode
from pipeline.functional.viewpoints import viewpoint_rotations
from pipeline.graph import Context, Graph
from pipeline.spec import Runtime
from pipeline.stages.crop.square import Square
from pipeline.stages.crop.virtual import Virtual
from pipeline.store import MemoryStoreConfig, Store

WITH_HOG = ("method=foundpose", "extract=hog", "match.layer=11", "fuse.layers=[11]")
SMALL = ("render=raycast", "render.count=9", "render.inplane=2", "render.size=96", "crop.size=96", "match.count=50",
         "match.iterations=5", "overlays=false", "gallery=0", "fallback=true", "evaluate.vsd=false")  # fmt: skip


def stages(*overrides: str):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=["dataset=lmo", *WITH_HOG, *overrides])
    return build_stages(OmegaConf.to_container(config, resolve=True))


@pytest.fixture
def dzop(capsys, monkeypatch, tmp_path):
    root = tmp_path / "tiny"
    if not root.exists():
        write_tiny_bop(root)

    def run(*arguments: str) -> CommandResult:
        where = ("dataset=bop", "dataset.name=tiny", f"dataset.root={root}", f"store.root={tmp_path}/cache",
                 f"out={tmp_path}/results")  # fmt: skip
        return run_dzop(capsys, monkeypatch, *where, *WITH_HOG, *SMALL, *arguments)

    return run


def test_the_methods_numbers_are_foundposes_whatever_the_dataset_says():
    chosen = stages()
    render = chosen.render
    assert len(viewpoint_rotations(render.viewpoints, render.count, render.inplane)) == 798
    kinds = [getattr(chosen, name).kind for name in ("crop", "match", "fuse", "cluster", "correspond", "solve")]
    assert kinds == [
        "crop.virtual",
        "match.words",
        "fuse.template_pca",
        "cluster.one",
        "correspond.cyclic",
        "solve.epnp",
    ]
    assert (chosen.solve.plane, chosen.solve.threshold_px, chosen.solve.iterations) == ("crop", 10.0, 400)
    assert (chosen.crop.erode_template, chosen.crop.open_query) == (2, 1)  # 5 x 5 and 3 x 3
    assert (chosen.match.count, chosen.match.top_k, chosen.correspond.count) == (2048, 5, 300)
    assert chosen.fits == chain(chosen.match.fit)  # words and projection share one PCA


def test_fits_are_made_once_for_each_object_and_shared(dzop):
    first = dzop()
    assert first.status == 0
    assert first.counts()[0]["fits"] == (4, 0)  # two objects: axes and words
    again = dzop("match.top_k=2", "solve.threshold_px=12.0")
    assert again.counts()[0]["fits"] == (0, 4)
    assert again.counts()[0]["poses"][0] > 0
    other = dzop("fuse.dim=20")
    assert other.counts()[0]["fits"] == (2, 4)  # a projection that the words do not use
    seeded = dzop("match.seed=1")
    assert seeded.counts()[0]["fits"] == (2, 2)  # other words in the same projection


def test_a_plan_shows_fits_and_computes_nothing(dzop, tmp_path):
    plan = dzop("plan=true").out
    assert "object 1 fit.projection" in plan
    assert "object 2 fit.vocabulary" in plan
    assert not list((tmp_path / "cache").rglob("fitted"))
    assert dzop("step=onboard").counts()[0]["fits"] == (4, 0)
    assert "missing" not in "\n".join(line for line in dzop("plan=true").out.splitlines() if "fit." in line)


def test_a_stored_fit_is_the_fit_made_here_and_now(tmp_path):
    dataset = open_dataset(write_tiny_bop(tmp_path / "tiny"), name="tiny")
    overrides = [o for o in SMALL if o.partition(".")[0] in ("render", "crop", "match")]
    chosen = stages("render=raycast", *overrides)
    graph = Graph(Context(chosen, dataset, dataset.targets, Store(MemoryStoreConfig()), Runtime(progress=False)))
    graph.run_item("onboarding", 1)
    bank = graph.templates.bank(1)
    kept = bank.fitted(chosen.match.fit)
    assert set(kept) == {"mean", "axes", "words", "idf", "templates"}
    query, mask = bank.features[7].float(), bank.mask[7]
    here = match(chosen.match, query, mask, bank.features, bank.mask)
    stored = chosen.match(query_of(chosen.match.layer, query, mask), bank)
    assert here.index.tolist() == stored.index.tolist()
    assert here.score.tolist() == stored.score.tolist()
    assert stored.index.tolist()[0] == 7


@pytest.mark.parametrize(("crop", "moves"), [(Square(), False), (Virtual(), True)])
def test_crops_of_a_camera_that_turns_are_kept_by_their_camera(tmp_path, crop, moves):
    root = write_tiny_bop(tmp_path / "tiny")

    def keys() -> list[str]:
        chosen, dataset = stages(), open_dataset(root, name="tiny")
        changed = type(chosen)(**{**vars(chosen), "crop": crop})
        graph = Graph(Context(changed, dataset, dataset.targets, Store(MemoryStoreConfig()), Runtime(progress=False)))
        return [graph.queries.crops(image).key for image in graph.context.image_ids]

    before = keys()
    edit_json(
        root / "test" / "000007" / "scene_camera.json", lambda cameras: cameras["0"]["cam_K"].__setitem__(0, 81.0)
    )
    assert (before[0] != keys()[0]) == moves
    assert before[1] == keys()[1]


def test_poses_of_foundposes_stages_are_written(dzop, tmp_path):
    assert dzop().status == 0
    answers = json.loads(next((tmp_path / "results").rglob("poses.json")).read_text())
    records = answers["answers"] if isinstance(answers, dict) else answers
    solved = [record for record in records if record["status"] == "estimate"]
    assert len(records) == 4
    assert all(np.isfinite(record["T_cam_obj"]).all() for record in solved)


def test_templates_are_eroded_and_photographs_opened(tmp_path):
    dataset = open_dataset(write_tiny_bop(tmp_path / "tiny"), name="tiny")
    small = [o for o in SMALL if o.partition(".")[0] in ("render", "crop")]

    def masks(erode: int, open_: int) -> list[np.ndarray]:
        chosen = stages("render=raycast", *small, f"crop.erode_template={erode}", f"crop.open_query={open_}")
        graph = Graph(Context(chosen, dataset, dataset.targets, Store(MemoryStoreConfig()), Runtime(progress=False)))
        graph.templates.make_crops(1, graph.templates.make_templates(1))
        image = graph.context.image_ids[0]
        graph.queries.make_crops(image)
        return [
            graph.context.store.read(ref).array("mask")
            for ref in (graph.templates.crops(1), graph.queries.crops(image))
        ]

    plain, eroded, opened = masks(0, 0), masks(2, 0), masks(0, 1)
    assert all(
        np.array_equal(erode(before, radius=2), after) for before, after in zip(plain[0], eroded[0], strict=True)
    )
    assert 0 < eroded[0].sum() < plain[0].sum()
    assert np.array_equal(plain[1], eroded[1])
    assert np.array_equal(plain[0], opened[0])
