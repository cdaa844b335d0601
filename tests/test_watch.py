"""dzop watch: new photographs become poses; incomplete files are waited for; Ctrl-C ends it."""

import json
import shutil
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from command import run_dzop

from benchmarks.video import make_video
from pipeline.bop.photo import find_photograph
from pipeline.cli import watch
from pipeline.io.meshes import write_ply
from pipeline.synthetic.objects import make_object

SMALL = ("extract=hog", "render.count=60", "render.size=96", "runtime.device=cpu", "runtime.progress=false")


@pytest.fixture(scope="module")
def taken(tmp_path_factory) -> Path:
    """mug.ply, and two photographs in ready/ with masks in masks/; templates are cached in cache/."""
    folder = tmp_path_factory.mktemp("watch")
    write_ply(folder / "mug.ply", make_object(3))
    for name in ("ready", "masks", "shots"):
        (folder / name).mkdir()
    for n, frame in enumerate(make_video(make_object(3), count=2)):
        PIL.Image.fromarray(frame.rgb).save(folder / "ready" / f"{n}.png")
        PIL.Image.fromarray(frame.mask * np.uint8(255)).save(folder / "masks" / f"{n}.png")
    return folder


def arguments(taken: Path, *more: str) -> tuple[str, ...]:
    given = (f"dataset.mesh={taken}/mug.ply", "dataset.K=[600,600,320,240]", f"dataset.mask={taken}/masks")
    return ("watch", f"{taken}/shots", *given, *SMALL, f"store.root={taken}/cache", *more)


def test_photographs_become_poses_when_they_are_complete(taken, capsys, monkeypatch):
    whole = (taken / "ready" / "0.png").read_bytes()
    looks = []

    def work(seconds: float) -> None:
        """What happens in the folder between two looks."""
        looks.append(sorted(path.name for path in (taken / "out").glob("*/pose.json")))
        if len(looks) == 1:
            (taken / "shots" / "0.png").write_bytes(whole[: len(whole) // 2])
        elif len(looks) == 3:
            (taken / "shots" / "0.png").write_bytes(whole)
        elif len(looks) == 6:
            shutil.copy(taken / "ready" / "1.png", taken / "shots")
        elif len(looks) == 9:
            raise KeyboardInterrupt

    monkeypatch.setattr(watch.time, "sleep", work)
    ran = run_dzop(capsys, monkeypatch, *arguments(taken, "dataset.video=true", "--out", f"{taken}/out"))
    assert ran.status == 0, ran.err
    first, *poses, last = ran.out.splitlines()
    assert first == f"watching {taken}/shots; stop with Ctrl-C"
    assert [line.split(":")[0] for line in poses] == ["0.png", "1.png"]
    assert last == f"stopped: 2 photographs, results in {taken}/out"
    assert ran.err == ""
    for name in ("0", "1"):
        (pose,) = json.loads((taken / "out" / name / "pose.json").read_text())["poses"]
        assert 650 < pose["T_cam_obj"][2][3] < 750
        assert (taken / "out" / name / "pose.html").is_file()
    assert (taken / "out" / "latest").resolve().name == "1"


def test_a_file_that_stays_unreadable_is_one_line_and_the_others_go_on(taken, capsys, monkeypatch):
    monkeypatch.setattr(watch, "PATIENCE_S", 0.0)
    (taken / "shots" / "0.png").write_bytes((taken / "ready" / "0.png").read_bytes())
    (taken / "shots" / "a.png").write_bytes(b"no image")
    shutil.copy(taken / "masks" / "0.png", taken / "masks" / "a.png")
    ran = run_dzop(capsys, monkeypatch, *arguments(taken, "--once", "--every", "0.01", "--out", f"{taken}/more"))
    assert ran.status == 0
    assert ran.err.startswith("a.png: error: ")
    assert "Traceback" not in ran.err
    assert (taken / "more" / "0" / "pose.json").is_file()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("dataset.mask=null",), "dataset: found neither of mask and bbox, needs dataset.mask=FOLDER of masks"),
        (("dataset.K=none",), "dataset.K: found nothing, needs [fx,fy,cx,cy] in pixels"),
        (("dataset.depth=d.png",), "dataset.depth: found with watch"),
    ],
)
def test_what_cannot_be_watched_is_refused_at_once(taken, capsys, monkeypatch, more, message):
    ran = run_dzop(capsys, monkeypatch, *arguments(taken, *more))
    assert message in str(ran.err)


def test_a_mask_belongs_to_the_photograph_with_the_longest_name_that_fits():
    photos = [Path("shots", name) for name in ("a.png", "a_b.png", "ab.jpg")]
    masks = ("a.png", "a_left.png", "a_b.png", "a_b_left.png", "ab_1.png", "b.png")
    assert [find_photograph(Path("masks", name), photos) for name in masks] == ["a", "a", "a_b", "a_b", "ab", None]
