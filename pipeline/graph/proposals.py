"""image -> proposals -> crops -> features, and the descriptors of proposals and templates that detectors compare."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float

from pipeline.bop.masks import decode_rle
from pipeline.errors import BadInput, NoPose
from pipeline.functional.descriptors import pool_foreground
from pipeline.graph.context import Context, ImageId, stack_crops
from pipeline.graph.tasks import Advance, Task
from pipeline.graph.templates import TemplateNodes
from pipeline.items.records import proposal_from_record, proposal_to_record
from pipeline.items.views import Crops, Proposal
from pipeline.spec import digest
from pipeline.stages.detect import Describer, ImageDescriptors
from pipeline.stages.detect.proposals import LoadedProposer
from pipeline.store import Ref, make_ref


@dataclass(eq=False)
class ProposalNodes:
    """Entries of a detector with a describer. Methods without a verb name entries.

    ``context`` has the describer's extractor instead of the route's. Templates and crops are shared with the route, and
    features too if both use the same extractor.
    """

    context: Context
    describer: Describer
    _proposal_refs: dict[ImageId, Ref] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def templates(self) -> TemplateNodes:
        """Entries of objects with the describer's extractor."""
        return TemplateNodes(self.context)

    @cached_property
    def proposer(self) -> LoadedProposer:
        """The proposer with its weights, loaded when the first image lacks proposals."""
        return self.context.load(self.describer.proposer)

    def check(self) -> None:
        """Raise BadInput for missing weights, a missing layer, and an extractor that needs the true pose."""
        extract, layer = self.context.stages.extract, self.describer.layer
        if extract.needs_geometry:
            raise BadInput("detect.describe", found=f"{extract.kind}, an oracle", needed="an extractor of photographs")
        try:
            extract.feature_shape(layer)
        except BadInput as error:
            if "layer" not in error.where:
                raise
            needed = f"{error.needed}; or an extractor that has it (extract@detect.describe=NAME)"
            raise BadInput("detect.describe_layer", found=error.found, needed=needed) from None
        self.describer.proposer.recipe()  # raises if weights are missing

    # --- objects ---------------------------------------------------------------------------------------------------

    def template_features(self, obj_id: int) -> Ref:
        """Features of an object's templates from which their descriptors are pooled."""
        return self.templates.features(obj_id, self.describer.layer)

    @cached_property
    def describe_task(self) -> Task[int]:
        """Render, crop and encode templates, by object."""
        return Task("descriptions", self._describe, lambda obj_id: self._is_complete(self.template_features(obj_id)))

    def _is_complete(self, ref: Ref) -> bool:
        return self.context.store.is_complete(ref)

    def _describe(self, obj_id: int, advance: Advance) -> None:
        count = self.templates.make_templates(obj_id)
        self.templates.make_crops(obj_id, count)
        self.templates.make_features(obj_id, count, [self.describer.layer])
        advance(1)

    def template_descriptors(self, obj_id: int) -> Float[torch.Tensor, "n c"]:
        """One descriptor per template of an object."""
        return self._read_descriptors(self.templates.crops(obj_id), self.template_features(obj_id))

    # --- images ----------------------------------------------------------------------------------------------------

    def proposals(self, image: ImageId) -> Ref:
        """Proposals of an image."""
        if image not in self._proposal_refs:
            recipe = {"kind": "proposals", "proposals": self.describer.proposer.recipe()}
            inputs = {"image": self.context.dataset.image_digest(*image)}
            self._proposal_refs[image] = make_ref("proposals", recipe, inputs)
        return self._proposal_refs[image]

    def crops(self, image: ImageId) -> Ref:
        """Crops of an image's proposals."""
        recipe = {"kind": "proposal crops", "crop": self.context.stages.crop.recipe()}
        inputs = {"proposals": self.proposals(image).key}
        if self.context.stages.crop.needs_camera:
            inputs["camera"] = digest(self.context.K(image).tolist())
        return make_ref("crops", recipe, inputs)

    def features(self, image: ImageId) -> Ref:
        """Features of these crops; an image without crops has no entry."""
        return self.context.features(self.describer.layer, {"crops": self.crops(image).key})

    @cached_property
    def propose_task(self) -> Task[ImageId]:
        """Propose, crop and encode, by image."""
        return Task("proposals", self._make, self._is_made)

    def _is_made(self, image: ImageId) -> bool:
        if not (self._is_complete(self.proposals(image)) and self._is_complete(self.crops(image))):
            return False
        return not self.context.store.read(self.crops(image)).rows or self._is_complete(self.features(image))

    def _make(self, image: ImageId, advance: Advance) -> None:
        rows = self._make_crops(image, self._make_proposals(image))
        if rows:
            refs = {self.describer.layer: self.features(image)}
            self.context.extract("proposal features", "", refs, rows, lambda batch: self._read_crops(image, batch))
        advance(1)

    def image_descriptors(self, image: ImageId) -> ImageDescriptors:
        """The proposals of an image that have a crop, with their descriptors."""
        kept = self.context.store.read(self.crops(image)).document["kept"]
        records = self.context.store.read(self.proposals(image)).document
        if not kept:
            channels = self.context.stages.extract.feature_shape(self.describer.layer)[0]
            return ImageDescriptors([], torch.zeros((0, channels), device=self.context.device), self._time_s(image))
        proposals = [proposal_from_record(records[position]) for position in kept]
        descriptors = self._read_descriptors(self.crops(image), self.features(image))
        return ImageDescriptors(proposals, descriptors, self._time_s(image))

    def _time_s(self, image: ImageId) -> float:
        """Seconds that an image's proposals, crops and features took."""
        read = self.context.store.read
        crops = read(self.crops(image))
        features_s = read(self.features(image)).time_s if crops.rows else 0.0
        return read(self.proposals(image)).time_s + crops.time_s + features_s

    def _make_proposals(self, image: ImageId) -> list[Proposal]:
        ref, store = self.proposals(image), self.context.store
        is_new = not store.is_complete(ref)
        if is_new:
            propose = self.proposer  # load the weights now, so that the seconds below do not include it
            start = time.perf_counter()
            proposals = propose(self.context.dataset.image(*image))
            seconds = time.perf_counter() - start
            records = [proposal_to_record(proposal) for proposal in proposals]
            store.put_document(ref, records, rows=len(records), time_s=seconds)
        entry = store.read(ref)
        counts = {"computed" if is_new else "reused": entry.rows}
        self.context.progress.add("proposals", **counts, time_s=entry.time_s if is_new else 0.0)
        return [proposal_from_record(record) for record in entry.document]

    def _make_crops(self, image: ImageId, proposals: Sequence[Proposal]) -> int:
        """Crop an image's proposals; returns how many could be cropped."""
        ref, store = self.crops(image), self.context.store
        if store.is_complete(ref):
            return store.read(ref).rows
        start = time.perf_counter()
        photo = self.context.dataset.image(*image)
        crops, kept = [], []
        for position, proposal in enumerate(proposals):
            try:
                crops.append(self.context.stages.crop(photo.rgb, decode_rle(proposal.rle), proposal.bbox_xyxy, photo.K))
                kept.append(position)
            except NoPose:
                continue  # a proposal without a crop cannot be matched either
        if not crops:
            store.put_document(ref, {"kept": []}, rows=0, time_s=time.perf_counter() - start)
            return 0
        arrays = stack_crops(crops)
        store.fill(
            {ref: self.context.crops_layout()},
            rows=len(crops),
            batch=len(crops),
            compute=lambda rows: {ref.key: {name: values[rows] for name, values in arrays.items()}},
            document={"kept": kept},
        )
        return len(crops)

    def _read_crops(self, image: ImageId, rows: Sequence[int]) -> Crops:
        entry = self.context.store.read(self.crops(image))
        return Crops(entry.array("rgb", rows), entry.array("mask", rows), entry.array("A_crop_img", rows))

    def _read_descriptors(self, crops: Ref, features: Ref) -> Float[torch.Tensor, "n c"]:
        maps = self.context.tensor(self.context.store.read(features).array("maps"))
        return pool_foreground(maps, self.context.tensor(self.context.store.read(crops).array("mask")))


def proposal_nodes(context: Context) -> ProposalNodes | None:
    """Nodes of the detector's describer; None for a detector without one."""
    describer = context.stages.detect.describer
    if describer is None:
        return None
    if describer.extractor == context.stages.extract:
        return ProposalNodes(context, describer)  # shares the loaded backbone
    own_context = replace(context, stages=replace(context.stages, extract=describer.extractor))
    own_context.models = context.models  # shares the meshes
    return ProposalNodes(own_context, describer)
