"""Errors of estimated poses and of matched templates."""

from __future__ import annotations

from dataclasses import dataclass

CORRECT_MSSD = 0.2
"""Pose tables and overlays mark an estimate as correct if its MSSD is below this fraction of the diameter."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimate ``row`` against instance ``gt_id`` of its object; lengths in mm, angles in degrees.

    ``vsd``: one value per tolerance tau, None if not computed. ``mspd_px``: for an image 640 px wide. ``rotation_deg``
    ignores symmetries; ``symmetric_rotation_deg`` is the minimum over them.
    """

    row: int
    gt_id: int
    diameter_mm: float
    vsd: tuple[float, ...] | None
    mssd_mm: float
    mspd_px: float
    add_mm: float
    adi_mm: float
    rotation_deg: float
    symmetric_rotation_deg: float
    translation_mm: float

    @property
    def relative_mssd(self) -> float:
        """MSSD as a fraction of the diameter."""
        return self.mssd_mm / self.diameter_mm

    @property
    def looks_right(self) -> bool:
        """Whether pose tables and overlays mark the estimate as correct: relative MSSD below CORRECT_MSSD."""
        return self.relative_mssd < CORRECT_MSSD


@dataclass(frozen=True)
class TemplateError:
    """Angle between a matched template's view and the true view, degrees, in three definitions (symmetry-aware).

    ``geodesic``: between the rotations. ``direction``: between the directions from the object to the camera.
    ``vectorised``: between the rotation matrices as vectors of nine numbers, the paper's formula as printed.
    """

    geodesic: float
    direction: float
    vectorised: float
