"""dzop doctor: what it says about the mistakes of docs/doctor.md, and about input that has none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from command import run_dzop
from scipy.spatial.transform import Rotation

from pipeline.cli.doctor import examine, examine_mesh
from pipeline.functional.rigid import rigid
from pipeline.functional.surface import signed_volume
from pipeline.io.meshes import write_ply
from pipeline.items.objects import Mesh, MeshFacts
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic.objects import make_object

K, SIZE_HW = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), (480, 640)
MESH = make_object(3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """mug.ply, shot.png and mask.png that fit together."""
    folder = tmp_path_factory.mktemp("good")
    T = rigid(Rotation.from_euler("xyz", [30, 40, 20], degrees=True).as_matrix(), np.array([20.0, 10, 600]))
    rgb, depth_mm = Raycast().render(MESH, K, T[None], SIZE_HW)
    mask = depth_mm[0] > 0
    write_ply(folder / "mug.ply", MESH)
    PIL.Image.fromarray(np.where(mask[..., None], rgb[0], np.uint8(110))).save(folder / "shot.png")
    PIL.Image.fromarray(mask * np.uint8(255)).save(folder / "mask.png")
    return folder


def findings(folder: Path, *, mesh: str = "mug.ply", image="shot.png", K="600,600,320,240", mask="mask.png", **given):
    return list(examine(str(folder / mesh), str(folder / image), K, str(folder / mask), **given))


def test_good_input_has_nothing_to_do(folder, capsys, monkeypatch):
    found = findings(folder)
    assert [finding for finding in found if finding.level in ("warning", "error")] == []
    (distance,) = [finding for finding in found if finding.about == "distance"]
    assert distance.level == "ok"
    monkeypatch.chdir(folder)
    ran = run_dzop(capsys, monkeypatch, "doctor", "mug.ply", "shot.png", "600,600,320,240", "mask.png")
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.endswith("no problems found\n")


def said(found, text: str):
    lines = [finding.line() for finding in found if finding.level in ("warning", "error", "note")]
    assert any(text in line for line in lines), lines


@pytest.mark.parametrize(
    ("scale", "text"),
    [
        (0.001, "it looks like metres\n                  -> dataset.scale=1"),
        (1000.0, "it looks like micrometres"),
        (0.04, "is the mesh in inches or centimetres?"),
    ],
)
def test_a_unit_that_is_not_millimetres(folder, scale, text):
    said(findings(folder, scale=scale), text)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda m: replace(m, vertices=m.vertices + np.array([400, 0, 0])), "diameters from the middle of the mesh"),
        (lambda m: replace(m, faces=m.faces[:, ::-1]), "turned inside out"),
    ],
)
def test_a_mesh_that_is_away_or_inside_out(change, text):
    said(list(examine_mesh(change(MESH), MeshFacts(100.0, 120.0, 100), 1.0)), text)


def test_a_mesh_without_colours_or_thickness_or_with_millions_of_faces(tmp_path):
    write_ply(tmp_path / "grey.ply", Mesh(MESH.vertices, MESH.faces))
    said(list(examine(str(tmp_path / "grey.ply"))), "it has no colours")
    write_ply(tmp_path / "sheet.ply", Mesh(MESH.vertices * [1, 1, 0], MESH.faces))
    said(list(examine(str(tmp_path / "sheet.ply"))), "it is flat (")
    said(list(examine_mesh(MESH, MeshFacts(100.0, 120.0, 1_200_000), 1.0)), "-> dataset.simplify=200000")


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"K": "1200,1200,640,480"}, "is unusual for an image of 640 x 480"),
        ({"K": "0.9,1.2,0.5,0.5"}, "divided by the image's size"),
        ({"K": "6,6"}, "needs [fx,fy,cx,cy]"),
    ],
)
def test_a_camera_of_another_image(folder, given, text):
    said(findings(folder, **given), text)


def test_masks_that_do_not_fit(folder, tmp_path):
    mask = np.asarray(PIL.Image.open(folder / "mask.png"))
    pieces = np.zeros_like(mask)
    pieces[100:140, 100:140] = pieces[100:140, 200:240] = pieces[300:340, 200:240] = 255
    cases = {
        "found 320 x 240 pixels, needs those of the photograph": mask[::2, ::2],
        "touches all sides\n                  -> invert the mask": 255 - mask,
        "empty\n                  -> paint the object's pixels white": mask * 0,
        "3 separate pieces": pieces,
    }
    for text, values in cases.items():
        PIL.Image.fromarray(values).save(tmp_path / "mask.png")
        given = [str(folder / "mug.ply"), str(folder / "shot.png"), "600,600,320,240", str(tmp_path / "mask.png")]
        said(list(examine(*given)), text)
    PIL.Image.fromarray(np.zeros((*SIZE_HW, 3), np.uint8)).save(tmp_path / "dark.png")
    said(list(examine(str(folder / "mug.ply"), str(tmp_path / "dark.png"), "600,600,320,240")), "very dark")


def test_units_of_the_mesh_are_those_of_a_run(folder, tmp_path):
    write_ply(tmp_path / "metres.ply", Mesh(MESH.vertices / 1000, MESH.faces, MESH.colours))
    given = (str(tmp_path / "metres.ply"), str(folder / "shot.png"), "600,600,320,240", str(folder / "mask.png"))
    said(list(examine(*given)), "it looks like metres")
    for units in ("m", "auto"):
        assert [f for f in examine(*given, units=units) if f.level in ("warning", "error")] == []


def test_a_box_instead_of_a_mask(folder):
    given = (str(folder / "mug.ply"), str(folder / "shot.png"), "600,600,320,240")
    rows, columns = np.nonzero(np.asarray(PIL.Image.open(folder / "mask.png")))
    inside = f"{columns.min()},{rows.min()},{np.ptp(columns)},{np.ptp(rows)}"
    found = list(examine(*given, bbox=inside))
    assert [finding.about for finding in found][-2:] == ["box", "distance"]
    assert [finding for finding in found if finding.level in ("warning", "error")] == []
    said(list(examine(*given, bbox="300,200,640,480")), "of it lies outside the image")
    said(list(examine(*given, bbox="900,200,40,40")), "of a box inside the image")


def test_a_depth_image_of_another_unit_or_with_holes(folder, tmp_path):
    mask = np.asarray(PIL.Image.open(folder / "mask.png")) > 0
    given = (str(folder / "mug.ply"), str(folder / "shot.png"), "600,600,320,240", str(folder / "mask.png"))
    path = tmp_path / "depth.png"
    PIL.Image.fromarray((mask * 6000).astype(np.uint16)).save(path)  # tenths of a millimetre
    said(list(examine(*given, depth=str(path))), "-> dataset.depth_scale=0.1 times the present one fits")
    assert [f for f in examine(*given, depth=str(path), depth_scale=0.1) if f.level in ("warning", "error")] == []
    PIL.Image.fromarray(np.zeros(SIZE_HW, np.uint16)).save(path)
    said(list(examine(*given, depth=str(path))), "known in 0% of the object")


def test_a_missing_file_is_an_error_and_the_exit_status(folder, capsys, monkeypatch):
    ran = run_dzop(capsys, monkeypatch, "doctor", str(folder / "none.ply"))
    assert ran.status == 1
    assert "none.ply: found no such file" in ran.out


def test_signed_volume_of_a_cube():
    corners = np.array([[x, y, z] for x in (0, 2) for y in (0, 2) for z in (0, 2)], float) + 50
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                      [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    assert signed_volume(corners, faces) == pytest.approx(8)
    assert signed_volume(corners, faces[:, ::-1]) == pytest.approx(-8)
