"""Mesh, pose, camera -> a self-contained HTML page with an interactive 3D view.

The viewer is trimesh's: three.js in one file of 0.7 MB.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import PIL.Image
import trimesh
from jaxtyping import Float
from trimesh.viewer import scene_to_html

from pipeline.functional.rigid import transform
from pipeline.io.meshes.simplify import thin_mesh
from pipeline.items.objects import Mesh

Rgba = tuple[int, int, int, int]
Pose = Float[np.ndarray, "4 4"]

FACES, TEXTURE_PX = 6000, 256
"""Limits of the mesh in a page. They keep the mesh below 0.3 MB."""
_GREY: Rgba = (160, 165, 172, 255)
_CAMERA: Rgba = (30, 34, 40, 255)
_AXES: tuple[Rgba, ...] = ((220, 50, 50, 255), (60, 170, 70, 255), (60, 110, 240, 255))
_VIEWER_FROM_CAM = np.diag([1.0, -1.0, -1.0, 1.0])  # the viewer's y axis points up, its z axis towards the user


def scene_html(objects: Sequence[tuple[Mesh, Pose]], K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int]) -> str:
    """A page with the objects in their poses (T_cam_obj, mm), their axes, and the camera's frustum; drag to turn."""
    scene = trimesh.Scene()
    for mesh, T_cam_obj in objects:
        scene.add_geometry(_geometry(thin_mesh(mesh, FACES, texture_px=TEXTURE_PX), T_cam_obj))
        length_mm = 0.6 * float(np.ptp(mesh.vertices, axis=0).max())
        for colour, end in zip(_AXES, length_mm * np.eye(3), strict=True):
            scene.add_geometry(_rod(transform(T_cam_obj, np.stack([np.zeros(3), end])), length_mm / 60, colour))
    centre = np.mean([transform(T, mesh.vertices.mean(axis=0)[None])[0] for mesh, T in objects], axis=0)
    distance_mm = float(np.linalg.norm(centre))
    for segment in _pyramid(K, size_hw, 0.22 * distance_mm):
        scene.add_geometry(_rod(segment, distance_mm / 400, _CAMERA))
    scene.apply_transform(_VIEWER_FROM_CAM)
    size_mm = max(float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) for mesh, _ in objects)
    _look_at(scene, _VIEWER_FROM_CAM[:3, :3] @ centre, distance_mm, size_mm)
    return str(scene_to_html(scene))


def _geometry(mesh: Mesh, T_cam_obj: Pose) -> trimesh.Trimesh:
    """The mesh in camera coordinates, with its texture or colours, or grey."""
    shown = trimesh.Trimesh(transform(T_cam_obj, mesh.vertices), mesh.faces, process=False)
    if mesh.texture is not None and mesh.uv is not None:
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=PIL.Image.fromarray(mesh.texture), metallicFactor=0.0, roughnessFactor=0.9
        )
        shown.visual = trimesh.visual.TextureVisuals(uv=mesh.uv, material=material)
    elif mesh.colours is not None:
        shown.visual = trimesh.visual.ColorVisuals(shown, vertex_colors=mesh.colours)
    else:
        shown.visual = trimesh.visual.ColorVisuals(shown, vertex_colors=np.tile(_GREY, (len(mesh.vertices), 1)))
    return shown


def _rod(segment: Float[np.ndarray, "2 3"], radius_mm: float, colour: Rgba) -> trimesh.Trimesh:
    rod = trimesh.creation.cylinder(radius=radius_mm, segment=segment, sections=6)
    rod.visual = trimesh.visual.ColorVisuals(rod, vertex_colors=np.tile(colour, (len(rod.vertices), 1)))
    return rod


def _pyramid(K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int], depth_mm: float) -> list[Float[np.ndarray, "2 3"]]:
    """The eight edges of the camera's field of view up to a depth, in camera coordinates."""
    h, w = size_hw
    px = np.array([[-0.5, -0.5, 1], [w - 0.5, -0.5, 1], [w - 0.5, h - 0.5, 1], [-0.5, h - 0.5, 1]])
    corners = depth_mm * px @ np.linalg.inv(K).T
    sides = [np.stack([a, b]) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return [np.stack([np.zeros(3), corner]) for corner in corners] + sides


def _look_at(scene: trimesh.Scene, centre: Float[np.ndarray, " 3"], distance_mm: float, size_mm: float) -> None:
    """Place the viewer's camera to the upper right, between the real camera and the objects, and close enough."""
    away_mm = min(max(4 * size_mm, 0.5 * distance_mm), distance_mm)
    eye, middle = centre + away_mm * np.array([0.75, 0.45, 0.5]), 0.9 * centre
    back = (eye - middle) / np.linalg.norm(eye - middle)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    scene.camera_transform = pose
    scene.camera.fov = (45.0, 45.0)
    scene.camera.z_near, scene.camera.z_far = distance_mm / 100, distance_mm * 20
