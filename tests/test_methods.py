"""Every method of the comparison runs by one override, on small random weights of the classes it asks for."""

import json
from pathlib import Path

import pytest
from command import CommandResult, run_dzop
from make_weights import write_weights
from test_sweep_files import composed
from tiny_bop import write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.bop.lint import lint
from pipeline.report.run_records import read_run_records

SMALL = ("render=raycast", "render.count=9", "render.size=96", "overlays=false", "gallery=0", "fallback=true",
         "evaluate.vsd=false")  # fmt: skip
METHODS = {
    "dzop": (),
    "dzop_x": (),
    "dzop_sd": ("extract.input_size=256",),
    "dzop_paper": ("extract=stable_diffusion", "extract.input_size=256"),
    "zs6d": ("extract.input_size=112", "crop.size=112"),
    "foundpose": ("extract.input_size=112", "crop.size=96", "render.inplane=1", "match.count=50"),
    "fusion": ("extract.first.input_size=256", "extract.second.input_size=112"),
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> list[str]:
    return write_weights(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def dzop(capsys, monkeypatch, tmp_path, weights):
    root = write_tiny_bop(tmp_path / "tiny")

    def run(*arguments: str) -> CommandResult:
        where = ("dataset=bop", "dataset.name=tiny", f"dataset.root={root}", f"store.root={tmp_path}/cache",
                 f"out={tmp_path}/results", *weights)  # fmt: skip
        return run_dzop(capsys, monkeypatch, *where, *SMALL, *arguments)

    return run


def detections(path: Path) -> Path:
    """Of a detector: a box for every instance."""
    found = [(0, 1, [10, 10, 14, 16]), (0, 1, [34, 12, 14, 16]), (0, 2, [26, 8, 8, 10]), (3, 2, [28, 18, 10, 10])]
    entries = [
        {"scene_id": 7, "image_id": im, "category_id": obj, "score": 0.9, "bbox": box, "time": 0.1}
        for im, obj, box in found
    ]
    path.write_text(json.dumps(entries))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_method_is_one_override_on_masks_and_on_detections(dzop, tmp_path, method):
    for detect in ((), ("detect=json", f"detect.path={detections(tmp_path / 'found.json')}")):
        ran = dzop(f"method={method}", *METHODS[method], *detect)
        assert ran.status == 0, ran.err
        row = max(read_run_records(tmp_path / "results"), key=lambda row: row.at)
        assert (row.status, row.config["method"]) == ("done", method)
        csv = tmp_path / "results" / row.folder / row.csv
        assert lint(csv, open_dataset(tmp_path / "tiny", name="tiny")).faults == ()


def test_the_numbers_of_zs6d_are_those_of_its_code():
    asked = composed("method=zs6d")
    assert (asked["crop"]["size"], asked["crop"]["padding_ratio"]) == (224, 1.0)
    assert (asked["extract"]["input_size"], asked["extract"]["local_size"], asked["extract"]["stride"]) == (224, 80, 4)
    assert (asked["match"]["layer"], asked["match"]["class_token"], asked["fuse"]["layers"]) == (11, True, [9])
    assert (asked["correspond"]["foreground"], asked["correspond"]["count"]) == ("saliency", 20)
    assert (asked["solve"]["iterations"], asked["solve"]["threshold_px"]) == (100, 8.0)


@pytest.mark.slow
def test_templates_are_rendered_once_for_dzop_and_zs6d(dzop):
    first = dzop("method=dzop", "step=onboard").counts()[-1]
    second = dzop("method=zs6d", "step=onboard", *METHODS["zs6d"]).counts()[-1]
    assert first["templates"] == second["templates"][::-1] == (18, 0)
    assert second["template crops"] == (18, 0)  # a tight crop of its own
    assert second["template features"][0] > 0


def test_a_method_that_needs_saliency_says_who_has_it(dzop):
    ran = dzop("method=dzop", "correspond=salient", "extract=hog")
    assert ran.status == 1
    assert (
        "correspond: found correspond.salient, and extract.hog has no saliency, needs extract=dino or dinov2" in ran.err
    )


def test_a_method_that_compares_class_tokens_says_who_has_them(dzop):
    ran = dzop("method=dzop", "match.class_token=true", "extract=hog")
    assert ran.status == 1
    assert "match.class_token: found true, and extract.hog has no class token, needs extract=dino, or false" in ran.err


CNOS = ("detect=cnos", "detect.proposals.points_per_side=3", "detect.proposals.min_iou=0", "detect.min_score=0",
        "detect.proposals.min_stability=0", "extract@detect.describe=pixels", "detect.describe_layer=8")  # fmt: skip
DETECTIONS = "lmo/detections/sam_lmo-test.json"
RUNS = [
    *((method, "ycbv", 14, ()) for method in ("dzop", "zs6d", "foundpose", "fusion")),
    *((method, "lmo", 1, ()) for method in ("zs6d", "foundpose", "fusion")),
    ("dzop", "lmo", 1, ("detect=json", f"detect.path={{bop_mini}}/{DETECTIONS}")),
    ("dzop", "lmo", 1, CNOS),
]


@pytest.mark.slow
@pytest.mark.parametrize(("method", "name", "obj_id", "detect"), RUNS)
def test_a_method_answers_photographs(
    bop_mini, capsys, monkeypatch, tmp_path, cache, weights, method, name, obj_id, detect
):
    monkeypatch.chdir(tmp_path)
    data = open_dataset(bop_mini / name, name=name)
    im_id = next(target.im_id for target in data.targets if target.obj_id == obj_id)
    asked = (f"dataset={name}", f"dataset.root={bop_mini / name}", f"select.objects=[{obj_id}]",
             f"select.images=[{im_id}]", "render.viewpoints=superfibonacci", f"store.root={cache}")  # fmt: skip
    detect = [override.format(bop_mini=bop_mini) for override in detect]
    ran = run_dzop(capsys, monkeypatch, *asked, *detect, *weights, *SMALL, f"method={method}", *METHODS[method])
    assert ran.status == 0, ran.err
    row = read_run_records(tmp_path / "results")[0]
    assert row.estimates + sum(count for _, _, count in row.failures) == 1
    found = lint(tmp_path / "results" / row.folder / row.csv, data)
    assert row.estimates == found.rows
    assert not [fault for fault in found.faults if "found no estimate" not in fault]
