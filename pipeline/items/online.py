"""Data of the online route: queries, template views, hypotheses, and the trace of a detection."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.items.features import Clusters, CropFeatures, FittedArrays, FusedPair
from pipeline.items.fit import Fit
from pipeline.items.matches import Correspondences, TemplateMatch
from pipeline.items.poses import PoseSolution

T = TypeVar("T")


class Memo:
    """Values that depend on one image and a stage's spec; each is computed once and freed with the image."""

    def __init__(self) -> None:
        self._values: dict[object, Any] = {}

    def get(self, key: object, compute: Callable[[], T]) -> T:
        """The value stored under ``key``, computed and stored at the first call."""
        if key not in self._values:
            self._values[key] = compute()
        return self._values[key]


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth that only oracles receive: the true pose (mm) and the object's symmetries."""

    T_cam_obj: Float[np.ndarray, "4 4"]
    symmetries: Float[np.ndarray, "s 4 4"]


@dataclass(frozen=True, eq=False)
class Prior:
    """An expected pose T_cam_obj (mm), such as that of the frame before, and the object's symmetries."""

    T_cam_obj: Float[np.ndarray, "4 4"]
    symmetries: Float[np.ndarray, "s 4 4"]


@dataclass(frozen=True, eq=False)
class Query:
    """One detection: features and mask of its crop, A_crop_img and the image's K. ``truth`` is set for oracles only.

    ``others``: the same detection with further guesses at its mask, each made when it is asked for; None where its mask
    is given. ``rgb``: the crop of such a guess; None for that of the first, which is stored.
    """

    crop: CropFeatures
    A_crop_img: Float[np.ndarray, "3 3"]
    K: Float[np.ndarray, "3 3"]
    truth: Truth | None = None
    others: Callable[[], Iterator[Query]] | None = None
    rgb: UInt8[np.ndarray, "S S 3"] | None = None
    prior: Prior | None = None
    memo: Memo = field(default_factory=Memo, init=False, repr=False)

    @property
    def K_crop(self) -> Float[np.ndarray, "3 3"]:
        """Camera frame to crop pixels."""
        return self.A_crop_img @ self.K


@dataclass(frozen=True, eq=False)
class TemplateView:
    """One template with all that finding correspondences needs.

    ``depth_mm``, ``K`` and ``T_cam_obj`` are those of the rendered view; ``A_crop_img`` maps its pixels to crop pixels.
    ``rgb``: the crop of a view that was rendered for one query (rerender); None for a stored template.
    ``read_encoding``: reads its map as the first look compares it, where that is stored.
    """

    crop: CropFeatures
    A_crop_img: Float[np.ndarray, "3 3"]
    depth_mm: Float[np.ndarray, "H W"]
    K: Float[np.ndarray, "3 3"]
    T_cam_obj: Float[np.ndarray, "4 4"]
    rgb: UInt8[np.ndarray, "S S 3"] | None = None
    read_encoding: Callable[[], Any] | None = None
    memo: Memo = field(default_factory=Memo, init=False, repr=False)


class LazyView(TemplateView):
    """A template whose arrays are read when they are first asked for; most hypotheses need few of them.

    ``read``: from the name of a field to the function that reads it.
    """

    def __init__(self, K: Float[np.ndarray, "3 3"], read: Mapping[str, Callable[[], Any]]) -> None:
        vars(self).update(K=K, rgb=None, read_encoding=read.get("encoding"), memo=Memo(), _read=read)

    def __getattr__(self, name: str) -> Any:
        read = vars(self).get("_read", {})
        if name not in read:
            raise AttributeError(name)
        value = vars(self)[name] = read[name]()
        return value


class TemplateBank(Protocol):
    """An object's templates: feature maps, masks and poses of all of them, and any single view in full."""

    @property
    def features(self) -> Float[Tensor, "n c h w"]:
        """Feature maps of all templates in the matcher's ``layer``, float16 or float32."""
        ...

    def maps(self, layer: int) -> Float[Tensor, "n c h w"]:
        """Feature maps of all templates in one of the matcher's ``layers``, float16 or float32."""
        ...

    @property
    def norms(self) -> Float[Tensor, " n"]:
        """L2 norms of the flattened maps of ``features``, float32."""
        ...

    @property
    def cell_norms(self) -> Float[Tensor, "n h w"]:
        """Lengths of the cells of ``features``, float32."""
        ...

    @property
    def cell_mask(self) -> Bool[Tensor, "n h w"]:
        """Foreground cells of ``features``."""
        ...

    @property
    def mask(self) -> Bool[Tensor, "n S S"]:
        """Masks of the crops."""
        ...

    @property
    def T_cam_obj(self) -> Float[np.ndarray, "n 4 4"]:
        """Poses of all templates."""
        ...

    def view(self, index: int) -> TemplateView:
        """One template in full."""
        ...

    def render(
        self,
        T_cam_obj: Float[np.ndarray, "4 4"],
        A_crop_img: Float[np.ndarray, "3 3"],
        K: Float[np.ndarray, "3 3"],
    ) -> TemplateView:
        """Render the object in a pose as a crop of an image of camera K shows it, and extract its features."""
        ...

    def fitted(self, fit: Fit) -> FittedArrays:
        """Arrays of a fit (pipeline.fits) to these templates."""
        ...


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """The pose that one template leads to; without a ``solution``, ``failure`` says which stage gave up and why.

    ``rerendered``: the view that this hypothesis was matched against, rendered in the pose of its ``first`` look.
    ``score``: by which it was chosen; None where it was not compared with others.
    """

    template_id: int
    template_score: float
    pair: FusedPair | None = None
    clusters: Clusters | None = None
    matches: Correspondences | None = None
    points_obj: Float[np.ndarray, "m 3"] | None = None
    query_px_img: Float[np.ndarray, "m 2"] | None = None
    solution: PoseSolution | None = None
    failure: NoPose | None = None
    rerendered: TemplateView | None = None
    first: Hypothesis | None = None
    score: float | None = None

    @property
    def inliers(self) -> int:
        """Number of correspondences that support the pose."""
        return int(self.solution.inliers.sum()) if self.solution else 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What stages limited or skipped."""
        notes = (self.pair and self.pair.note, self.clusters and self.clusters.note)
        return tuple(note for note in notes if note)


@dataclass(frozen=True, eq=False)
class Trace:
    """What the route computed for one detection: the matched templates, one hypothesis for each, and the seconds of
    each stage. Hypotheses are sorted by score, the best first; the first is refined. ``query``: the detection with the
    mask that they come from; None where it had only one.
    """

    match: TemplateMatch
    hypotheses: tuple[Hypothesis, ...]
    times_s: Mapping[str, float]
    query: Query | None = None

    @property
    def best(self) -> Hypothesis:
        """Highest-scoring hypothesis; ties go to the better template match."""
        return self.hypotheses[0]


@dataclass
class Clock:
    """Seconds by stage."""

    times_s: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the block's seconds to ``stage``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.times_s[stage] = self.times_s.get(stage, 0.0) + time.perf_counter() - start
