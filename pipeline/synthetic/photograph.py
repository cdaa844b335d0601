"""Objects in front of a camera -> an image of them with a wall behind, one light, lens blur and sensor noise."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.functional.camera import resize_affine
from pipeline.stages.render.raycast import surface_points
from pipeline.synthetic.layout import Camera, PlacedObject
from pipeline.synthetic.parts import Rng


class Wall:
    """A tilted plane behind the scene, at least 1250 mm away, with a random picture on it."""

    def __init__(self, rng: Rng) -> None:
        self.normal = np.array([*rng.uniform(-0.25, 0.25, 2), -1.0])
        self.distance_mm = rng.uniform(1500.0, 1700.0)
        self.picture = _picture(rng)

    def depth_mm(self, camera: Camera) -> Float[np.ndarray, "H W"]:
        """Depth at pixel centres."""
        x, y = _ray_slopes(camera)
        return -self.distance_mm / (x * self.normal[0] + y * self.normal[1] + self.normal[2])

    def albedo(self, camera: Camera) -> Float32[np.ndarray, "H W 3"]:
        """The wall's picture in the image, 0..255."""
        depth_mm = self.depth_mm(camera)
        # the picture's side is 2400 mm, which covers the field of view of a wide camera
        x, y = ((ray * depth_mm / 2400.0 + 0.5) * len(self.picture) for ray in _ray_slopes(camera))
        x, y = x.astype(np.float32), y.astype(np.float32)
        seen = cv2.remap(self.picture, x, y, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(seen, dtype=np.float32)


def _ray_slopes(camera: Camera) -> tuple[Float[np.ndarray, "1 W"], Float[np.ndarray, "H 1"]]:
    """Slopes x / z and y / z of the rays through columns and rows of pixels, for cameras without skew."""
    (h, w), K = camera.size_hw, camera.K
    return (np.arange(w)[None] - K[0, 2]) / K[0, 0], (np.arange(h)[:, None] - K[1, 2]) / K[1, 1]


def _picture(rng: Rng, side: int = 1024) -> Float32[np.ndarray, "s s 3"]:
    """Coloured noise of several scales with polygons painted over it, 0..255."""
    picture = np.zeros((side, side, 3), np.float32)
    for octave in (4, 16, 64, 256):
        shared, own = rng.normal(size=(octave, octave, 1)), rng.normal(size=(octave, octave, 3))
        coarse = (0.85 * shared + 0.35 * own).astype(np.float32)  # real surfaces vary more in lightness than in hue
        picture += 40 * (4 / octave) ** 0.4 * cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    picture += rng.uniform(80, 170, 3).astype(np.float32)
    for _ in range(70):
        centre, reach = rng.uniform(0, side, 2), rng.uniform(10, 90)
        around = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 9))))
        outline = centre + reach * rng.uniform(0.5, 1, (len(around), 1)) * np.stack(
            [np.cos(around), np.sin(around)], -1
        )
        cv2.fillPoly(picture, [np.rint(outline).astype(np.int32)], rng.uniform(20, 235, 3).tolist())
    return np.clip(picture, 0, 255)


def render_photograph(
    objects: Sequence[PlacedObject], wall: Wall, camera: Camera, rng: Rng
) -> UInt8[np.ndarray, "H W 3"]:
    """The scene under one light, rendered at twice the resolution, downsampled, with lens blur and sensor noise."""
    h, w = camera.size_hw
    fine = Camera(resize_affine(2.0) @ camera.K, (2 * h, 2 * w))
    toward = rng.normal(size=3) * [1, 1, 0.6] + [0, -0.6, -1.0]  # from the camera's side, often from above
    toward /= np.linalg.norm(toward)
    tint = rng.uniform(0.9, 1.1, 3) * rng.uniform(0.85, 1.15)
    ambient, diffuse, gloss = rng.uniform(0.3, 0.5), rng.uniform(0.5, 0.8), rng.uniform(0.0, 0.25)
    image = wall.albedo(fine) * np.float32(ambient + diffuse * 0.6)
    nearest = np.full(fine.size_hw, np.inf, np.float32)
    half = toward + np.array([0.0, 0.0, -1.0])  # half vector of Blinn's highlight, for a viewer on the optical axis
    half /= np.linalg.norm(half)
    for placed in objects:
        px, albedo, normal, depth = surface_points(placed.mesh, fine.K, placed.T_cam_obj, fine.size_hw)
        front = depth < nearest[px[:, 1], px[:, 0]]
        x, y = px[front].T
        nearest[y, x] = depth[front]
        cos = np.maximum(normal[front] @ toward, 0)[:, None]
        shine = np.maximum(normal[front] @ half, 0)[:, None] ** 30
        image[y, x] = albedo[front] * (ambient + diffuse * cos) + 255 * gloss * shine
    small = cv2.resize(image * tint.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    blurred = np.asarray(cv2.GaussianBlur(small, (0, 0), 0.5))
    return np.clip(np.rint(blurred + rng.normal(0, 2.0, blurred.shape)), 0, 255).astype(np.uint8)
