"""A method: the variant of each stage, and what follows from the choice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pipeline.fits import chain
from pipeline.items.features import SALIENCY_LAYER
from pipeline.items.fit import Fit
from pipeline.stages.choose import HypothesisScorer
from pipeline.stages.cluster import Clusterer
from pipeline.stages.correspond import Corresponder
from pipeline.stages.crop import Cropper
from pipeline.stages.detect import Detector
from pipeline.stages.extract import Extractor
from pipeline.stages.fuse import Fuser
from pipeline.stages.match import Matcher
from pipeline.stages.refine import Refiner
from pipeline.stages.render import Renderer
from pipeline.stages.solve import Solver

ONLINE_STAGES = ("match", "fuse", "cluster", "correspond", "solve", "choose", "refine")
"""The stages that a pose depends on besides the features."""


@dataclass(frozen=True)
class Stages:
    """The variant of each stage.

    ``fallback``: use the template's own pose where the solver fails. ``second_look``: hypotheses to rerender.
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
    second_look: int = 0

    @property
    def oracle(self) -> str:
        """The online stage that needs the true pose, such as "match=oracle"; "" where none does."""
        if self.match.needs_truth:
            return "match=oracle"
        return "correspond=oracle" if self.correspond.needs_truth else ""

    @property
    def layers(self) -> tuple[int, ...]:
        """Layers that the route reads: for matching, for fusing, and saliency where a stage needs it."""
        saliency = {SALIENCY_LAYER} if self.correspond.needs_saliency else set()
        return tuple(sorted({*self.match.layers, *self.fuse.layers} | saliency))

    @property
    def fits(self) -> tuple[Fit, ...]:
        """The fits of all stages, without repetition; each follows the fits that it is based on."""
        fits = [stage.fit for stage in (self.match, self.fuse) if stage.fit is not None]
        return tuple(dict.fromkeys(part for fit in fits for part in chain(fit)))
