import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import BadInput
from pipeline.io.meshes import diameter_mm, read_mesh
from pipeline.stages.render.raycast import render_depth
from pipeline.synthetic.demo import DemoConfig
from pipeline.synthetic.layout import OCCLUDED
from pipeline.synthetic.scenes import write_dataset

SMALL = {"objects": 3, "images": 4, "seed": 7, "size_hw": (240, 320), "per_image": 3, "progress": False}


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("synthetic") / "data"
    write_dataset(path, **SMALL)
    return path


def scene_json(root: Path, name: str) -> dict:
    return json.loads((root / "test" / "000001" / f"{name}.json").read_text())


def image(root: Path, folder: str, name: str) -> np.ndarray:
    return np.asarray(Image.open(root / "test" / "000001" / folder / f"{name}.png"))


def instances(root: Path):
    """(image, index, pose, info, camera) of every instance."""
    infos, cameras = scene_json(root, "scene_gt_info"), scene_json(root, "scene_camera")
    for im_id, poses in scene_json(root, "scene_gt").items():
        for index, pose in enumerate(poses):
            yield int(im_id), index, pose, infos[im_id][index], cameras[im_id]


def test_same_seed_same_bytes_and_another_seed_other_bytes(root, tmp_path):
    write_dataset(tmp_path / "again", **SMALL)
    names = sorted(p.relative_to(root) for p in root.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*") if p.is_file())
    for name in names:
        assert (root / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    write_dataset(tmp_path / "other", **(SMALL | {"seed": 8, "images": 1}))
    first = Path("test/000001/rgb/000000.png")
    assert (tmp_path / "other" / first).read_bytes() != (root / first).read_bytes()


def test_ground_truth_is_exact(root):
    """A model drawn at its written pose gives the written silhouette, and the written depth where it is visible."""
    count = 0
    for im_id, index, pose, info, camera in instances(root):
        mesh = read_mesh(root / "models" / f"obj_{pose['obj_id']:06d}.ply")
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.reshape(pose["cam_R_m2c"], (3, 3)), pose["cam_t_m2c"]
        depth = render_depth(mesh, np.reshape(camera["cam_K"], (3, 3)), T[None], (240, 320))[0]
        mask, visible = (image(root, f, f"{im_id:06d}_{index:06d}") > 0 for f in ("mask", "mask_visib"))
        np.testing.assert_array_equal(depth > 0, mask)
        stored = image(root, "depth", f"{im_id:06d}").astype(float) * camera["depth_scale"]
        np.testing.assert_allclose(stored[visible], depth[visible], atol=0.051)  # units of 0.1 mm, rounded
        assert (stored[mask & ~visible] < depth[mask & ~visible]).all()
        assert info["px_count_all"] == info["px_count_valid"] == mask.sum()
        assert info["px_count_visib"] == visible.sum()
        assert info["visib_fract"] == visible.sum() / mask.sum()
        x, y, w, h = info["bbox_visib"]
        assert visible[y : y + h, x : x + w].sum() == visible.sum()
        assert visible[y].any()
        assert visible[:, x + w - 1].any()
        assert 450 < pose["cam_t_m2c"][2] < 1100
        count += 1
    assert count == 12


def test_half_of_the_instances_are_occluded_as_requested_and_the_others_free(root, tmp_path):
    seen = np.array([info["visib_fract"] for *_, info, _ in instances(root)])
    hidden = (seen >= OCCLUDED[0]) & (seen <= OCCLUDED[1])
    assert hidden.sum() == 6
    assert (seen[~hidden] > 0.96).all()
    write_dataset(tmp_path / "free", **(SMALL | {"occluded": 0.0, "images": 2}))
    assert min(info["visib_fract"] for *_, info, _ in instances(tmp_path / "free")) > 0.96


def test_no_silhouette_touches_the_border(root):
    for im_id, index, *_ in instances(root):
        mask = image(root, "mask", f"{im_id:06d}_{index:06d}") > 0
        mask[1:-1, 1:-1] = False
        assert not mask.any()


def test_objects_stand_out_from_the_wall_and_images_differ(root):
    pictures = [image(root, "rgb", f"{k:06d}").astype(float) for k in range(4)]
    assert all(p.shape == (240, 320, 3) and p.std() > 20 for p in pictures)
    assert min(np.abs(a - b).mean() for i, a in enumerate(pictures) for b in pictures[:i]) > 15


def test_models_info_targets_and_cameras_fit_the_files(root):
    info = json.loads((root / "models" / "models_info.json").read_text())
    assert sorted(info) == ["1", "2", "3"]
    for obj_id, entry in info.items():
        mesh = read_mesh(root / "models" / f"obj_{int(obj_id):06d}.ply")
        assert entry["diameter"] == pytest.approx(diameter_mm(mesh), rel=1e-12)
        low = [entry[f"min_{axis}"] for axis in "xyz"]
        np.testing.assert_array_equal(low, mesh.vertices.min(axis=0))
        np.testing.assert_array_equal([entry[f"size_{axis}"] for axis in "xyz"], np.ptp(mesh.vertices, axis=0))
        assert mesh.colours is not None
    targets = json.loads((root / "test_targets_bop19.json").read_text())
    asked = {(t["im_id"], t["obj_id"]) for t in targets}
    assert asked == {(im_id, pose["obj_id"]) for im_id, _, pose, *_ in instances(root)}
    assert {t["inst_count"] for t in targets} == {1}
    assert {t["scene_id"] for t in targets} == {1}
    assert len({tuple(camera["cam_K"]) for *_, camera in instances(root)}) == 4


def test_a_folder_that_is_not_empty_is_refused_and_unchanged(root):
    before = sorted(p.name for p in root.iterdir())
    with pytest.raises(BadInput, match="needs a new or empty folder"):
        write_dataset(root, **SMALL)
    assert sorted(p.name for p in root.iterdir()) == before


def test_a_killed_run_leaves_no_dataset(tmp_path):
    code = "import sys; from pathlib import Path; from pipeline.synthetic.scenes import write_dataset\n"
    code += "write_dataset(Path(sys.argv[1]), objects=1, images=50, size_hw=(120, 160))"
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "data")], stderr=subprocess.DEVNULL) as run:
        while run.poll() is None and not any(tmp_path.glob(".data.*/test/000001/rgb/*.png")):
            time.sleep(0.05)
        run.kill()
    assert run.returncode == -9
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"objects": 0}, "synthetic.objects: found 0, needs at least 1"),
        ({"images": -1}, "synthetic.images: found -1"),
        ({"occluded": 1.5}, "synthetic.occluded: found 1.5, needs a share between 0 and 1"),
        ({"size_hw": (32, 640)}, "synthetic.size_hw"),
    ],
)
def test_a_wrong_argument_is_named(changed, message, tmp_path):
    with pytest.raises(BadInput) as error:
        write_dataset(tmp_path / "data", **(SMALL | changed))
    assert str(error.value).startswith(message)
    assert not any(tmp_path.iterdir())


def test_two_processes_can_open_the_same_demo_at_once(tmp_path):
    ask = (
        f"from pipeline.synthetic.demo import DemoConfig; print(len(DemoConfig(root={str(tmp_path)!r}).open().targets))"
    )
    command = [sys.executable, "-c", ask]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=120) for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert [out.splitlines()[-1] for out, _ in said] == ["18", "18"]
    assert len(list(tmp_path.iterdir())) == 1  # nothing half-written is left


def test_a_demo_written_by_another_process_is_used_and_other_files_are_refused(tmp_path, monkeypatch):
    def late(root: Path, **chosen):
        write_dataset(root, **chosen)  # as the other process did
        write_dataset(root, **chosen)

    monkeypatch.setattr("pipeline.synthetic.demo.write_dataset", late)
    demo = DemoConfig(root=str(tmp_path), images=1)
    assert len(demo.open().targets) == 3
    tmp_path.joinpath("file").write_text("mine")
    with pytest.raises(BadInput, match=r"dataset.root: found .* needs a folder to write to"):
        DemoConfig(root=str(tmp_path / "file"), images=1).open()
    assert tmp_path.joinpath("file").read_text() == "mine"
