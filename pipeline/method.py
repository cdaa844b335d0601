"""A method: the variant of each stage, and what follows from the choice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from pipeline.fits import chain
from pipeline.items.features import SALIENCY_LAYER
from pipeline.items.fit import Fit
from pipeline.spec import Fraction, NonNegative, NonNegativeFloat, Positive, Spec, spec
from pipeline.stages.choose import HypothesisScorer
from pipeline.stages.cluster import Clusterer
from pipeline.stages.correspond import Corresponder
from pipeline.stages.crop import Cropper
from pipeline.stages.detect import Detector
from pipeline.stages.extract import Extractor
from pipeline.stages.fuse import Fuser, coarse_shape
from pipeline.stages.match import Matcher
from pipeline.stages.refine import Refiner
from pipeline.stages.render import Renderer
from pipeline.stages.segment import Segmenter
from pipeline.stages.segment.none import NoSegmentation
from pipeline.stages.solve import Solver

ONLINE_STAGES = ("match", "fuse", "cluster", "correspond", "solve", "choose", "refine")
"""The stages that a pose depends on besides the features."""


@spec
class SecondLook(Spec):
    """Rerender (render and compare): how the best hypotheses are found and how many are rendered and matched again.

    ``block``: side, in cells, of the blocks whose mean feature the first look compares; 1 for every cell. ``solved``:
    hypotheses with most correspondences that the first look solves; 0 for all. ``hypotheses``: how many are rendered,
    best first, and compared cell by cell; 0 for none. No hypothesis is rendered whose points lie, on average, within
    ``apart`` times the crop's side of where a better one has them, and none after one whose cells have a mean cosine of
    ``enough`` with the query's. ``outline``: the best pose is fitted, before it is refined, to its matches and to the
    outline of the detection's mask, which counts this many times as much (functional.outline); 0: off.
    """

    kind: ClassVar[str] = "second look"
    version: ClassVar[int] = 3
    added: ClassVar[Mapping[str, Any]] = {"outline": 0.0}

    hypotheses: NonNegative = 0
    block: Positive = 1
    solved: NonNegative = 0
    apart: NonNegativeFloat = 0.0
    enough: Fraction = 1.0
    outline: NonNegativeFloat = 0.0


@spec
class DepthFit(Spec):
    """Fit poses to a depth image: along the viewing ray, then ``rounds`` of iterated closest points.

    ``use``: "never"; "given": where the configuration gives a depth image (dataset=photo); "always": every image needs
    one. It is no part of the method, which uses RGB: results with depth are marked.
    """

    kind: ClassVar[str] = "depth fit"
    version: ClassVar[int] = 1

    use: Literal["never", "given", "always"] = "never"
    rounds: NonNegative = 12


@dataclass(frozen=True)
class Stages:
    """The variant of each stage.

    ``fallback``: use the template's own pose where the solver fails.
    """

    render: Renderer
    extract: Extractor
    crop: Cropper
    match: Matcher
    fuse: Fuser[Any]
    cluster: Clusterer
    correspond: Corresponder
    solve: Solver
    choose: HypothesisScorer
    refine: Refiner
    detect: Detector
    fallback: bool = False
    second_look: SecondLook = field(default_factory=SecondLook)
    depth: DepthFit = field(default_factory=DepthFit)
    segment: Segmenter = field(default_factory=NoSegmentation)

    @property
    def segments(self) -> bool:
        """Whether detections without a mask get one."""
        return self.detect.gives_boxes and self.segment.makes_masks

    @property
    def oracle(self) -> str:
        """The online stage that needs the true pose, such as "match=oracle"; "" where none does."""
        asks = {
            "match": self.match.needs_truth,
            "correspond": self.correspond.needs_truth,
            "choose": self.choose.needs_truth,
        }
        return next((f"{name}=oracle" for name, needs_truth in asks.items() if needs_truth), "")

    @property
    def layers(self) -> tuple[int, ...]:
        """Layers that the route reads: for matching, for fusing, and saliency where a stage needs it."""
        saliency = {SALIENCY_LAYER} if self.correspond.needs_saliency else set()
        return tuple(sorted({*self.match.layers, *self.fuse.layers} | saliency))

    @property
    def encoding_shape(self) -> tuple[int, int, int] | None:
        """(d, h, w) of a template's map as the first look compares it; None where such maps are not stored.

        They are stored where they depend on the template alone and are coarser than what a view is compared by later.
        """
        block = self.second_look.block
        if self.fuse.joint or block == 1:
            return None
        shape = self.fuse.encoded_shape({layer: self.extract.feature_shape(layer) for layer in self.fuse.layers})
        return shape and coarse_shape(shape, block=block)

    @property
    def fits(self) -> tuple[Fit, ...]:
        """The fits of all stages, without repetition; each follows the fits that it is based on."""
        fits = [stage.fit for stage in (self.match, self.fuse) if stage.fit is not None]
        return tuple(dict.fromkeys(part for fit in fits for part in chain(fit)))
