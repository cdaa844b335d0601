"""image -> masks of uniform regions and of what they merge into (Uijlings et al., IJCV 2013, "Selective Search")."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from pipeline.bop.masks import encode_rle
from pipeline.functional.camera import mask_bbox
from pipeline.functional.regions import propose_regions
from pipeline.items.views import Image, Proposal
from pipeline.spec import Fraction, Positive, Runtime, spec
from pipeline.stages.detect.proposals import Proposer


@spec
class Regions(Proposer):
    """Some hundred masks without a download: patches of uniform colour, merged by colour, by chroma and by borders.

    ``side``: the image is scaled down to this longer side, px. ``smallest`` and ``largest``: extent of a mask relative
    to the image's longer side. ``overlap``: of two masks with a larger IoU, one is dropped. Masks have no order: their
    confidence is 1.
    """

    kind: ClassVar[str] = "proposals.regions"
    version: ClassVar[int] = 1

    side: Annotated[Positive, Field(ge=32)] = 480
    smallest: Annotated[float, Field(gt=0, lt=1)] = 0.083
    largest: Annotated[float, Field(gt=0, le=1)] = 0.67
    overlap: Fraction = 0.75

    def load(self, runtime: Runtime) -> RegionProposer:
        """The spec itself: there are no weights."""
        return RegionProposer(self)


class RegionProposer:
    """A Regions spec, ready to use."""

    def __init__(self, spec: Regions) -> None:
        self.spec = spec

    def __call__(self, image: Image) -> list[Proposal]:
        """See LoadedProposer."""
        s = self.spec
        masks = propose_regions(image.rgb, side=s.side, smallest=s.smallest, largest=s.largest, overlap=s.overlap)
        boxes = ((mask, mask_bbox(mask)) for mask in masks)
        return [Proposal(box, encode_rle(mask), 1.0) for mask, box in boxes if box is not None]
