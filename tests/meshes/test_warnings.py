"""What is said of a mesh is said by every run: cached, planned, or with templates of an older version."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command import run_dzop
from PIL import Image
from tiny_bop import edit_json, write_tiny_bop

from pipeline.graph import checks
from pipeline.io.meshes import simplify
from pipeline.items.objects import ObjectModel

SMALL = ("method=dzop", "extract=hog", "render.count=4", "render.size=48", "crop.size=64", "overlays=false",
         "gallery=0", "runtime.progress=false", "runtime.device=cpu", "step=estimate", "threads=1")  # fmt: skip


def write_plain_stl(folder: Path) -> Path:
    trimesh.creation.box((40, 60, 20)).export(folder / "plain.stl")
    return folder / "plain.stl"


def write_obj_without_its_material(folder: Path) -> Path:
    text = trimesh.creation.box((40, 60, 20)).export(file_type="obj", include_normals=False)
    (folder / "lost.obj").write_text(text.replace("\nf ", "\nusemtl paint\nf ", 1))
    return folder / "lost.obj"


def write_ply_with_grey_levels(folder: Path) -> Path:
    box = trimesh.creation.box((40, 60, 20))
    rows = [" ".join(f"{x:g}" for x in v) + " 200" for v in box.vertices]
    rows += [f"3 {a} {b} {c}" for a, b, c in box.faces]
    head = ["ply", "format ascii 1.0", "element vertex 8", *(f"property float {axis}" for axis in "xyz")]
    head += ["property uchar intensity", "element face 12", "property list uchar int vertex_indices", "end_header"]
    (folder / "grey.ply").write_text("\n".join([*head, *rows, ""]))
    return folder / "grey.ply"


def write_gltf_that_glows(folder: Path) -> Path:
    material = trimesh.visual.material.PBRMaterial(emissiveTexture=Image.new("RGB", (8, 8), (9, 99, 9)))
    visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    trimesh.Trimesh(*_box(), visual=visual, process=False).export(folder / "glow.glb")
    return folder / "glow.glb"


def write_ball_with_a_stray_face(folder: Path) -> Path:
    ball = trimesh.creation.icosphere(3, 30)
    far = len(ball.vertices) + np.arange(3)
    vertices = np.concatenate([ball.vertices, [[200, 0, 0], [202, 0, 0], [200, 2, 0]]])
    trimesh.Trimesh(vertices, np.concatenate([ball.faces, far[None]]), process=False).export(folder / "stray.stl")
    return folder / "stray.stl"


def _box():
    box = trimesh.creation.box((40, 60, 20))
    return box.vertices, box.faces


CASES = {
    "colours": (write_plain_stl, "it has no colours, so templates are grey"),
    "material": (write_obj_without_its_material, "its material 'paint' is in no material file"),
    "properties": (write_ply_with_grey_levels, "its properties intensity are not read as colours"),
    "stray": (write_ball_with_a_stray_face, "1 face, 0.00018 of its surface, enlarge it from 104 to 247 mm"),
    "glow": (write_gltf_that_glows, "its material has a texture that glows"),
}


@pytest.fixture
def dzop(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (96, 128, 3), np.uint8)).save("shot.png")

    def run(mesh: Path, *arguments: str):
        given = (f"dataset.mesh={mesh}", "dataset.image=shot.png", "dataset.K=[150,150,64,48]")
        return run_dzop(capsys, monkeypatch, "dataset=photo", *given, "dataset.bbox=[40,30,40,40]", *SMALL, *arguments)

    return run


def recorded() -> list[str]:
    (path,) = Path("results").rglob("poses.json")
    return json.loads(path.read_text())["warnings"]


@pytest.mark.parametrize("name", CASES)
def test_a_cached_run_says_what_the_first_one_said(name, dzop, tmp_path, monkeypatch):
    write, text = CASES[name]
    mesh = write(tmp_path)
    planned = dzop(mesh, "plan=true")
    assert f"warning: mesh of {mesh.stem}: {text}" in planned.out, planned.err
    first = dzop(mesh)
    assert first.status == 0, first.err
    assert f"warning: mesh of {mesh.stem}: {text}" in first.out
    said = recorded()
    assert any(text in warning for warning in said)
    with monkeypatch.context() as patch:
        patch.setattr(ObjectModel, "__init__", lambda *given, **more: pytest.fail("a mesh was prepared"))
        second = dzop(mesh)
    assert second.status == 0, second.err
    assert second.counts()[0]["templates"][0] == 0
    assert f"warning: mesh of {mesh.stem}: {text}" in second.out
    assert recorded() == said


def test_templates_without_facts_of_their_mesh_are_no_reason_for_silence(dzop, tmp_path, monkeypatch):
    """As older versions stored them."""
    mesh = write_plain_stl(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.graph.templates.asdict", lambda facts: None)
        assert dzop(mesh).status == 0
    before = recorded()
    second = dzop(mesh)
    assert second.counts()[0]["templates"][0] == 0
    assert "it has no colours" in second.out
    assert recorded() == before


def test_other_diameters_of_models_info_are_said_by_cached_runs(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    root = write_tiny_bop(tmp_path / "tiny")
    edit_json(root / "models" / "models_info.json", lambda infos: infos["1"].update(diameter=120.0))
    given = ("dataset=bop", "dataset.name=tiny", f"dataset.root={root}", *SMALL)
    first, second = (run_dzop(capsys, monkeypatch, *given) for _ in range(2))
    assert second.counts()[0]["templates"][0] == 0
    for ran in (first, second):
        assert "where models_info.json says 120" in ran.out, ran.err
        assert "mesh of objects 1, 2: it has no colours" in ran.out


def test_a_mesh_of_more_than_ten_metres_is_said(dzop, tmp_path):
    ran = dzop(write_plain_stl(tmp_path), "dataset.scale=1000", "plan=true")
    assert ran.status == 0, ran.err
    assert " m: is it in millimetres, and dataset.scale for another unit?" in ran.out
    assert "is it in millimetres" not in dzop(write_plain_stl(tmp_path), "plan=true").out


def test_a_mesh_of_many_faces_is_said_to_cost_time(dzop, tmp_path, monkeypatch):
    mesh = write_plain_stl(tmp_path)
    monkeypatch.setattr(checks, "MANY_FACES", 11)
    monkeypatch.setattr(simplify, "_MEASURED", 1000)
    for arguments in (("plan=true",), (), ()):
        ran = dzop(mesh, *arguments)
        assert ran.status == 0, ran.err
        assert "million faces: about" in ran.out
        assert "dataset.simplify=200000" in ran.out
    assert "million faces" not in dzop(mesh, "dataset.simplify=12").out
    simplified = dzop(mesh, "dataset.simplify=8")
    assert "simplified from 12 to " in simplified.out
    assert "simplified from 12 to " in dzop(mesh, "dataset.simplify=8").out
