"""Views -> pictures: templates as the pipeline renders them, and photographs of varying quality."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.embedded.views import EMPTY_DEPTH, SIZE
from pipeline.functional.camera import mask_bbox, square_crop
from pipeline.functional.shading import shade
from pipeline.synthetic.parts import Rng

AMBIENT, DIFFUSE = 0.45, 0.55  # of templates, as in conf/render
_MIN_VISIBLE = 0.3  # share of the silhouette that stays visible


@dataclass(frozen=True, eq=False)
class View:
    """One view: albedo, normals (camera frame) and depth, from which it can be rendered under any light."""

    albedo: UInt8[np.ndarray, "S S 3"]
    normal: Float32[np.ndarray, "S S 3"]
    depth: Float32[np.ndarray, "S S"]
    K: Float32[np.ndarray, "3 3"]
    T: Float32[np.ndarray, "4 4"]

    @property
    def mask(self) -> Bool[np.ndarray, "S S"]:
        """Pixels that show the object."""
        return self.depth > EMPTY_DEPTH / 2


@dataclass(frozen=True, eq=False)
class Picture:
    """A crop as the extractor receives it.

    ``visible``: pixels of the view that it shows. ``A_crop_view`` takes pixels of the view to pixels of the crop.
    """

    rgb: UInt8[np.ndarray, "S S 3"]
    mask: Bool[np.ndarray, "S S"]
    visible: Bool[np.ndarray, "S S"]
    A_crop_view: Float[np.ndarray, "3 3"]


def render_template(view: View, rng: Rng) -> Picture:
    """The view as render and crop show it: light at the camera, black background.

    Half of the templates are slightly blurred, as supersampled ones are.
    """
    rays = _rays(view)
    colour = shade(view.albedo.astype(np.float32), view.normal, rays, ambient=AMBIENT, diffuse=DIFFUSE)
    if rng.uniform() < 0.5:
        colour = cv2.GaussianBlur(colour, (0, 0), rng.uniform(0.3, 0.6))
    rgb = np.rint(np.clip(colour * view.mask[..., None], 0, 255)).astype(np.uint8)
    return Picture(rgb, view.mask, view.mask, np.eye(3))


def render_photograph(view: View, rng: Rng, *, other: View | None = None) -> Picture:
    """The view under random light and camera: partly hidden, small, blurred, noisy, with an imprecise mask.

    Quality varies from nearly perfect to hardly recognisable. ``other``: a view of an object that may occlude this one;
    with it, pictures also have shadows and worse masks.
    """
    rough = float(rng.uniform())
    colour, background = _relight(view, rng, shadows=other is not None), _random_background(rng)
    visible = view.mask
    if rng.uniform() < (0.5 if other is None else 0.25):
        visible = _hide_part(view.mask, rng)
    elif other is not None and rng.uniform() < 0.4:
        visible, background = _hide_behind(view.mask, background, other, rng)
    colour = np.where(visible[..., None], colour, background)
    mask_faults = (rough, 0.35) if other is None else (0.2 + 0.8 * rough, 0.5)
    mask = _distort_mask(visible, rng, piece_probability=mask_faults[1]) if rng.uniform() < mask_faults[0] else visible
    box = mask_bbox(mask)
    assert box is not None
    A_crop_view = square_crop(box, size=SIZE, padding_ratio=1.2)
    rgb, cropped = _degrade(colour, mask, A_crop_view, rough, rng)
    return Picture(rgb, cropped, visible & mask, A_crop_view)


def _rays(view: View) -> Float32[np.ndarray, "S S 3"]:
    x = (np.arange(SIZE, dtype=np.float32) - view.K[0, 2]) / view.K[0, 0]
    y = (np.arange(SIZE, dtype=np.float32) - view.K[1, 2]) / view.K[1, 1]
    return np.stack([*np.meshgrid(x, y), np.ones((SIZE, SIZE), np.float32)], axis=-1)


def _relight(view: View, rng: Rng, *, shadows: bool) -> Float32[np.ndarray, "S S 3"]:
    """Lambert shading with gloss under one or two lights, with random colours, white balance, exposure and contrast."""
    albedo = view.albedo.astype(np.float32)
    grey = albedo.mean(axis=-1, keepdims=True)
    albedo = grey + (albedo - grey) * rng.uniform(0.2, 1.3)
    ambient, diffuse, gloss = rng.uniform(0.2, 0.7), rng.uniform(0.3, 0.9), rng.choice([0.0, rng.uniform(0, 0.5)])
    shade, shine = ambient, 0.0
    for strength in (diffuse, rng.choice([0.0, rng.uniform(0, 0.5)])):
        toward = rng.normal(size=3) * [1, 1, 0.6] + [0, -0.6, -0.9]
        toward /= np.linalg.norm(toward)
        half = toward - np.array([0.0, 0.0, 1.0])
        shade = shade + strength * np.maximum(view.normal @ toward.astype(np.float32), 0)
        lobe = np.maximum(view.normal @ (half / np.linalg.norm(half)).astype(np.float32), 0)
        shine = shine + strength * lobe ** rng.uniform(8, 50)
    colour = albedo * np.asarray(shade)[..., None] + 255 * gloss * np.asarray(shine)[..., None]
    if shadows and rng.uniform() < 0.6:
        colour = colour * _random_shadows(view, rng)[..., None]
    tint = rng.uniform(0.8, 1.2, 3) * np.exp(rng.uniform(-0.6, 0.35))
    colour = np.clip(colour * tint, 0, 255) / 255
    toned = colour ** np.exp(rng.uniform(-0.4, 0.4)) * (1 - rng.uniform(0, 0.12)) + rng.uniform(0, 0.1)
    return (255 * toned).astype(np.float32)


def _random_shadows(view: View, rng: Rng) -> Float32[np.ndarray, "S S"]:
    """Factors of ambient occlusion in hollows and of soft shadows cast from outside the picture."""
    mask = view.mask.astype(np.float32)
    sigma = rng.uniform(2, 10)
    near = np.where(view.mask, view.depth, 0).astype(np.float32)
    around = cv2.GaussianBlur(near, (0, 0), sigma) / np.maximum(cv2.GaussianBlur(mask, (0, 0), sigma), 1e-3)
    hollow = np.clip((near - around) * rng.uniform(0, 6), 0, 0.7) * mask
    steps = int(rng.integers(2, 6))
    field = cv2.resize(rng.normal(size=(steps, steps)).astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    cast = 1 / (1 + np.exp(-(field - rng.uniform(-0.5, 1.5)) * np.exp(rng.uniform(0.5, 3.5))))
    return ((1 - hollow) * (1 - rng.uniform(0, 0.65) * cast)).astype(np.float32)


def _random_background(rng: Rng) -> Float32[np.ndarray, "S S 3"]:
    """A random background of colour blotches, smooth or sharp."""
    steps = int(rng.integers(2, 24))
    blotches = rng.uniform(0, 255, 3) + rng.normal(0, 60, (steps, steps, 1)) + rng.normal(0, 25, (steps, steps, 3))
    how = cv2.INTER_CUBIC if rng.uniform() < 0.6 else cv2.INTER_NEAREST
    return np.clip(cv2.resize(blotches.astype(np.float32), (SIZE, SIZE), interpolation=how), 0, 255)


def _hide_part(mask: Bool[np.ndarray, "S S"], rng: Rng) -> Bool[np.ndarray, "S S"]:
    """The silhouette minus a half-plane, an ellipse or a polygon, shrunk until enough is visible."""
    centre = np.argwhere(mask)[rng.integers(mask.sum())][::-1].astype(float)
    kind, size, angle = rng.integers(3), rng.uniform(15, 60), rng.uniform(0, 2 * np.pi)
    corners = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
    aspect = rng.uniform(0.3, 1.0)
    for shrink in (1.0, 0.7, 0.45, 0.25):
        cover = np.zeros(mask.shape, np.uint8)
        if kind == 0:
            y, x = np.mgrid[:SIZE, :SIZE] - np.array([SIZE / 2, SIZE / 2])[:, None, None]
            cover = (x * np.cos(angle) + y * np.sin(angle) > SIZE / 2 * (1 - shrink * size / 60)).astype(np.uint8)
        elif kind == 1:
            axes = (int(size * shrink) + 1, int(size * aspect * shrink) + 1)
            cv2.ellipse(cover, (int(centre[0]), int(centre[1])), axes, float(np.degrees(angle)), 0, 360, 1, -1)
        else:
            outline = centre + size * shrink * np.stack([np.cos(corners), np.sin(corners)], -1)
            cv2.fillPoly(cover, [np.rint(outline).astype(np.int32)], 1)
        visible = mask & (cover == 0)
        if visible.sum() >= max(_MIN_VISIBLE * mask.sum(), 60):
            return visible
    return mask


def _hide_behind(
    mask: Bool[np.ndarray, "S S"], background: Float32[np.ndarray, "S S 3"], other: View, rng: Rng
) -> tuple[Bool[np.ndarray, "S S"], Float32[np.ndarray, "S S 3"]]:
    """The silhouette minus that of another object in front of it, and the background with that object."""
    colour = _relight(other, rng, shadows=True)
    at = np.argwhere(mask)[rng.integers(mask.sum())][::-1].astype(float)
    angle, grown = rng.uniform(0, 360), rng.uniform(0.35, 1.3)
    for shrink in (1.0, 0.7, 0.45, 0.25):
        A = cv2.getRotationMatrix2D((SIZE / 2, SIZE / 2), angle, grown * shrink)
        A[:, 2] += at + rng.normal(0, 8, 2) - SIZE / 2
        cover = cv2.warpAffine(other.mask.astype(np.uint8), A, (SIZE, SIZE), flags=cv2.INTER_NEAREST) > 0
        visible = mask & ~cover
        if visible.sum() >= max(_MIN_VISIBLE * mask.sum(), 60):
            moved = cv2.warpAffine(colour, A, (SIZE, SIZE), flags=cv2.INTER_LINEAR)
            return visible, np.where(cover[..., None], moved, background)
    return mask, background


def _distort_mask(visible: Bool[np.ndarray, "S S"], rng: Rng, *, piece_probability: float) -> Bool[np.ndarray, "S S"]:
    """A mask with a distorted outline; with ``piece_probability``, a part is also missing or added."""
    steps = int(rng.integers(3, 20))
    distortion = cv2.resize(
        rng.normal(size=(steps, steps)).astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC
    )
    soft = cv2.GaussianBlur(visible.astype(np.float32), (0, 0), rng.uniform(1, 5))
    mask = soft + rng.uniform(0.02, 0.25) * distortion > rng.uniform(0.35, 0.65)
    if rng.uniform() < piece_probability:
        at = np.argwhere(cv2.Canny(visible.astype(np.uint8) * 255, 50, 150) > 0)
        piece = np.zeros(mask.shape, np.uint8)
        y, x = at[rng.integers(len(at))] if len(at) else (SIZE // 2, SIZE // 2)
        axes = (int(rng.integers(4, 28)), int(rng.integers(4, 28)))
        cv2.ellipse(piece, (int(x), int(y)), axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
        mask = mask | (piece > 0) if rng.uniform() < 0.5 else mask & (piece == 0)
    return mask if (mask & visible).sum() >= 0.5 * visible.sum() else visible


def _degrade(
    colour: Float32[np.ndarray, "S S 3"],
    mask: Bool[np.ndarray, "S S"],
    A_crop_view: Float[np.ndarray, "3 3"],
    rough: float,
    rng: Rng,
) -> tuple[UInt8[np.ndarray, "S S 3"], Bool[np.ndarray, "S S"]]:
    """The crop as from a low-resolution camera: downscaled, blurred, noisy, compressed, masked, enlarged again."""
    side = int(SIZE * (28 / SIZE) ** (rough * rng.uniform()))
    A = np.array([[side / SIZE, 0, 0.5 * side / SIZE - 0.5], [0, side / SIZE, 0.5 * side / SIZE - 0.5], [0, 0, 1]])
    A = A @ A_crop_view
    soft = 0.4 * max(1 / A[0, 0] - 1, 0) + rng.choice([0.0, rough * rng.uniform(0, 1.0)]) / A[0, 0]
    if soft > 0.2:
        colour = cv2.GaussianBlur(colour, (0, 0), soft)
    small = cv2.warpAffine(colour, A[:2], (side, side), flags=cv2.INTER_LINEAR)
    inside = cv2.warpAffine(mask.astype(np.float32), A[:2], (side, side), flags=cv2.INTER_LINEAR) >= 0.5
    if rng.uniform() < 0.3:
        small = small + rng.uniform(0, 1.2) * (small - cv2.GaussianBlur(small, (0, 0), 1.0))
    noise = rng.normal(size=small.shape) * rng.uniform(0.5, 1 + 9 * rough)
    small = np.clip(small + noise, 0, 255).astype(np.uint8)
    if rng.uniform() < 0.6 * rough:
        _, code = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 95))])
        small = np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR))
    large = cv2.resize((small * inside[..., None]).astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    grown = cv2.resize(inside.astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    return np.rint(large).astype(np.uint8), grown >= 0.5 - 1e-5
