"""Real photographs and meshes from the command line: every target gets a pose or a reason, and a picture."""

import json

import numpy as np
import PIL.Image
import pytest
from command import run_dzop

from pipeline.bop.results import read_results

QUICK = (
    "method=dzop",
    "extract=hog",
    "render.viewpoints=fibonacci",
    "render.count=30",
    "render.size=128",
    "runtime.progress=false",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "chosen", "targets", "images"),
    [("ycbv", (), 6, 2), ("lmo", ("select.images=[3,438]", "select.objects=[1,8]"), 4, 2)],
)
def test_every_target_has_a_pose_or_a_reason(bop_mini, capsys, monkeypatch, tmp_path, name, chosen, targets, images):
    monkeypatch.chdir(tmp_path)
    ran = run_dzop(capsys, monkeypatch, f"dataset={name}", f"dataset.root={bop_mini / name}", *QUICK, *chosen)
    assert ran.status == 0, ran.err
    folder = next(tmp_path.glob(f"results/dzop-hog-gt-mask_{name}-test/*"))
    answers = json.loads((folder / "poses.json").read_text())["answers"]
    asked = json.loads((bop_mini / name / "test_targets_bop19.json").read_text())
    shown = {(a["scene_id"], a["im_id"], a["obj_id"]) for a in answers}
    wanted = {(t["scene_id"], t["im_id"], t["obj_id"]) for t in asked}
    assert shown <= wanted
    assert len(shown) == len(answers) == targets
    rows = read_results(folder / f"dzop-hog-gt-mask_{name}-test.csv")
    assert len(rows) == sum(a["status"] == "estimate" for a in answers)
    assert all(a["status"] == "estimate" or a["reason"] for a in answers)
    pictures = sorted((folder / "overlays").glob("*.jpg"))
    assert len(pictures) == images
    # outlines and boxes change the photograph, and only a part of it
    drawn = np.asarray(PIL.Image.open(pictures[0]).resize((640, 480)), float)
    photo = bop_mini / name / "test" / pictures[0].stem[:6] / "rgb" / f"{pictures[0].stem[7:]}.png"
    changed = np.abs(drawn - np.asarray(PIL.Image.open(photo), float)).max(-1) > 60
    assert 0.002 < changed.mean() < 0.2


@pytest.mark.slow
def test_hog_with_the_papers_views_finds_an_object_near_where_it_is(bop_mini, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    chosen = (
        "method=dzop",
        "extract=hog",
        "select.objects=[5]",
        "overlays=false",
        "render.size=128",
        "runtime.progress=false",
    )
    targets = json.loads((bop_mini / "lmo" / "test_targets_bop19.json").read_text())
    images = sorted({target["im_id"] for target in targets if target["obj_id"] == 5})[::2]
    run_dzop(capsys, monkeypatch, "dataset=lmo", f"dataset.root={bop_mini / 'lmo'}", f"select.images={images}", *chosen)
    record = json.loads(next(tmp_path.glob("results/*/*/poses.json")).read_text())
    relative = [a["errors"]["mssd_mm"] / a["errors"]["diameter_mm"] for a in record["answers"] if a.get("errors")]
    assert len(relative) >= 19
    # at 256 px a median of 0.14 of the diameter was measured; a broken convention gives 1 and more
    assert np.median(relative) < 0.3
