"""Messages about layers, weights, failed jobs, suspicious masks, and after Ctrl-C."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command import CommandResult, restore_signals, run_dzop
from make_vit import write_vit
from PIL import Image

from pipeline.cli.sweep import failures_text, same_answers_text
from pipeline.report.run_records import read_run_records, unresolved_failures
from pipeline.synthetic.scenes import write_dataset

SMALL = ("render.count=6", "render.size=64", "method=dzop", "extract=hog", "overlays=false", "gallery=0",
         "runtime.progress=false", "runtime.device=cpu", "evaluate.vsd=false")  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("messages") / "scene"
    write_dataset(root, objects=1, images=1, seed=3, size_hw=(120, 160), per_image=1, progress=False)
    return root


@pytest.fixture
def dzop(capsys, monkeypatch, tmp_path, scene):
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str, flags: tuple[str, ...] = ()) -> CommandResult:
        dataset = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}")
        return run_dzop(capsys, monkeypatch, *flags, *dataset, *SMALL, *arguments)

    return run


def test_an_unknown_layer_is_reported_with_the_layers_its_field_takes(dzop, tmp_path):
    weights = write_vit(tmp_path / "vit")
    for field, value in (("match.layer", "40"), ("fuse.layers", "[40]")):
        ran = dzop("extract=dino", f"weights.dino={weights}", "fuse.layers=[1]", "match.layer=1", f"{field}={value}")
        assert f"error: {field}: found 40, needs 0.." in ran.err
        assert ran.err.strip().endswith("blocks")


@pytest.mark.parametrize(
    ("choice", "field", "name"),
    [
        ("extract=stable_diffusion", "extract.weights", "stable_diffusion"),
        ("extract=dino", "extract.weights", "dino"),
        ("extract=dinov2", "extract.weights", "dinov2"),
        ("detect=cnos", "detect.proposals.weights", "sam"),
    ],
)
def test_missing_weights_are_reported_with_the_field_that_sets_them(dzop, choice, field, name):
    detector = ("extract@detect.describe=hog", "detect.describe_layer=8") if name == "sam" else ()
    ran = dzop(choice, *detector, f"weights.{name}=./nowhere")
    (line,) = ran.err.strip().splitlines()
    assert line.startswith(f"error: {field}: found './nowhere'")
    assert f"weights.{name}=FOLDER sets it for all methods" in line


def test_a_failure_is_resolved_by_a_rerun_with_other_weights(dzop, tmp_path):
    weights = write_vit(tmp_path / "vit")
    jobs = ("extract=dino", "fuse.layers=[1]", "match.layer=1", "cluster.count=3,4")
    assert dzop(*jobs, "weights.dino=./nowhere", flags=("-m",)).status == 1
    rows = read_run_records(tmp_path / "results")
    assert [row.config["cluster"]["count"] for row in unresolved_failures(rows)] == [3, 4]
    assert dzop(*jobs[:3], "cluster.count=4", f"weights.dino={weights}").status == 0
    rows = read_run_records(tmp_path / "results")
    assert [row.config["cluster"]["count"] for row in unresolved_failures(rows)] == [3]


def test_the_last_line_of_a_sweep_is_short():
    command = ["dzop", "-m", "dataset=lmo", "a=1,2,3,4,5"]
    failed = [(["dataset=lmo", f"a={n}"], "weights: found nothing") for n in range(5)]
    assert failures_text(failed[:2], command) == "a=0, a=1 (weights: found nothing)"
    assert failures_text(failed, command) == "a=0, a=1, a=2, and 2 more, see above (weights: found nothing)"
    others = failures_text([(["dataset=lmo", f"a={n}"], f"{n}: " + "word " * 500) for n in range(9)], command)
    assert len(others) < 1000
    assert others.endswith("; and 6 more, see above")


def inside(row: int, column: int, h: int, w: int) -> np.ndarray:
    mask = np.zeros((120, 160), np.uint8)
    mask[row : row + h, column : column + w] = 255
    return mask


@pytest.fixture
def photo(capsys, monkeypatch, tmp_path, scene):
    """A run on one photograph of the scene; the mesh, the photograph and K are given."""
    monkeypatch.chdir(tmp_path)
    mesh, image = f"dataset.mesh={scene}/models/obj_000001.ply", f"dataset.image={scene}/test/000001/rgb/000000.png"

    def run(*given: str) -> CommandResult:
        return run_dzop(capsys, monkeypatch, "dataset=photo", mesh, image, "dataset.K=[150,150,80,60]", *SMALL, *given)

    return run


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (inside(60, 80, 1, 1), "the mask has 1 pixel;"),
        (inside(0, 0, 120, 160), "the mask covers 100% of the image;"),
        (255 - inside(40, 50, 40, 50), "the mask covers 90% of the image; is it the object's, and not inverted?"),
    ],
    ids=["a pixel", "everything", "inverted"],
)
def test_a_suspicious_mask_is_warned_about_and_recorded(photo, tmp_path, mask, message):
    Image.fromarray(mask).save("mask.png")
    ran = photo("dataset.mask=mask.png")
    assert "Traceback" not in ran.err
    assert f"warning: 000000.png, obj_000001: {message}" in ran.out
    record = json.loads(next(tmp_path.glob("results/*/*/poses.json")).read_text())
    (warning,) = record["warnings"]
    assert message in warning


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("dataset.bbox=[40,30,130,100]",), "of the box lies outside the image; is it x, y, width, height"),
        (("dataset.bbox=[40,30,60,60]", "dataset.K=[300,300,170,90]"), "K [300, 300, 170, 90] is unusual"),
        (("dataset.bbox=[40,30,60,60]", "dataset.K=[80,60,75,150]"), "K [80, 60, 75, 150] is unusual"),
        (("dataset.bbox=[40,30,60,60]",), ""),
    ],
    ids=["corners", "larger image", "swapped", "as it should be"],
)
def test_a_suspicious_box_or_camera_is_warned_about(photo, given, message):
    ran = photo(*given)
    assert ran.status == 0, ran.err
    assert message in ran.out
    assert ran.out.count("warning:") == (2 if message else 0)  # before and after the pose


@pytest.mark.parametrize(
    ("given", "step"),
    [("solve.min_inliers=100000", "all"), ("solve.threshold_px=1e-6", "all"), ("solve.min_inliers=100000", "estimate")],
)
def test_a_photograph_without_a_pose_ends_with_its_reason(photo, tmp_path, given, step):
    ran = photo("dataset.bbox=[40,30,60,60]", given, f"step={step}")
    assert ran.status == 1
    (line,) = ran.err.strip().splitlines()
    (answer,) = json.loads(next(tmp_path.glob("results/*/*/poses.json")).read_text())["answers"]
    reason = f"object 1: {answer['stage']}: {answer['reason']}"
    assert line == f"error: found no pose, needs one ({reason}); poses.json has the reasons"
    assert list(tmp_path.glob("results/*/*/*.csv"))


def test_a_fallback_is_a_photographs_pose(photo):
    ran = photo("dataset.bbox=[40,30,60,60]", "solve.min_inliers=100000", "fallback=true")
    assert ran.status == 0, ran.err


DETECTION = {"scene_id": 1, "image_id": 0, "category_id": 1, "score": 0.9, "bbox": [40, 30, 60, 60], "time": 0.1}


@pytest.mark.parametrize(
    ("changed", "reason", "step"),
    [
        ({"segmentation": {"size": [120, 160], "counts": [120 * 160]}}, "mask is empty", "detect"),
        ({"segmentation": {"size": [3, 3], "counts": [9]}}, "mask of [3, 3] where the image is [120, 160]", "estimate"),
        ({"bbox": [40, 30, 0, 60]}, "bbox [40, 30, 0, 60] has no area", "detect"),
        ({"score": None}, "score is null, not a finite number", "detect"),
    ],
)
def test_a_file_without_a_usable_detection_is_an_error_that_lists_why(dzop, tmp_path, changed, reason, step):
    Path("found.json").write_text(json.dumps([DETECTION | changed] * 2))
    for _ in range(2):  # the second finds them in the store
        ran = dzop("detect=json", "detect.path=found.json", "detect.keep=all", f"step={step}")
        assert ran.status == 1
        (line,) = ran.err.strip().splitlines()
        assert line.startswith("error: found.json: found 2 detections of targets and none that is usable: 2 x ")
        assert f"2 x {reason}" in line
        assert "(scene 1, image 0, object 1)" in line
    assert not list(tmp_path.glob("results/*/*"))


@pytest.mark.parametrize("broken", [b"", b"no image", None])
def test_annotated_masks_of_which_none_is_readable_are_an_error(dzop, tmp_path, scene, broken):
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy)
    (mask,) = copy.glob("test/000001/mask_visib/*.png")
    if broken is None:
        Image.fromarray(np.zeros((7, 7), np.uint8)).save(mask)
    else:
        mask.write_bytes(broken)
    ran = dzop(f"dataset.root={copy}", "step=detect")
    assert ran.status == 1
    assert "found 1 detections of targets and none that is usable: 1 x " in ran.err
    assert len(ran.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([DETECTION], "found.json: no entry has a mask"),
        ([{k: v for k, v in DETECTION.items() if k != "score"}], "found.json: no entry has a score"),
        ([], "found.json: the file has no detections"),
        ([DETECTION | {"bbox": [0, 0, 160, 120]}], "the box covers 100% of the image"),
    ],
)
def test_step_detect_prints_the_warnings_of_file_and_detections(dzop, entries, message):
    Path("found.json").write_text(json.dumps(entries))
    ran = dzop("detect=json", "detect.path=found.json", "step=detect")
    assert ran.status == 0, ran.err
    assert message in ran.out
    assert set(ran.counts()[0]) <= {"detections"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("dataset.bbox=[1,2,3]", "error: dataset.bbox: found 3 numbers, needs 4: [x,y,width,height]"),
        (
            "dataset.msk=a",
            "error: Could not override 'dataset.msk': found no such field, needs one that dzop --cfg job lists",
        ),
        (
            "dataset.mask=my(mask.png",
            """'my(mask.png': a value with special characters needs both kinds of quotes, as 'dataset.image=""",
        ),
    ],
)
def test_an_unreadable_field_is_reported_with_what_it_needs(photo, given, message):
    ran = photo(given)
    assert ran.status == 1
    assert message in ran.err
    assert len(ran.err.strip().splitlines()) == 1


def test_an_ordinary_mask_causes_no_warning(dzop, tmp_path):
    assert "warning:" not in dzop().out
    assert json.loads(next(tmp_path.glob("results/*/*/poses.json")).read_text())["warnings"] == []


INTERRUPTED = """
import pipeline.__main__ as command
async def read(): pass
def run():
    pending = read()
    raise KeyboardInterrupt
command._run_jobs = run
command.main()
"""


def test_ctrl_c_prints_one_line():
    ran = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=120, check=False)
    assert ran.stderr == "interrupted. Completed entries are cached; rerun to resume.\n"


def test_ctrl_c_during_imports_prints_no_traceback(tmp_path):
    command = [sys.executable, "-m", "pipeline", "step=detect"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=restore_signals
    )
    maps = Path(f"/proc/{process.pid}/maps")
    until = time.monotonic() + 30
    while "libtorch" not in maps.read_text() and time.monotonic() < until:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode in (-signal.SIGINT, 1)
    assert b"Traceback" not in out + err


def test_a_sweep_that_changed_no_answer_is_noted():
    def note(*jobs: tuple[str, str]) -> str:
        return same_answers_text([(f"dataset=lmo {overrides}".split(), answers) for overrides, answers in jobs])

    said = "changed no answer: all 2 jobs gave the same poses and scores"
    assert note(("a=1", "x"), ("a=2", "x")) == f"note: a {said}"
    assert note(("a=1 b=1", "x"), ("a=2 b=2", "x")) == f"note: a and b {said}"
    assert note(("a=1", "x"), ("a=2", "y")) == ""
    assert note(("a=1", "x")) == ""
    assert note(("evaluate.theta_max=0.1", "x"), ("evaluate.theta_max=0.2", "x")) == ""


def test_detections_and_settings_without_effect_are_named_at_the_start_and_recorded(dzop, tmp_path):
    ran = dzop("match.top_k=9", "cluster=one", "correspond.per_cluster=5")
    assert ran.status == 0, ran.err
    start, record = (
        ran.out.split("scene  image")[0],
        json.loads(next(tmp_path.glob("results/*/*/poses.json")).read_text()),
    )
    for said in (
        "match.top_k 9 is more than the 6 templates",
        "correspond.per_cluster 5 has no effect with cluster=one",
    ):
        assert said in start + ran.err
        assert any(said in warning for warning in record["warnings"])
    assert "ground-truth masks (oracle), renderer" in start
    assert record["detections"] == "ground-truth masks (oracle)"
    assert next(tmp_path.glob("results/*/*/*.csv")).name == "dzop-hog-gt-mask_toy-test.csv"
    (row,) = read_run_records(tmp_path / "results")
    assert row.detections == "ground-truth masks (oracle)"
