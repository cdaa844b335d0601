import numpy as np
import pytest

from pipeline.errors import BadInput, NoPose
from pipeline.functional.camera import apply_homography, crop_camera, local_zoom, project
from pipeline.spec import build, digest
from pipeline.stages.crop.square import Square
from pipeline.stages.crop.virtual import Virtual

WHOLE = (-0.5, -0.5, 119.5, 89.5)
K = np.array([[90.0, 0.0, 59.5], [0.0, 95.0, 44.5], [0.0, 0.0, 1.0]])


def _scene() -> tuple[np.ndarray, np.ndarray]:
    """A photograph and a mask with an L of 40 x 50 pixels."""
    rgb = np.random.default_rng(0).integers(1, 256, (90, 120, 3), dtype=np.uint8)
    mask = np.zeros((90, 120), bool)
    mask[20:70, 30:50] = mask[50:70, 30:70] = True
    return rgb, mask


def test_image_enlarged_three_times_gives_the_same_crop():
    rgb, mask = _scene()
    crop = Square(size=24)(rgb, mask, WHOLE, K)
    large = Square(size=24)(*(a.repeat(3, 0).repeat(3, 1) for a in (rgb, mask)), WHOLE, K)
    assert np.abs(crop.rgb.astype(int) - large.rgb).max() <= 1  # float32 sums may round a half the other way
    assert np.array_equal(crop.mask, large.mask)
    corner = np.array([[30.0, 20.0]])
    assert np.allclose(
        apply_homography(crop.A_crop_img, corner), apply_homography(large.A_crop_img, 3 * corner + 1), atol=1e-9
    )


def test_image_moved_by_whole_pixels_gives_the_same_crop():
    rgb, mask = _scene()
    moved = (np.pad(rgb, ((7, 0), (11, 0), (0, 0))), np.pad(mask, ((7, 0), (11, 0))))
    still, shifted = Square()(rgb, mask, WHOLE, K), Square()(*moved, WHOLE, K)
    # A's last bits differ, a half may round the other way
    assert np.abs(still.rgb.astype(int) - shifted.rgb).max() <= 1
    assert np.array_equal(still.mask, shifted.mask)


def test_mask_fills_the_crop_up_to_the_padding():
    crop_mask = Square(size=120, padding_ratio=1.2)(*_scene(), WHOLE, K).mask
    rows, columns = np.flatnonzero(crop_mask.any(1)), np.flatnonzero(crop_mask.any(0))
    assert (rows[0], rows[-1]) == (10, 109)  # 50 px of 60 in height
    assert (columns[0], columns[-1]) == (20, 99)  # 40 px of 60 in width


@pytest.mark.parametrize("variant", [Square, Virtual])
def test_background_never_reaches_the_crop(variant):
    rgb, mask = _scene()
    other = np.where(mask[..., None], rgb, 255 - rgb)
    assert np.array_equal(variant()(rgb, mask, WHOLE, K).rgb, variant()(other, mask, WHOLE, K).rgb)
    kept = variant(background="keep")
    assert not np.array_equal(kept(rgb, mask, WHOLE, K).rgb, kept(other, mask, WHOLE, K).rgb)


@pytest.mark.parametrize("variant", [Square, Virtual])
def test_box_is_used_only_without_a_mask(variant):
    rgb, mask = _scene()
    with_mask = variant()(rgb, mask, (0.0, 0.0, 5.0, 5.0), K)
    crop = variant()(rgb, None, (29.5, 19.5, 69.5, 69.5), K)
    assert np.array_equal(crop.A_crop_img, with_mask.A_crop_img)
    assert crop.mask.sum() > with_mask.mask.sum()
    assert crop.rgb[crop.mask].min() > 0


def test_crop_of_an_object_at_the_border_is_not_moved():
    rgb = np.full((40, 40, 3), 200, np.uint8)
    mask = np.zeros((40, 40), bool)
    mask[:10, :10] = True
    crop = Square(size=40, padding_ratio=2.0)(rgb, mask, WHOLE, K)
    assert np.array_equal(crop.A_crop_img[:2, 2], [10.5, 10.5])  # two crop px a pixel, image edge -0.5 at crop edge 9.5
    assert not crop.rgb[:9].any()
    assert not crop.mask[:10].any()
    assert crop.mask[10:30, 10:30].all()


def test_virtual_crop_agrees_with_the_virtual_cameras_projection():
    """Small spheres in space, drawn as dots in a photograph, lie in the crop where the virtual camera projects them."""
    far = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
    points = np.array([[260.0, 150.0, 600.0], [290.0, 160.0, 640.0], [275.0, 190.0, 700.0], [240.0, 195.0, 620.0]])
    y, x = np.mgrid[:240, :320]
    px = project(far, points)
    dots = [np.exp(-((x - u) ** 2 + (y - v) ** 2) / 4.5) for u, v in px]
    low, high = px.min(0) - 4, px.max(0) + 4
    for n, dot in enumerate(dots):
        rgb = np.rint(255 * dot)[..., None].repeat(3, -1).astype(np.uint8)
        crop = Virtual(size=200)(rgb, None, (*low, *high), far)
        K_crop, R_crop_cam = crop_camera(crop.A_crop_img, far)
        weight = crop.rgb[..., 0].astype(float)
        seen = np.array([(weight * axis).sum() for axis in np.mgrid[:200, :200][::-1]]) / weight.sum()
        expected = project(K_crop, R_crop_cam @ points[n])
        error = np.abs(seen - expected).max() / local_zoom(crop.A_crop_img, px[n])
        assert error < 0.1  # image px; a dot's centre of mass is not quite the image of its centre


def test_virtual_crop_at_the_border_is_not_moved():
    rgb, mask = np.full((40, 40, 3), 200, np.uint8), np.zeros((40, 40), bool)
    mask[:10, :10] = True
    straight = np.array([[60.0, 0.0, 4.5], [0.0, 60.0, 4.5], [0.0, 0.0, 1.0]])  # looks at the mask's centre
    crop, flat = (variant(size=40, padding_ratio=2.0)(rgb, mask, WHOLE, straight) for variant in (Virtual, Square))
    np.testing.assert_allclose(crop.A_crop_img, flat.A_crop_img, atol=1e-12)
    assert not crop.rgb[:9].any()
    assert crop.mask[10:30, 10:30].all()
    assert not crop.mask[:10].any()


def test_a_turned_virtual_camera_centres_the_object():
    rgb, mask = _scene()
    crop = Virtual(size=60)(rgb, mask, WHOLE, K)
    assert crop.A_crop_img[2, 0] != 0  # K is wide: the mask's centre is 14 degrees off the axis
    corners = apply_homography(crop.A_crop_img, np.array([[29.5, 19.5], [69.5, 69.5]]))
    assert (corners > -0.5).all()
    assert (corners < 59.5).all()
    assert crop.mask.any(0).sum() > 35


@pytest.mark.parametrize("variant", [Square, Virtual])
@pytest.mark.parametrize(
    ("mask", "bbox", "reason"),
    [
        (np.zeros((90, 120), bool), WHOLE, "mask is empty, needs 1 pixel"),
        (np.ones((9, 12), bool), WHOLE, "mask is 12 x 9 px, image is 120 x 90 px"),
        (None, (10.0, 10.0, 10.0, 30.0), "box (10, 10, 10, 30) has no area"),
        (None, (float("nan"), 0.0, 10.0, 30.0), "box (nan, 0, 10, 30) has no area"),
        (None, (200.0, 10.0, 210.0, 30.0), "box (200, 10, 210, 30) holds no pixel of the 120 x 90 image"),
    ],
)
def test_an_object_that_cannot_be_cropped_says_why(variant, mask, bbox, reason):
    with pytest.raises(NoPose, match="crop: ") as failure:
        variant()(_scene()[0], mask, bbox, K)
    assert failure.value.reason == reason


def test_padding_below_one_is_refused():
    with pytest.raises(BadInput, match=r"crop.padding_ratio: found 0.9, needs greater than or equal to 1"):
        build(Square, {"padding_ratio": 0.9}, where="crop")


def test_masks_are_cleaned_only_where_asked():
    _, mask = _scene()
    for crop in (Square(), Virtual()):
        assert crop.clean_query(mask) is mask
        assert np.array_equal(crop.clean_template(mask[:, :90]), mask[:, :90])


def test_opening_drops_specks_of_a_detection():
    _, mask = _scene()
    specks = mask.copy()
    specks[3, 3] = specks[5:7, 100:102] = specks[40, 60:110] = True  # a pixel, 2 x 2 and a line
    assert np.array_equal(Virtual(open_query=1).clean_query(specks), mask)
    assert not Virtual(open_query=1).clean_query(np.zeros_like(mask)).any()  # an empty mask keeps its own reason
    thin = np.zeros_like(mask)
    thin[40:44, 20:45] = True
    with pytest.raises(NoPose, match=r"mask of 100 px is too thin, crop\.open_query needs 5 x 5 px"):
        Virtual(open_query=2).clean_query(thin)


def test_erosion_takes_a_templates_contour_and_never_all_of_it():
    mask = _scene()[1][:, :90]
    assert Virtual(erode_template=2).clean_template(mask).sum() == mask.sum() - 2 * (40 + 50) * 2 + 4 * 4
    assert Virtual(erode_template=10).clean_template(mask) is mask  # bars of 20 px


def test_switches_that_are_off_keep_their_key():
    assert Virtual().recipe() == Virtual(erode_template=0, open_query=0).recipe()
    assert not {"erode_template", "open_query"} & set(Virtual().recipe())
    assert len({digest(Virtual(**field).recipe()) for field in ({}, {"erode_template": 1}, {"open_query": 1})}) == 3
