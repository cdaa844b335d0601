"""Results published in the paper; reports show them next to measured results, in separate tables and marks.

Von Gimborn et al., "Diffusion Features for Zero-Shot 6DoF Object Pose Estimation". Values are from its tables and
the coordinates of its plots.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

DATASETS = {"lmo": "LM-O", "ycbv": "YCB-V", "tless": "T-LESS"}

Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class PublishedMethod:
    """One method of the table "Comparison of single-shot monocular object pose estimation"; ``ar``: AR by dataset."""

    name: str
    training: str
    ar: Mapping[str, float]


def _make_method(name: str, training: str, *ar: float) -> PublishedMethod:
    return PublishedMethod(name, training, dict(zip(DATASETS, ar, strict=True)))


METHODS = (
    _make_method("CosyPose", "instance-level", 0.536, 0.333, 0.520),
    _make_method("GDRnet", "instance-level", 0.672, 0.755, 0.512),
    _make_method("HiPose", "instance-level", 0.799, 0.907, 0.833),
    _make_method("MegaPose", "supervised zero-shot", 0.187, 0.139, 0.197),
    _make_method("OSOP", "supervised zero-shot", 0.274, 0.296, 0.403),
    _make_method("GigaPose", "supervised zero-shot", 0.299, 0.290, 0.273),
    _make_method("FoundPose", "unsupervised zero-shot", 0.396, 0.452, 0.338),
    _make_method("ZS6D", "unsupervised zero-shot", 0.298, 0.324, 0.210),
    _make_method("DZOP", "unsupervised zero-shot", 0.328, 0.365, 0.267),
)

# relative improvement of DZOP over ZS6D in percent: pose error, Acc15, AR
IMPROVEMENT = {"lmo": (11.29, 8.61, 10.08), "ycbv": (4.89, 8.75, 12.65), "tless": (-1.14, 1.39, 27.14)}


@dataclass(frozen=True)
class PublishedCorrespondence:
    """One line of the table "Correspondence estimation" on LM-O; seconds on an RTX 4070."""

    co_projection: bool
    clusters: bool
    sub_pixel: bool
    ar: float
    time_s: float


CORRESPONDENCE = (
    PublishedCorrespondence(False, True, False, 0.149, 12.91),
    PublishedCorrespondence(True, False, False, 0.427, 7.18),
    PublishedCorrespondence(True, True, False, 0.432, 5.29),
    PublishedCorrespondence(True, True, True, 0.433, 5.29),
)

# swept field -> (value, AR) on LM-O with ground-truth detections ("Hyperparameter ablations")
ABLATIONS: Mapping[str, Points] = {
    "cluster.count": (
        (40, 0.4140), (80, 0.4282), (130, 0.4399), (150, 0.4407), (160, 0.4378), (170, 0.4373), (180, 0.4417),
        (190, 0.4375), (200, 0.4433), (210, 0.4381), (220, 0.4374), (230, 0.4394), (250, 0.4401), (300, 0.4384),
    ),
    "fuse.dim": (
        (48, 0.4358), (56, 0.4358), (64, 0.4433), (88, 0.4358), (104, 0.4358), (120, 0.4358), (144, 0.4358),
        (160, 0.4358),
    ),
    "correspond.per_cluster": (
        (1, 0.4311), (3, 0.4326), (5, 0.4375), (8, 0.4324), (10, 0.4433), (15, 0.4319), (20, 0.4374), (30, 0.4343),
        (40, 0.4359), (50, 0.4367), (60, 0.4367), (70, 0.4365),
    ),
    "extract.timestep": (
        (1, 0.4251), (5, 0.4307), (50, 0.4433), (60, 0.4425), (70, 0.4324), (90, 0.4397), (100, 0.4372),
        (140, 0.4330), (220, 0.4286), (260, 0.4242),
    ),
}  # fmt: skip

# dataset -> method -> (upper bound of theta, AR) ("AR over error tolerance threshold")
THETA: Mapping[str, Mapping[str, Points]] = {
    "lmo": {
        "ZS6D": ((0.05, 0.001), (0.1, 0.0376), (0.2, 0.1924), (0.3, 0.2989), (0.4, 0.3813), (0.5, 0.4349)),
        "DZOP": ((0.05, 0.008), (0.1, 0.0524), (0.2, 0.2324), (0.3, 0.3432), (0.4, 0.4166), (0.5, 0.4676)),
    },
    "ycbv": {
        "ZS6D": ((0.05, 0.0108), (0.1, 0.1254), (0.2, 0.3244), (0.3, 0.4250), (0.4, 0.4749), (0.5, 0.5064)),
        "DZOP": ((0.05, 0.0238), (0.1, 0.2256), (0.2, 0.4433), (0.3, 0.5257), (0.4, 0.5693), (0.5, 0.5965)),
    },
    "tless": {
        "ZS6D": ((0.05, 0.0526), (0.1, 0.2202), (0.2, 0.3506), (0.3, 0.3878), (0.4, 0.4103), (0.5, 0.4250)),
        "DZOP": ((0.05, 0.1093), (0.1, 0.2956), (0.2, 0.4184), (0.3, 0.4482), (0.4, 0.4630), (0.5, 0.4741)),
    },
}


def _number_from_one(*values: float) -> dict[int, float]:
    return dict(enumerate(values, start=1))


# dataset -> method -> object -> AR ("Per-object AR")
OBJECTS: Mapping[str, Mapping[str, Mapping[int, float]]] = {
    "lmo": {
        "ZS6D": {1: 0.520, 5: 0.4874, 6: 0.3333, 8: 0.3100, 9: 0.6888, 10: 0.2722, 11: 0.3929, 12: 0.475},
        "DZOP": {1: 0.5371, 5: 0.4975, 6: 0.3216, 8: 0.3550, 9: 0.7444, 10: 0.3277, 11: 0.4071, 12: 0.550},
    },
    "ycbv": {
        "ZS6D": _number_from_one(
            0.900, 0.7644, 0.2720, 0.8415, 0.9667, 0.7733, 0.2000, 0.5467, 0.7289, 0.5533, 0.9733, 0.7467, 0.6600,
            0.9467, 0.6667, 0.0133, 0.8667, 0.5800, 0.7733, 0.8333, 0.4667,
        ),
        "DZOP": _number_from_one(
            0.9233, 0.8889, 0.2773, 0.9063, 0.9933, 0.9700, 0.4267, 0.8800, 0.8667, 0.4733, 1.0000, 0.7600, 0.6600,
            1.0000, 0.8667, 0.0000, 0.9467, 0.7467, 0.9000, 0.8800, 0.9200,
        ),
    },
    "tless": {
        "ZS6D": _number_from_one(
            0.1709, 0.1723, 0.4401, 0.1145, 0.7895, 0.5510, 0.5200, 0.0267, 0.6992, 0.6643, 0.2743, 0.5180, 0.2500,
            0.3014, 0.3151, 0.6223, 0.6849, 0.6986, 0.1989, 0.0667, 0.2171, 0.2979, 0.6250, 0.5000, 0.4632, 0.5152,
            0.3646, 0.5885, 0.2245, 0.8750,
        ),
        "DZOP": _number_from_one(
            0.1830, 0.1995, 0.4922, 0.1869, 0.8526, 0.7143, 0.5840, 0.0400, 0.8089, 0.7622, 0.3257, 0.5755, 0.2214,
            0.3288, 0.2671, 0.6543, 0.7808, 0.8014, 0.2356, 0.1042, 0.2343, 0.3564, 0.7621, 0.5156, 0.5474, 0.5657,
            0.3646, 0.6458, 0.2041, 0.9097,
        ),
    },
}  # fmt: skip
