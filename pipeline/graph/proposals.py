"""image -> proposals -> crops -> features, and the descriptors of them and of templates that detections come of."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import cast

import torch
from jaxtyping import Float

from pipeline.bop.masks import decode_rle
from pipeline.errors import BadInput, NoPose
from pipeline.functional.descriptors import pool_foreground
from pipeline.graph.context import Context, ImageId, stack_crops
from pipeline.graph.tasks import Advance, Task
from pipeline.graph.templates import TemplateNodes
from pipeline.io.digests import file_digest
from pipeline.items.records import proposal_from_record, proposal_to_record
from pipeline.items.views import Crops, Proposal
from pipeline.spec import digest
from pipeline.stages.detect import DescribingDetector
from pipeline.stages.detect.proposals import LoadedProposer
from pipeline.stages.extract import Extractor
from pipeline.store import Ref, make_ref


@dataclass(eq=False)
class ProposalNodes:
    """Entries that a describing detector stands on. Methods without a verb name entries.

    ``context`` has the detector's extractor in the place of the route's: templates and their crops are the route's own
    entries, and so are their features where the two extractors are one.
    """

    context: Context
    detector: DescribingDetector

    @cached_property
    def templates(self) -> TemplateNodes:
        """Entries of objects under the detector's extractor."""
        return TemplateNodes(self.context)

    @cached_property
    def proposing(self) -> LoadedProposer:
        """The proposer with its weights, loaded when the first image lacks its proposals."""
        return self.detector.proposals.load(self.context.runtime)

    def check(self) -> None:
        """Raise BadInput for weights or a layer that are not there, and for a descriptor that sees the truth."""
        extract, layer = self.context.stages.extract, self.detector.describe_layer
        if extract.needs_geometry:
            raise BadInput("detect.describe", found=f"{extract.kind}, an oracle", needed="an extractor of photographs")
        try:
            extract.feature_shape(layer)
        except BadInput as fault:
            if "layer" not in fault.where:
                raise
            needed = f"{fault.needed}; or an extractor that has it (extract@detect.describe=NAME)"
            raise BadInput("detect.describe_layer", found=fault.found, needed=needed) from None
        self.detector.proposals.recipe()

    # --- objects ---------------------------------------------------------------------------------------------------

    def template_features(self, obj_id: int) -> Ref:
        """Features of an object's templates that descriptors are read from."""
        return self.templates.features(obj_id, self.detector.describe_layer)

    @cached_property
    def describing(self) -> Task[int]:
        """Rendering, cropping and describing templates, by object."""
        return Task("descriptions", self._describe, lambda obj_id: self._complete(self.template_features(obj_id)))

    def _complete(self, ref: Ref) -> bool:
        return self.context.store.is_complete(ref)

    def _describe(self, obj_id: int, advance: Advance) -> None:
        count = self.templates.make_templates(obj_id)
        self.templates.make_crops(obj_id, count)
        self.templates.make_features(obj_id, count, [self.detector.describe_layer])
        advance(1)

    def template_descriptors(self, obj_id: int) -> Float[torch.Tensor, "n c"]:
        """One vector for each of an object's templates."""
        return self._descriptors(self.templates.crops(obj_id), self.template_features(obj_id))

    # --- images ----------------------------------------------------------------------------------------------------

    @cached_property
    def proposals(self) -> Callable[[ImageId], Ref]:
        """Proposals of an image."""
        return lru_cache(maxsize=None)(self._proposals)

    def _proposals(self, image: ImageId) -> Ref:
        recipe = {"kind": "proposals", "proposals": self.detector.proposals.recipe()}
        return make_ref("proposals", recipe, {"image": file_digest(self.context.dataset.image_path(*image))})

    def crops(self, image: ImageId) -> Ref:
        """Their crops."""
        recipe = {"kind": "proposal crops", "crop": self.context.stages.crop.recipe()}
        inputs = {"proposals": self.proposals(image).key}
        if self.context.stages.crop.needs_camera:
            inputs["camera"] = digest(self.context.K(image).tolist())
        return make_ref("crops", recipe, inputs)

    def features(self, image: ImageId) -> Ref:
        """Features of these that descriptors are read from; none for an image without a crop."""
        return self.context.features(self.detector.describe_layer, {"crops": self.crops(image).key})

    @cached_property
    def proposing_all(self) -> Task[ImageId]:
        """Proposing, cropping and describing, by image."""
        return Task("proposals", self._make, self._made)

    def _made(self, image: ImageId) -> bool:
        if not (self._complete(self.proposals(image)) and self._complete(self.crops(image))):
            return False
        return not self.context.store.read(self.crops(image)).rows or self._complete(self.features(image))

    def _make(self, image: ImageId, advance: Advance) -> None:
        rows = self._make_crops(image, self._make_proposals(image))
        if rows:
            refs = {self.detector.describe_layer: self.features(image)}
            self.context.extract("proposal features", "", refs, rows, lambda some: self._crops_of(image, some))
        advance(1)

    def described(self, image: ImageId) -> tuple[list[Proposal], Float[torch.Tensor, "p c"]]:
        """An image's proposals that have a crop, and one vector for each."""
        kept = self.context.store.read(self.crops(image)).document["kept"]
        proposals = [proposal_from_record(record) for record in self.context.store.read(self.proposals(image)).document]
        if not kept:
            channels = self.context.stages.extract.feature_shape(self.detector.describe_layer)[0]
            return [], torch.zeros((0, channels), device=self.context.device)
        return [proposals[i] for i in kept], self._descriptors(self.crops(image), self.features(image))

    def time_s(self, image: ImageId) -> float:
        """Seconds that an image's proposals and their features took."""
        crops = self.context.store.read(self.crops(image))
        features = self.context.store.read(self.features(image)).time_s if crops.rows else 0.0
        return self.context.store.read(self.proposals(image)).time_s + crops.time_s + features

    def _make_proposals(self, image: ImageId) -> list[Proposal]:
        ref = self.proposals(image)
        fresh = not self.context.store.is_complete(ref)
        if fresh:
            propose = self.proposing  # loading its weights is no part of an image's seconds
            start = time.perf_counter()
            found = propose(self.context.dataset.image(*image))
            seconds = time.perf_counter() - start
            records = [proposal_to_record(proposal) for proposal in found]
            self.context.store.put_document(ref, records, rows=len(found), time_s=seconds)
        entry = self.context.store.read(ref)
        counted = {"computed" if fresh else "reused": entry.rows}
        self.context.progress.add("proposals", **counted, time_s=entry.time_s if fresh else 0.0)
        return [proposal_from_record(record) for record in entry.document]

    def _make_crops(self, image: ImageId, proposals: Sequence[Proposal]) -> int:
        """Crop an image's proposals; returns how many could be cropped."""
        ref = self.crops(image)
        if self.context.store.is_complete(ref):
            return self.context.store.read(ref).rows
        start = time.perf_counter()
        photo = self.context.dataset.image(*image)
        crops, kept = [], []
        for position, proposal in enumerate(proposals):
            try:
                crops.append(self.context.stages.crop(photo.rgb, decode_rle(proposal.rle), proposal.bbox_xyxy, photo.K))
                kept.append(position)
            except NoPose:
                continue  # it cannot be an object that a pose could be found of
        if not crops:
            self.context.store.put_document(ref, {"kept": []}, rows=0, time_s=time.perf_counter() - start)
            return 0
        arrays = stack_crops(crops)
        self.context.store.fill(
            {ref: self.context.crops_layout()},
            rows=len(crops),
            batch=len(crops),
            compute=lambda rows: {ref.key: {name: values[rows] for name, values in arrays.items()}},
            document={"kept": kept},
        )
        return len(crops)

    def _crops_of(self, image: ImageId, rows: Sequence[int]) -> Crops:
        entry = self.context.store.read(self.crops(image))
        return Crops(entry.array("rgb", rows), entry.array("mask", rows), entry.array("A_crop_img", rows))

    def _descriptors(self, crops: Ref, features: Ref) -> Float[torch.Tensor, "n c"]:
        maps = self.context.tensor(self.context.store.read(features).array("maps"))
        return pool_foreground(maps, self.context.tensor(self.context.store.read(crops).array("mask")))


def proposal_nodes(context: Context) -> ProposalNodes | None:
    """Nodes of the run's detector where it is one that describes."""
    detector = context.stages.detect
    if not isinstance(detector, DescribingDetector):
        return None
    extract = cast(Extractor, detector.describe)
    if extract == context.stages.extract:
        return ProposalNodes(context, detector)  # one backbone in memory
    describing = replace(context, stages=replace(context.stages, extract=extract))
    describing.models = context.models  # meshes are read once
    return ProposalNodes(describing, detector)
