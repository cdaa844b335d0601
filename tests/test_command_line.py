"""The command line end to end, on a small synthetic dataset."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import CommandResult, run_dzop
from PIL import Image

from pipeline.bop.images import read_mask
from pipeline.bop.results import read_results
from pipeline.errors import BadInput
from pipeline.report.run_records import read_run_records
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic import demo, scenes
from pipeline.synthetic.demo import DemoConfig

SMALL = (
    "render.count=12",
    "render.size=128",
    "method=dzop",
    "extract=hog",
    "overlays=false",
    "gallery=0",
    "runtime.progress=false",
    "runtime.device=cpu",
)


@pytest.fixture
def dzop(capsys, monkeypatch, tmp_path, scene):
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> CommandResult:
        if arguments[0] == "cache":
            return run_dzop(capsys, monkeypatch, *arguments)
        dataset = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", *SMALL)
        options = next((i for i, a in enumerate(arguments) if "=" in a), 0)  # argparse wants options before overrides
        return run_dzop(capsys, monkeypatch, *arguments[:options], *dataset, *arguments[options:])

    return run


def results(folder: Path) -> Path:
    return next(folder.glob("results/*/*/poses.json")).parent


def test_one_command_estimates_poses_and_a_second_one_computes_nothing(dzop, tmp_path):
    first = dzop("overlays=true", "gallery=12")
    assert first.status == 0
    made = first.counts()[0]
    assert made["templates"] == made["template features"] == (24, 0)
    assert made["query features"] == made["poses"] == (4, 0)
    folder = results(tmp_path)
    rows = read_results(folder / "dzop-hog-gt-mask_toy-test.csv")
    record = json.loads((folder / "poses.json").read_text())
    assert len(record["answers"]) == 4
    assert len(rows) == sum(answer["status"] == "estimate" for answer in record["answers"])
    assert all(answer["status"] == "estimate" or (answer["stage"] and answer["reason"]) for answer in record["answers"])
    pictures = sorted((folder / "overlays").glob("*.jpg"))
    assert len(pictures) == 2
    again = dzop("overlays=true", "gallery=12").counts()[0]
    assert {computed for computed, _ in again.values()} == {0}
    assert {step: sum(counts) for step, counts in again.items()} == {step: sum(counts) for step, counts in made.items()}


def test_a_cached_run_parses_no_mesh(dzop, cache, monkeypatch):
    dzop(f"store.root={cache}")
    monkeypatch.setattr("pipeline.bop.dataset.read_model", None)
    assert dzop(f"store.root={cache}").status == 0


def test_a_mesh_of_the_wrong_diameter_is_refused_even_with_cached_templates(
    tmp_path, scene, cache, dzop, capsys, monkeypatch
):
    dzop(f"store.root={cache}", "step=onboard")
    other = shutil.copytree(scene, tmp_path / "other")
    info = json.loads((other / "models" / "models_info.json").read_text())
    info["2"]["diameter"] *= 10
    (other / "models" / "models_info.json").write_text(json.dumps(info))
    dataset = ("dataset=bop", "dataset.name=toy", f"dataset.root={other}", f"store.root={cache}", *SMALL)
    ran = run_dzop(capsys, monkeypatch, *dataset, "step=estimate", "cluster.count=7")
    assert "obj_000002.ply: found a mesh of diameter" in ran.err
    assert "poses" not in ran.out.split("targets")[-1]


def test_two_runs_write_the_same_csv_except_for_times(dzop, tmp_path):
    dzop("store.root=a", "out=a/results")
    dzop("store.root=b", "out=b/results")
    ours, theirs = (read_results(next((tmp_path / name).glob("results/*/*/*.csv"))) for name in "ab")
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a.T_cam_obj, b.T_cam_obj)
        assert (a.scene_id, a.im_id, a.obj_id, a.score) == (b.scene_id, b.im_id, b.obj_id, b.score)


def test_a_sweep_over_matching_parameters_reuses_templates_and_features(dzop):
    ran = dzop("-m", "cluster.count=5,10", "fuse.dim=16,32")
    assert ran.status == 0
    first, *others = ran.counts()
    assert first["templates"] == (24, 0)
    assert len(others) == 3
    for job in others:
        assert [job[step] for step in ("templates", "template features", "query features")] == [
            (0, 24),
            (0, 24),
            (0, 4),
        ]
        assert job["poses"] == (4, 0)


def test_one_more_layer_computes_only_that_layer(dzop):
    dzop("step=onboard", "fuse.layers=[5,8]")
    listed = dzop("cache", "ls").out
    assert dzop("step=onboard", "fuse.layers=[5,8,11]").counts()[0]["template features"] == (24, 0)
    paths = [line.split()[-1] for line in listed.splitlines()[1:]]
    assert all(path in dzop("cache", "ls").out for path in paths)
    assert "features/hog/t0/layer11" not in listed
    assert "features/hog/t0/layer11" in dzop("cache", "du").out


def test_a_plan_computes_nothing_and_shows_every_node(dzop, tmp_path):
    plan = dzop("plan=true").out
    assert not list(tmp_path.glob("cache/templates/*")) + list(tmp_path.glob("results/*"))
    for line in ("templates: object 1  (12 views)", "template features: object 2 layer 11", "poses: scene 1 object 2"):
        assert line in plan
    dzop("step=all")
    warm = dzop("plan=true").out
    assert "missing" not in warm
    assert "nodes cached" in warm


def test_a_run_record_has_the_scores_of_its_csv(dzop, tmp_path, scene, cache, capsys, monkeypatch):
    ran = dzop(f"store.root={cache}", "gallery=2")
    assert ran.status == 0
    (row,) = read_run_records(tmp_path / "results")
    assert row.label["extract"] == "hog"
    assert row.counts["poses"]["computed"] + row.counts["poses"]["reused"] == 4
    assert set(row.times_s) >= {"crop", "extract", "match", "cluster", "solve"}
    assert len(row.cases) == 2
    assert all((tmp_path / "results" / row.folder / case.file).exists() for case in row.cases)
    assert len(row.templates) == 4
    written = json.loads((results(tmp_path) / "poses.json").read_text())["scores"]["metrics"]
    csv = str(next(tmp_path.glob("results/*/*/*.csv")))
    scored = run_dzop(capsys, monkeypatch, "score", csv, "--dataset", str(scene), "--json", "scored.json")
    assert scored.status == 0, scored.err
    same = json.loads(Path("scored.json").read_text())["metrics"]
    assert {name: same[name] for name in written} == pytest.approx(written)
    assert row.metrics["AR"] == pytest.approx(same["AR"])
    dzop(f"store.root={cache}", "gallery=3")
    (again,) = read_run_records(tmp_path / "results")
    assert (again.at, again.counts) == (row.at, row.counts)  # the row says what the first run computed
    assert len(again.cases) == 3
    assert same["AR_VSD"] is not None


def test_step_estimate_scores_nothing(dzop, tmp_path, cache):
    ran = dzop(f"store.root={cache}", "step=estimate")
    assert ran.status == 0
    assert "AR_MSSD" not in ran.out
    assert not (tmp_path / "results" / "rows").exists()


def test_step_evaluate_needs_ground_truth(dzop, tmp_path, scene, cache):
    shutil.copytree(scene, tmp_path / "bare")
    for path in (tmp_path / "bare" / "test" / "000001").glob("scene_gt*.json"):
        path.unlink()
    targets = [{"scene_id": 1, "im_id": 0, "obj_id": 1, "inst_count": 1}]
    (tmp_path / "bare" / "test_targets_bop19.json").write_text(json.dumps(targets))
    found = {"scene_id": 1, "image_id": 0, "category_id": 1, "score": 0.9, "bbox": [100, 80, 60, 60], "time": 0.1}
    Path("found.json").write_text(json.dumps([found]))
    given = ("dataset.root=bare", "detect=json", "detect.path=found.json", f"store.root={cache}")
    assert dzop(*given).status == 0
    ran = dzop(*given, "step=evaluate")
    assert ran.status == 1
    assert "bare/test/000001: found no scene_gt.json, needs ground truth to evaluate against" in ran.err


def test_an_oracle_needs_detections_of_ground_truth(dzop, cache):
    found = {"scene_id": 1, "image_id": 0, "category_id": 1, "score": 0.9, "bbox": [100, 80, 60, 60], "time": 0.1}
    Path("found.json").write_text(json.dumps([found]))
    ran = dzop(f"store.root={cache}", "match=oracle", "detect=json", "detect.path=found.json")
    assert ran.status == 1
    assert "match=oracle: found detections without ground truth, needs detect=gt_mask or detect=gt_bbox" in ran.err


def test_each_step_computes_only_what_it_needs(dzop, tmp_path):
    assert set(dzop("step=onboard").counts()[0]) == {"templates", "template crops", "template features"}
    assert set(dzop("step=detect").counts()[0]) == {"detections"}
    assert not (tmp_path / "results").exists()


def test_targets_can_be_selected(dzop, tmp_path, cache):
    dzop(f"store.root={cache}", "select.objects=[2]", "select.images=[0]")
    answers = json.loads((results(tmp_path) / "poses.json").read_text())["answers"]
    assert [(answer["im_id"], answer["obj_id"]) for answer in answers] == [(0, 2)]


def test_a_bad_detection_is_recorded_and_the_run_continues(dzop, tmp_path, scene, cache):
    good = {"scene_id": 1, "image_id": 0, "category_id": 1, "score": 0.9, "bbox": [100, 80, 60, 60], "time": 0.1}
    bad = {**good, "category_id": 2, "segmentation": {"size": [3, 3], "counts": [9]}}
    Path("found.json").write_text(json.dumps([good, bad]))
    ran = dzop(f"store.root={cache}", "detect=json", "detect.path=found.json")
    assert ran.status == 0
    answers = json.loads((results(tmp_path) / "poses.json").read_text())["answers"]
    reasons = {(a["im_id"], a["obj_id"]): a.get("reason") for a in answers}
    assert set(reasons) == {(0, 1), (0, 2), (1, 1), (1, 2)}
    assert "[3, 3]" in reasons[0, 2]
    assert reasons[1, 1] == "object 1 was not detected in scene 1, image 1"


def test_a_fallback_is_marked_as_one(dzop, tmp_path, cache):
    dzop(f"store.root={cache}", "solve.min_inliers=100000", "fallback=true")
    answers = json.loads((results(tmp_path) / "poses.json").read_text())["answers"]
    assert all(answer["status"] == "estimate" and "rotation of template" in answer["fallback"] for answer in answers)
    dzop(f"store.root={cache}", "solve.min_inliers=100000", "out=strict")
    answers = json.loads(next(tmp_path.glob("strict/*/*/poses.json")).read_text())["answers"]
    assert {answer["status"] for answer in answers} == {"none"}


def test_ones_own_photograph_gives_a_pose_and_an_overlay(dzop, tmp_path, scene, capsys, monkeypatch):
    frame = scene / "test" / "000001"
    K = json.loads((frame / "scene_camera.json").read_text())["0"]["cam_K"]
    given = (
        "dataset=photo", f"dataset.mesh={scene}/models/obj_000001.ply", f"dataset.image={frame}/rgb/000000.png",
        f"dataset.K=[{K[0]},{K[4]},{K[2]},{K[5]}]", *SMALL[:4], "overlays=true", "runtime.progress=false",
    )  # fmt: skip
    mask = run_dzop(capsys, monkeypatch, *given, f"dataset.mask={frame}/mask_visib/000000_000000.png")
    assert mask.status == 0, mask.err
    assert "poses found: 1, failed: 0" in mask.out or "poses found: 0, failed: 1" in mask.out
    assert len(list(tmp_path.glob("results/dzop-hog-photo_photo-test/*/overlays/*.jpg"))) == 1
    box = run_dzop(capsys, monkeypatch, *given, "dataset.bbox=[100,80,60,60]")
    other = run_dzop(capsys, monkeypatch, *given, "dataset.bbox=[100,80,60,70]")
    assert box.status == other.status == 0
    assert len(list(tmp_path.glob("results/dzop-hog-photo_photo-test/*"))) == 3  # another box is another run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("cluster.size=3",), "Could not override 'cluster.size'"),
        (("+cluster.size=3",), "cluster.size: found an unknown field, needs one of: count"),
        (
            ("match=nearest",),
            "Could not find 'match/nearest' (own variants need --config-dir) Available options in 'match'",
        ),
        (("match=cosin",), "; did you mean cosine? Available options in 'match': cosine masked_cosine"),
        (("report",), "found 'report', needs NAME=VALUE, such as step=report"),
        (
            ("render.count.views=3",),
            "found no such field, needs one that dzop --cfg job lists; render.count is a value and has no",
        ),
        (("store=s3",), "store.url: found nothing, needs s3://bucket/prefix"),
        (("cluster.cuont=3",), "needs one that dzop --cfg job lists; did you mean count?"),
        (
            ("dataset.mask=a.png",),
            "found no such field, needs one that dzop --cfg job lists; dataset=photo has it",
        ),
        (
            ("+match.topk=3",),
            "found an unknown field, needs one of: layer, top_k, class_token; did you mean top_k?",
        ),
        (("match.top_k=0",), "match.top_k: found 0, needs greater than or equal to 1"),
        (("fuse.layers=[2,12]",), "fuse.layers: found 12, needs one of 2, 5, 8, 11"),
        (("match.layer=7",), "match.layer: found 7, needs one of 2, 5, 8, 11"),
        (("runtime.device=gpu",), "runtime.device: found 'gpu', needs auto, cpu, cuda or cuda:N"),
        (("evaluate.theta_max=0.07",), "evaluate.theta_max: found 0.07, needs one of BOP's thresholds: 0.05, 0.1"),
        (("evaluate.models=nowhere",), "nowhere: found no such folder, needs the meshes that evaluate.models names"),
        (("out=/dev/null/below",), "out: found /dev/null/below (Not a directory), needs a folder to write to"),
        (("step=report", "plan=true"), "plan=true step=report: found a step without a plan"),
        (("dataset.name=???",), "dataset.name: found nothing, needs a value"),
        (("select.objects=[9]",), "select.objects: found [9], needs some of the targets' objects: 1, 2"),
        (("step=cook",), "step: found 'cook', needs 'all', 'onboard', 'detect', 'estimate', 'evaluate' or 'report'"),
        (("detect=json",), "detect.path"),
        (("detect=json", "detect.path=nowhere.json"), "nowhere.json"),
        (("dataset.root=nowhere",), "nowhere: found no such folder"),
        (("extract=stable_diffusion", "extract.weights=./nowhere"), "nowhere"),
        (("store=s3", "store.url=bucket"), "store.url: found 'bucket', needs s3://bucket/prefix"),
        (("match._target_=pipeline.nothing.Here",), "match._target_"),
        (("detect=photo",), "dataset=photo"),
    ],
)
def test_a_mistake_is_reported_in_one_line(dzop, tmp_path, arguments, message):
    ran = dzop(*arguments)
    assert ran.status == 1
    lines = [line for line in ran.err.splitlines() if line]
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert message in lines[0]
    assert not list(tmp_path.glob("cache/*/*/zarr.json"))


@pytest.mark.parametrize("drawn_in", ["colour", "alpha", "palette"])
def test_a_mask_with_alpha_or_palette_reads_as_the_same_mask(tmp_path, scene, monkeypatch, drawn_in):
    monkeypatch.chdir(tmp_path)
    plain = Image.open(scene / "test" / "000001" / "mask_visib" / "000000_000000.png").convert("L")
    white, opaque = Image.new("L", plain.size, 255), Image.new("L", plain.size, 255)
    if drawn_in == "palette":
        plain.convert("RGB").convert("P").save("mask.png")
    else:
        channels = (plain, plain, plain, opaque) if drawn_in == "colour" else (white, white, white, plain)
        Image.merge("RGBA", channels).save("mask.png")
    np.testing.assert_array_equal(read_mask(Path("mask.png")), np.asarray(plain) > 0)


def test_a_refused_detection_names_the_values_of_its_own_file(dzop, tmp_path, cache):
    entry = {"scene_id": 1, "image_id": 0, "category_id": 1, "score": 0.9, "time": 0.1}
    for name, bbox in (("short", [1, 2, 3]), ("flat", [1, 2, 0, 3])):
        Path("found.json").write_text(json.dumps([{**entry, "bbox": bbox}]))
        ran = dzop(f"store.root={cache}", "detect=json", "detect.path=found.json", "select.objects=[1]", f"out={name}")
        assert ran.status == 1
        assert str(bbox) in ran.err
        assert not list(tmp_path.glob(f"{name}/*/*/poses.json"))


def test_a_sweep_continues_after_a_failed_job_and_names_it_at_the_end(dzop, cache):
    ran = dzop("-m", f"store.root={cache}", "cluster.count=4,0,6")
    assert ran.status == 1
    assert len(ran.counts()) == 2
    last = ran.err.splitlines()[-1]
    assert last.startswith("error: 1 of the sweep's jobs failed: ")
    assert "cluster.count=0" in last


def test_a_mask_of_the_wrong_size_is_reported(dzop, tmp_path, scene, capsys, monkeypatch):
    Image.new("L", (10, 10), 255).save("mask.png")
    ran = run_dzop(
        capsys, monkeypatch, "dataset=photo", f"dataset.mesh={scene}/models/obj_000001.ply", *SMALL[:3],
        f"dataset.image={scene}/test/000001/rgb/000000.png", "dataset.K=[300,300,160,120]", "dataset.mask=mask.png",
    )  # fmt: skip
    assert "mask.png: found 10 x 10 pixels, needs those of the photograph, 320 x 240" in ran.err


MATCHER = '''
"""query, template bank -> the first template, whatever the query."""
from typing import ClassVar

import torch

from pipeline.items.matches import TemplateMatch
from pipeline.spec import spec
from pipeline.stages.match import Matcher


@spec
class First(Matcher):
    kind: ClassVar[str] = "match.first"
    layer: int = 2

    def __call__(self, query, bank):
        return TemplateMatch(index=torch.tensor([0]), score=torch.tensor([1.0]), margin=0.0)
'''


@pytest.mark.parametrize(
    ("kind", "needed"),
    [
        ("match.other", "found 'match.other', needs match.first, the stage and the file name"),
        ("fuse.first", "found 'fuse.first', needs match.first, the stage and the file name"),
    ],
)
def test_a_kind_names_stage_and_file_so_that_no_two_variants_share_results(dzop, tmp_path, monkeypatch, kind, needed):
    name = kind.replace(".", "_")  # a package of its own: imported modules stay imported
    (tmp_path / name).mkdir()
    (tmp_path / name / "first.py").write_text(MATCHER.replace("match.first", kind))
    (tmp_path / "conf" / "match").mkdir(parents=True)
    (tmp_path / "conf" / "match" / "first.yaml").write_text(f"_target_: {name}.first.First\nlayer: 2\n")
    monkeypatch.syspath_prepend(tmp_path)
    ran = dzop("--config-dir", str(tmp_path / "conf"), "match=first", "plan=true")
    assert f"error: {name}.first.First.kind: {needed}" in ran.err


@pytest.mark.parametrize(
    "other", ["pipeline.spec.Spec", "pipeline.stages.cluster.Clusterer", "pipeline.stages.fuse.Fuser"]
)
def test_an_own_variant_derives_from_the_base_class_of_its_stage(dzop, tmp_path, monkeypatch, other):
    module, _, base = other.rpartition(".")
    name = f"of_{base.lower()}"
    (tmp_path / name).mkdir()
    text = MATCHER.replace("from pipeline.stages.match import Matcher", f"from {module} import {base} as Matcher")
    (tmp_path / name / "first.py").write_text(text)
    (tmp_path / "conf" / "match").mkdir(parents=True)
    (tmp_path / "conf" / "match" / "first.yaml").write_text(f"_target_: {name}.first.First\nlayer: 2\n")
    monkeypatch.syspath_prepend(tmp_path)
    ran = dzop("--config-dir", str(tmp_path / "conf"), "match=first", "plan=true")
    assert "needs a subclass of Matcher (pipeline.stages.match)" in ran.err


def test_an_own_variant_may_not_have_a_kind_of_the_package(dzop, tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "cosine.py").write_text(MATCHER.replace("match.first", "match.cosine"))
    (tmp_path / "conf" / "match").mkdir(parents=True)
    (tmp_path / "conf" / "match" / "first.yaml").write_text("_target_: own.cosine.First\nlayer: 2\n")
    monkeypatch.syspath_prepend(tmp_path)
    ran = dzop("--config-dir", str(tmp_path / "conf"), "match=first", "plan=true")
    assert "error: own.cosine.First.kind: found 'match.cosine', which is the package's" in ran.err


METHOD = """# @package _global_
defaults:
  - override /solve: poselib
  - _self_

method: own
solve:
  refit_px: 2.0
"""


def test_a_chosen_variant_loses_the_fields_of_an_own_method_for_another_one(dzop, tmp_path):
    (tmp_path / "conf" / "method").mkdir(parents=True)
    (tmp_path / "conf" / "method" / "own.yaml").write_text(METHOD)
    ran = dzop("--config-dir", str(tmp_path / "conf"), "method=own", "solve=epnp", "plan=true")
    assert ran.status == 0, ran.err


def test_a_matcher_is_one_file_and_one_yaml(dzop, tmp_path, monkeypatch, cache):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "first.py").write_text(MATCHER)
    (tmp_path / "conf" / "match").mkdir(parents=True)
    (tmp_path / "conf" / "match" / "first.yaml").write_text("_target_: elsewhere.first.First\nlayer: 2\n")
    monkeypatch.syspath_prepend(tmp_path)
    ran = dzop("--config-dir", str(tmp_path / "conf"), f"store.root={cache}", "match=first")
    assert ran.status == 0, ran.err
    answers = json.loads((results(tmp_path) / "poses.json").read_text())["answers"]
    assert "warning: match: a class outside the package: cached results are found by its kind, version" in ran.err
    assert {answer["template_id"] for answer in answers if answer["status"] == "estimate"} <= {0}
    assert (
        json.loads((results(tmp_path) / "poses.json").read_text())["config"]["match"]["_target_"]
        == "elsewhere.first.First"
    )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("dataset.K=[1,2]",), "dataset.K: found 2 numbers, needs [fx,fy,cx,cy]"),
        (("dataset.K=[nan,300,160,120]",), "nan"),
        (("dataset.K=[3000,3000,1600,1200]",), "dataset.K"),
        (("dataset.bbox=[100,80,nan,60]",), "dataset.bbox: found [100, 80, nan, 60], needs four finite numbers"),
        (("dataset.bbox=[100,80,60]",), "dataset.bbox: found 3 numbers, needs 4: [x,y,width,height]"),
        (("dataset.bbox=[100,80,0,60]",), "dataset.bbox: found [100, 80, 0, 60], which has no area"),
        (("dataset.K=???",), "dataset.K: found nothing, needs [fx,fy,cx,cy] in pixels"),
        (("dataset.bbox=[900,80,60,60]",), "dataset.bbox: found [900.0, 80.0, 60.0, 60.0]"),
        (("dataset.mesh=nowhere.ply",), "nowhere.ply: found no such file"),
        (("dataset.scale=0.001",), "it looks like metres"),
        (("dataset.mask=both.png",), "dataset: found mask and bbox, needs only one of them"),
        (("dataset.bbox=[0.25,0.5,0.125,0.25]",), "fractions of the image, needs pixels: [80,120,40,60]"),
        (("dataset.bbox=null", "dataset.mask=folder.ply"), "folder.ply: found a folder, needs a readable file"),
        (("dataset.mesh=folder.ply",), "folder.ply: found a folder, needs a mesh file"),
        (("dataset.image=folder.ply",), "folder.ply: found a folder, needs an image"),
        (("dataset.distortion={k1:0.1,k2:0}",), "dataset.distortion: found {'k1': 0.1, 'k2': 0}, needs [k1,k2,p1,p2]"),
    ],
)
def test_a_mistake_in_ones_own_data_is_reported_in_one_line(tmp_path, scene, capsys, monkeypatch, given, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.ply").mkdir()
    frame = scene / "test" / "000001" / "rgb" / "000000.png"
    good = (f"dataset.mesh={scene}/models/obj_000001.ply", f"dataset.image={frame}", "dataset.bbox=[100,80,60,60]")
    camera = () if given[0].startswith("dataset.K") else ("dataset.K=[[300,0,160],[0,300,120],[0,0,1]]",)
    ran = run_dzop(capsys, monkeypatch, "dataset=photo", *SMALL, *good, *camera, *given)
    assert ran.status == 1
    assert len(ran.err.splitlines()) == 1
    assert message in ran.err


def test_cache_commands_list_measure_verify_and_clean(dzop):
    dzop("step=onboard")
    assert "12" in dzop("cache", "ls", "--long").out
    assert "total" in dzop("cache", "du").out
    assert "entries intact, 0 damaged or incomplete" in dzop("cache", "verify").out
    assert dzop("cache", "gc").out == "0 entries, 0 B\n"
    assert dzop("cache", "gc", "--older-than", "0", "--dry-run").out.count("would remove") > 5
    key = dzop("cache", "ls").out.split("/")[-1].strip()
    assert '"recipe"' in dzop("cache", "path", key[:12]).out


def test_help_shows_examples_the_variants_and_where_the_rest_is(capsys, monkeypatch):
    shown = run_dzop(capsys, monkeypatch, "--help").out
    for line in ("dzop doctor, fetch, reproduce, cache", "match: cosine, masked_cosine, oracle, words", "--cfg job"):
        assert line in shown
    examples = shown.split("Examples:")[1].split("Other commands")[0]
    assert len([line for line in examples.splitlines() if line.startswith("  dzop")]) == 5
    assert "gallery: 12" in run_dzop(capsys, monkeypatch, "--cfg", "job").out


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("dataset.name=my_data", "dataset.name: found 'my_data'"),
        ("dataset.name='=cmd|calc!A0'", "dataset.name: found '=cmd|calc!A0'"),
        ("dataset.name=../../x", "dataset.name: found '../../x'"),
        ("method=a/b", None),
        ("dataset.split=../test", "dataset.split: found '../test'"),
    ],
)
def test_a_name_that_no_results_file_can_have_is_refused_first(dzop, tmp_path, override, message):
    ran = dzop(override)
    assert ran.status == 1
    assert len(ran.err.strip().splitlines()) == 1, ran.err
    assert message is None or ran.err.startswith(f"error: {message}, needs at most 80 letters, digits"), ran.err
    assert not list(tmp_path.glob("cache/*/*"))
    assert not (tmp_path / "results").exists()


def test_pictures_are_drawn_again_when_ground_truth_changes(dzop, tmp_path, scene):
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy)
    options = ("overlays=true", "gallery=1", f"dataset.root={copy}")
    assert dzop(*options).status == 0
    pictures = {path: path.read_bytes() for path in results(tmp_path).rglob("*.jpg")}
    assert dzop(*options).counts()[0]["overlays"] == (0, 2)
    path = copy / "test" / "000001" / "scene_gt.json"
    truth = json.loads(path.read_text())
    for instances in truth.values():
        for instance in instances:
            instance["cam_t_m2c"][0] += 30
    path.write_text(json.dumps(truth))
    counts = dzop(*options, "detect=gt_mask").counts()[0]
    assert counts["overlays"] == (2, 0)
    assert counts["gallery"] == (1, 0)
    assert all(path.read_bytes() != before for path, before in pictures.items() if path.parent.name == "overlays")


def test_a_photograph_overwritten_while_templates_are_rendered_is_named(dzop, tmp_path, scene, monkeypatch):
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy)
    image = copy / "test" / "000001" / "rgb" / "000000.png"
    content = image.read_bytes()
    render = Raycast.render

    def overwrite(self, *args):
        if image.read_bytes() == content:
            Image.fromarray(255 - np.array(Image.open(image))).save(image)
        return render(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(Raycast, "render", overwrite)
        ran = dzop("step=estimate", "render=raycast", f"dataset.root={copy}")
    assert ran.status == 1
    assert (
        ran.err
        == f"error: {image}: found a file that changed during the run, needs one that no one writes to; run again"
    )
    image.write_bytes(content)
    assert dzop("step=estimate", "render=raycast", f"dataset.root={copy}").status == 0
    poses = json.loads((results(tmp_path) / "poses.json").read_text())["answers"]
    assert dzop("step=estimate", "render=raycast", "store=memory", "out=other").status == 0
    fresh = json.loads(next(tmp_path.glob("other/*/*/poses.json")).read_text())["answers"]
    assert [a["T_cam_obj"] for a in poses] == [a["T_cam_obj"] for a in fresh]


def test_a_generated_dataset_of_another_version_is_not_used(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    config = DemoConfig(root=str(tmp_path / "demo"), objects=1, images=1, per_image=1)
    first = config.open().root
    assert config.open().root == first
    monkeypatch.setattr(demo, "GENERATOR_VERSION", 2)
    monkeypatch.setattr(scenes, "GENERATOR_VERSION", 2)
    second = config.open().root
    assert second != first
    info = json.loads((second / "dataset_info.json").read_text())
    (second / "dataset_info.json").write_text(json.dumps(info | {"generator": 1}))
    with pytest.raises(
        BadInput, match="field generator: found 1, needs what version 2 of the generator writes: delete"
    ):
        config.open()
    (second / "dataset_info.json").unlink()
    with pytest.raises(BadInput, match="no such file"):
        config.open()
