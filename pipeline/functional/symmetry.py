"""Surface points with colours -> the rigid transforms that map the surface onto itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pipeline.functional.rigid import inverse, nearest_rotation, rigid, rotation_angle_deg, transform

FOLDS = (2, 3, 4, 5, 6, 8)
GENERIC_DEG = (14.0, 41.0, 77.0, 112.0, 163.0)
"""Angles of no common n-fold symmetry: if all of them fit about an axis, its symmetry is continuous."""
MEAN_OFF = 0.0065
MOST_OFF = 0.040
"""Largest distance between a surface and its copy, over the diameter: the mean, and the 98 % quantile."""
COLOUR_OFF = 0.10
"""Largest mean difference of colours between a surface and its copy, over the range of values."""
_COARSE_OFF = 0.02
_FEW, _MANY = 300, 2000
_AXES = 400
_SAME_DEG = 20.0  # 8-fold symmetries are 45 degrees apart
_TRIED_DEG = 9.0
_EQUAL_MOMENTS = 0.12
_MOST = 60
IDENTITY = np.eye(4)
_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Surface:
    """Points spread evenly over a surface, mm, their colours (0 to 1, or None) and the surface's diameter.

    The points are in random order, so the first n are spread evenly, too.
    """

    points: Float[np.ndarray, "n 3"]
    colours: Float[np.ndarray, "n 3"] | None
    diameter: float


@dataclass(frozen=True, eq=False)
class Symmetries:
    """``discrete``: transforms T_obj_obj without the identity; ``axes`` and ``offsets`` (mm) of the continuous ones."""

    discrete: Float[np.ndarray, "d 4 4"]
    axes: Float[np.ndarray, "a 3"]
    offsets: Float[np.ndarray, "a 3"]

    @property
    def text(self) -> str:
        """The symmetries in words, such as "any angle about (0 0 1), 180 degrees about (1 0 0)"."""
        parts = [f"any angle about {_axis_text(axis)}" for axis in self.axes]
        if len(self.discrete) > 3:
            parts.append(f"{len(self.discrete)} rotations")
        else:
            turns = [Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True) for T in self.discrete]
            parts += [f"{np.linalg.norm(turn):.0f} degrees about {_axis_text(turn)}" for turn in turns]
        return ", ".join(parts) or "none"


def _axis_text(axis: Float[np.ndarray, " 3"]) -> str:
    values = np.round(axis / np.linalg.norm(axis), 2) + 0.0
    return f"({' '.join(f'{value:g}' for value in values)})"


NO_SYMMETRIES = Symmetries(np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros((0, 3)))


class _Comparison:
    """Compares a surface with rotated copies of itself."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self.centre = surface.points.mean(axis=0)
        self.tree = cKDTree(surface.points)
        self.few, self.many = surface.points[:_FEW], surface.points[:_MANY]
        self.floor = float(np.median(self.tree.query(self.few, k=2)[0][:, 1]))  # distance between neighbours

    def about(self, axis: Float[np.ndarray, " 3"], angle_deg: float) -> Float[np.ndarray, "4 4"]:
        """The rotation about an axis through the centre."""
        R = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
        return rigid(R, self.centre - R @ self.centre)

    def mean_off(self, T: Float[np.ndarray, "4 4"]) -> float:
        """Mean distance of a few moved points from the surface, over the diameter."""
        distance = self.tree.query(transform(T, self.few))[0]
        return float(np.maximum(distance - self.floor, 0).mean() / self.surface.diameter)

    def refine(self, T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """The transform refined by ICP, so that the copy fits the surface best."""
        for _ in range(_ROUNDS):
            moved = transform(T, self.few)
            distance, index = self.tree.query(moved)
            near = distance <= np.quantile(distance, 0.9)
            source, target = self.few[near], self.surface.points[index[near]]
            middle, aim = source.mean(axis=0), target.mean(axis=0)
            R = nearest_rotation((target - aim).T @ (source - middle))
            T = rigid(R, aim - R @ middle)
        return T

    def fits(self, T: Float[np.ndarray, "4 4"]) -> bool:
        """Whether the copy coincides with the surface, apart from small features."""
        distance = np.concatenate([self.tree.query(transform(M, self.many))[0] for M in (T, inverse(T))])
        distance = np.maximum(distance - self.floor, 0) / self.surface.diameter
        return bool(distance.mean() < MEAN_OFF and np.quantile(distance, 0.98) < MOST_OFF)

    def looks_the_same(self, T: Float[np.ndarray, "4 4"]) -> bool:
        """Whether the copy has the same colours as the surface."""
        colours = self.surface.colours
        if colours is None:
            return True
        index = self.tree.query(transform(T, self.many))[1]
        difference = np.abs(colours[index] - colours[: len(index)]).mean(axis=1)
        return bool(difference.mean() < COLOUR_OFF and np.quantile(difference, 0.9) < 3 * COLOUR_OFF)

    def is_copy(self, T: Float[np.ndarray, "4 4"]) -> bool:
        """Whether the copy has both the shape and the colours of the surface."""
        return self.fits(T) and self.looks_the_same(T)


def find_symmetries(surface: Surface) -> tuple[Symmetries, Symmetries]:
    """Symmetries of the geometry, and the subset that preserves the colours.

    Candidates are rotations, about axes through the centre, that preserve the moments of inertia; ICP refines them.
    Features on less than 2 % of the surface are ignored.
    """
    compared = _Comparison(surface)
    continuous = _find_continuous(compared)
    discrete = _find_discrete(compared, continuous)
    geometric = _as_symmetries(compared, continuous, discrete)
    coloured = [
        axis for axis in continuous if all(compared.looks_the_same(compared.about(axis, a)) for a in GENERIC_DEG)
    ]
    lost = [axis for axis in continuous if not any(axis is kept for kept in coloured)]
    turns = [compared.about(axis, 360 * k / n) for axis in lost for n in FOLDS for k in range(1, n)]
    candidates = [*discrete, *turns]
    same = [T for T in candidates if compared.looks_the_same(T)]
    return geometric, _as_symmetries(compared, coloured, _close(same, compared.refine, compared.is_copy))


def _candidate_axes(compared: _Comparison) -> list[Float[np.ndarray, " 3"]]:
    """The principal axes of inertia; where moments are nearly equal, also directions all over their plane or sphere."""
    centred = compared.surface.points - compared.centre
    moments, principal = np.linalg.eigh(centred.T @ centred / len(centred))
    axes = list(principal.T)
    flat = np.pi * np.arange(90) / 90
    low, high = np.diff(moments) / moments[-1] < _EQUAL_MOMENTS
    if low:
        axes += [principal @ [np.cos(a), np.sin(a), 0] for a in flat]
    if high:
        axes += [principal @ [0, np.cos(a), np.sin(a)] for a in flat]
    if low and high:
        k = np.arange(_AXES) + 0.5
        z, turn = 1 - k / _AXES, np.pi * (1 + 5**0.5) * k
        ring = np.sqrt(1 - z**2)
        axes += list(np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1))
    return axes


def _find_continuous(compared: _Comparison) -> list[Float[np.ndarray, " 3"]]:
    """Axes of continuous symmetry: none, one, or three orthogonal ones for a ball."""
    found: list[Float[np.ndarray, " 3"]] = []
    for axis in _candidate_axes(compared):
        if any(abs(axis @ other) > np.cos(np.radians(_SAME_DEG)) for other in found):
            continue
        if max(compared.mean_off(compared.about(axis, angle)) for angle in GENERIC_DEG[1:4]) > _COARSE_OFF:
            continue
        turn = Rotation.from_matrix(compared.refine(compared.about(axis, GENERIC_DEG[3]))[:3, :3]).as_rotvec()
        axis = turn / np.linalg.norm(turn)
        if all(compared.fits(compared.about(axis, angle)) for angle in GENERIC_DEG):
            found.append(axis)
        if len(found) == 2:
            return list(np.eye(3))
    return found


def _find_discrete(compared: _Comparison, continuous: Sequence[np.ndarray]) -> list[Float[np.ndarray, "4 4"]]:
    """Discrete symmetries that do not follow from the continuous ones, closed under composition."""
    if len(continuous) > 1:
        return []
    found: list[Float[np.ndarray, "4 4"]] = []
    tried: list[Float[np.ndarray, "4 4"]] = []
    for axis in _candidate_axes(compared):
        if continuous:
            if abs(axis @ continuous[0]) > 0.1:
                continue
            axis = axis - (axis @ continuous[0]) * continuous[0]
        for n in (2,) if continuous else FOLDS:
            T = compared.about(axis, 360 / n)
            if compared.mean_off(T) > _COARSE_OFF or _is_known(T, [*found, *tried], within_deg=_TRIED_DEG):
                continue
            tried.append(T)
            T = compared.refine(T)
            if not _is_known(T, found) and compared.fits(T):
                found.append(T)
        if continuous and found:
            break
    return found if continuous else _close(found, compared.refine, compared.fits)


def _is_known(
    T: Float[np.ndarray, "4 4"], known: Sequence[Float[np.ndarray, "4 4"]], *, within_deg: float = _SAME_DEG
) -> bool:
    """Whether a rotation is within an angle of the identity or of a known one."""
    others = np.stack([np.eye(4), *known])[:, :3, :3]
    return bool((rotation_angle_deg(others, np.broadcast_to(T[:3, :3], others.shape)) < within_deg).any())


def _close(
    found: Sequence[Float[np.ndarray, "4 4"]],
    refine: Callable[[Float[np.ndarray, "4 4"]], Float[np.ndarray, "4 4"]],
    fits: Callable[[Float[np.ndarray, "4 4"]], bool],
) -> list[Float[np.ndarray, "4 4"]]:
    """The transforms and all products of them that also fit, at most ``_MOST``."""
    group: list[Float[np.ndarray, "4 4"]] = []
    for T in found:
        if not _is_known(T, group):
            group.append(T)
    grown = True
    while grown and len(group) < _MOST:
        grown = False
        for a in list(group):
            for b in list(group):
                if len(group) < _MOST and not _is_known(a @ b, group):
                    T = refine(a @ b)
                    if not _is_known(T, group) and fits(T):
                        group.append(T)
                        grown = True
    return group


def _as_symmetries(
    compared: _Comparison, continuous: Sequence[np.ndarray], discrete: Sequence[np.ndarray]
) -> Symmetries:
    if not continuous and not discrete:
        return NO_SYMMETRIES
    offsets = np.repeat(compared.centre[None], len(continuous), axis=0).reshape(-1, 3)
    return Symmetries(np.reshape(discrete, (-1, 4, 4)), np.reshape(continuous, (-1, 3)), offsets)


def make_canonical(
    T_cam_obj: Float[np.ndarray, "4 4"],
    symmetries: Float[np.ndarray, "s 4 4"],
    *,
    near: Float[np.ndarray, "4 4"] = IDENTITY,
) -> Float[np.ndarray, "4 4"]:
    """The symmetric copy whose rotation is nearest that of ``near``, so that one image gives one pose."""
    copies = T_cam_obj @ symmetries
    likeness = np.einsum("sij,ij->s", copies[:, :3, :3], near[:3, :3])
    return np.asarray(copies[int(likeness.argmax())])
