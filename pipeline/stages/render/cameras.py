"""mesh -> the cameras of its templates: the base of all renderers, with their common fields."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field

from pipeline.functional.rigid import rigid
from pipeline.functional.viewpoints import ViewpointSet, viewpoint_rotations
from pipeline.items.objects import Mesh
from pipeline.spec import Fraction, spec
from pipeline.stages.render import Renderer


@spec
class RenderSpec(Renderer):
    """Cameras and light of the templates. Every field is explained in conf/render."""

    viewpoints: ViewpointSet = "fibonacci"
    count: Annotated[int, Field(ge=1, le=100_000)] = 300
    inplane: Annotated[int, Field(ge=1, le=360)] = 1
    size: Annotated[int, Field(ge=8, le=4096)] = 256
    supersample: Annotated[int, Field(ge=1, le=8)] = 1
    distance: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 6.0
    fill: Annotated[float, Field(gt=0, le=1)] = 0.9
    ambient: Fraction = 0.45
    diffuse: Fraction = 0.55
    crease_deg: Annotated[float, Field(ge=0, le=180)] = 40.0

    def count_views(self) -> int:
        """As Renderer.count_views."""
        return len(viewpoint_rotations(self.viewpoints, self.count, self.inplane))

    def cameras(self, mesh: Mesh) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 4 4"], tuple[int, int]]:
        """K, T_cam_obj of all templates, and the image size (h, w).

        All cameras look at the centre of the mesh's bounding box, wherever its origin is, from a distance of
        ``distance`` diameters of its bounding sphere. The sphere's outline spans ``fill`` of the image, so that K is
        the same for every object.
        """
        centre, radius = bounding_sphere(mesh)
        R = viewpoint_rotations(self.viewpoints, self.count, self.inplane)
        t = np.array([0.0, 0.0, self.distance * 2 * radius]) - R @ centre
        # a sphere of diameter 1 at distance D has an outline of radius f / sqrt(4 D^2 - 1)
        focal = self.fill * self.size / 2 * (4 * self.distance**2 - 1) ** 0.5
        middle = (self.size - 1) / 2
        K = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
        return K, rigid(R, t), (self.size, self.size)


def bounding_sphere(mesh: Mesh) -> tuple[Float[np.ndarray, " 3"], float]:
    """Centre of the bounding box of the mesh's faces, and the distance to their farthest vertex, mm."""
    used = face_vertices(mesh)
    centre = (used.min(axis=0) + used.max(axis=0)) / 2
    return centre, float(np.linalg.norm(used - centre, axis=-1).max())


def face_vertices(mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """The vertices that faces use; scans often contain stray points, which are not rendered."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces] = True
    return mesh.vertices[used]


def subpixels(supersample: int) -> Float[np.ndarray, "s 2"]:
    """Offsets (x, y) of a pixel's samples from its centre: centres of a grid of equal cells, in row-major order."""
    steps = (np.arange(supersample) + 0.5) / supersample - 0.5
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
