from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from pipeline.bop.dataset import open_dataset
from pipeline.functional.camera import mask_bbox
from pipeline.functional.rigid import rigid
from pipeline.items.objects import Mesh
from pipeline.items.views import Image
from pipeline.report.overlay import DrawnPose, clip_to_front, draw_overlay, write_overlay

FACES = np.array([(0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4), (2, 6, 3), (3, 6, 7)])
FACES = np.concatenate([FACES, [(0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5)]])
CUBE = Mesh(np.array([[x, y, z] for z in (-30.0, 30.0) for y in (-30.0, 30.0) for x in (-30.0, 30.0)]), FACES)
K = np.array([[300.0, 0, 99.5], [0, 300.0, 79.5], [0, 0, 1]])
COLOURS = {"truth": (50, 130, 255), "correct": (50, 215, 90), "wrong": (245, 60, 50), "unchecked": (255, 190, 30)}


def photo(h: int = 160, w: int = 200) -> Image:
    return Image(1, 1, np.full((h, w, 3), 128, np.uint8), K)


def at(x: float, y: float, z: float) -> np.ndarray:
    return rigid(np.eye(3), np.array([x, y, z], dtype=float))


def coloured(picture: np.ndarray, role: str) -> np.ndarray:
    return np.abs(picture.astype(int) - COLOURS[role]).max(axis=-1) < 50


def test_drawing_leaves_the_photograph_unchanged_and_is_reproducible():
    image = photo()
    items = [DrawnPose(CUBE, at(0, 0, 300), "truth"), DrawnPose(CUBE, at(5, 0, 300), "correct", "object 1")]
    first = draw_overlay(image, items)
    np.testing.assert_array_equal(first, draw_overlay(image, items))
    assert (image.rgb == 128).all()


def test_small_images_are_enlarged_and_large_ones_are_not():
    assert draw_overlay(photo(), []).shape == (640, 800, 3)
    assert draw_overlay(photo(480, 640), []).shape == (960, 1280, 3)
    assert draw_overlay(photo(1080, 1920), []).shape == (1080, 1920, 3)


@pytest.mark.parametrize("role", list(COLOURS))
def test_outline_surrounds_the_silhouette_in_the_colour_of_its_role(role: str):
    near_mm, factor = 300 - 30, 4  # the near face is the silhouette of a cube seen from the front
    picture = draw_overlay(photo(), [DrawnPose(CUBE, at(10, -5, 300), role)])
    drawn = coloured(picture, role)
    drawn[500:, :300] = False  # the legend
    x0, y0, x1, y1 = mask_bbox(drawn)
    corners = [(99.5 + 300 * (10 + s) / near_mm, 79.5 + 300 * (-5 + s) / near_mm) for s in (-30, 30)]
    expected = [(px + 0.5) * factor - 0.5 for corner in corners for px in corner]
    # 3 px: half a line's width, the pixel grid, and the smoothing of the outline
    np.testing.assert_allclose([x0, y0, x1, y1], expected, atol=3)


def test_estimates_are_drawn_over_ground_truth_in_any_order():
    truth, estimate = DrawnPose(CUBE, at(0, 0, 300), "truth"), DrawnPose(CUBE, at(0, 0, 300), "correct")
    np.testing.assert_array_equal(draw_overlay(photo(), [truth, estimate]), draw_overlay(photo(), [estimate, truth]))
    assert coloured(draw_overlay(photo(), [truth, estimate])[:500], "correct").sum() > 500


@pytest.mark.parametrize("size_hw", [(160, 200), (480, 640), (1080, 1920)])
def test_a_note_is_written_at_the_lower_right_alone(size_hw: tuple[int, int]):
    plain, noted = draw_overlay(photo(*size_hw), []), draw_overlay(photo(*size_hw), [], note="undistorted photograph")
    ys, xs = np.nonzero((plain != noted).any(axis=-1))
    h, w = plain.shape[:2]
    assert (ys.max(), xs.max()) == (h - 1, w - 1)
    assert ys.min() > 0.9 * h
    assert w / 2 < xs.min() < w - 60


def test_legend_names_only_what_is_drawn():
    picture = draw_overlay(photo(), [DrawnPose(CUBE, at(0, 0, -300), "wrong")])
    assert coloured(picture, "wrong")[500:, :300].any()
    for role in ("truth", "correct", "unchecked"):
        assert not coloured(picture, role).any()
    np.testing.assert_array_equal(draw_overlay(photo(), []), 128)


@pytest.mark.parametrize(
    "where", [(0, 0, -300), (0, 0, 10), (0, 0, 35), (4000, 0, 300), (0, 0, 1e7), (1e9, -1e9, 1e-3)]
)
def test_any_pose_can_be_drawn(where: tuple[float, float, float]):
    picture = draw_overlay(photo(), [DrawnPose(CUBE, at(*where), "wrong", "object 1  0.12")])
    assert picture.shape == (640, 800, 3)


def test_edges_are_clipped_at_the_near_plane():
    segments = np.array([[[0.0, 0, -10], [0, 10, 30]], [[0, 0, -5], [0, 0, -1]], [[1, 2, 30], [3, 4, 40]]])
    cut = clip_to_front(segments, near_mm=10.0)
    np.testing.assert_allclose(cut, [[[0, 5, 10], [0, 10, 30]], [[1, 2, 30], [3, 4, 40]]], atol=1e-12)  # float64


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_writing_a_picture_leaves_no_temporary_file(tmp_path: Path, name: str):
    picture = draw_overlay(photo(), [DrawnPose(CUBE, at(0, 0, 300), "correct", "object 1")])
    write_overlay(tmp_path / "deep" / name, picture)
    assert [p.name for p in (tmp_path / "deep").iterdir()] == [name]
    with PIL.Image.open(tmp_path / "deep" / name) as back:
        read = np.asarray(back.convert("RGB")).astype(int)
    # JPEG of quality 90 subsamples colour: thin coloured lines change, most pixels hardly
    assert np.median(np.abs(read - picture)) <= 2


def test_outline_of_the_ground_truth_lies_on_its_mask_in_a_photograph(bop_mini: Path):
    dataset = open_dataset(bop_mini / "ycbv", name="ycbv")
    truth = dataset.ground_truth(100, 1)[0]  # object 8, visible to 1.0
    mesh = dataset.object_model(8).mesh
    image = Image(100, 1, np.zeros_like(dataset.image(100, 1).rgb), dataset.image(100, 1).K)
    drawn = coloured(draw_overlay(image, [DrawnPose(mesh, truth.T_cam_obj, "truth")]), "truth")
    drawn[860:, :250] = False  # the legend
    box = np.array(mask_bbox(dataset.mask(100, 1, 0)))
    # 4 px of the enlarged picture: half a line's width and the annotation's own pixel
    np.testing.assert_allclose(np.array(mask_bbox(drawn)), (box + 0.5) * 2 - 0.5, atol=4)
