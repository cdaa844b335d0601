"""image, object -> a mask found by search, and the confidence of its pose. One entry per image."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool

from pipeline.bop.masks import decode_rle
from pipeline.confidence.evidence import collect_evidence
from pipeline.errors import BadInput, NoPose
from pipeline.functional.masks import cell_mask
from pipeline.functional.resemblance import best_colour_match, best_masked_cosine, colour_profile
from pipeline.graph.context import Context, ImageId
from pipeline.graph.describe import describe_mask
from pipeline.graph.proposals import ProposalNodes
from pipeline.graph.templates import TemplateNodes
from pipeline.items.records import proposal_from_record, proposal_to_record
from pipeline.items.views import Detection, Image, Proposal, Target
from pipeline.method import ONLINE_STAGES
from pipeline.route import Route, trace_pose
from pipeline.spec import digest
from pipeline.stages.crop import BBox
from pipeline.stages.detect import Describer, SearchPlan
from pipeline.store import Ref, make_ref

COLOURED_TEMPLATES = 75  # at most, evenly spaced: neighbouring views have almost the same colours


@dataclass(frozen=True)
class Found:
    """The result of a search: the best mask, None if no candidate led to a pose, and the confidence of its pose.

    ``tried``: number of candidates whose pose was estimated. ``given``: confidence of the detection that was given.
    """

    confidence: float
    tried: int
    given: float | None
    proposal: Proposal | None


@dataclass(eq=False)
class SearchNodes:
    """Searches for objects in whole images. ``proposals``: masks that may be objects, with features of the route."""

    context: Context
    templates: TemplateNodes
    plan: SearchPlan
    _colours: dict[int, torch.Tensor] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def proposals(self) -> ProposalNodes:
        """Entries of the images' proposals."""
        stages = self.context.stages
        return ProposalNodes(self.context, Describer(self.plan.proposals, stages.extract, stages.match.layer))

    def check(self) -> None:
        """Raise BadInput without a calibrated confidence, which verifies what is found, and for oracles."""
        stages = self.context.stages
        oracle = "extract=coordinates" if stages.extract.needs_geometry else stages.oracle
        if oracle:
            raise BadInput("detect", found=f"a search with {oracle}", needed="detections made from ground truth")
        if self.context.calibration is None:
            needed = "a method with a calibrated confidence, such as method=dzop_x, or confidence=FILE"
            raise BadInput("detect", found="a search whose results nothing could verify", needed=needed)

    def recipe(self) -> dict[str, Any]:
        """What decides a search besides images and templates."""
        stages, calibration = self.context.stages, self.context.calibration
        recipe = {name: getattr(stages, name).recipe() for name in ONLINE_STAGES}
        recipe |= {"plan": self.plan.recipe(), "second look": stages.second_look.recipe()}
        return recipe | {"calibration": calibration and calibration.digest}

    def inputs(self) -> dict[str, str]:
        """Keys of everything that searches for the run's targets read."""
        objects = {f"object {obj_id}": digest(self._template_keys(obj_id)) for obj_id in self.context.object_ids}
        images = {f"searched image {s}/{i}": self.proposals.features((s, i)).key for s, i in self.context.image_ids}
        return objects | images

    def _template_keys(self, obj_id: int) -> list[str]:
        nodes, stages = self.templates, self.context.stages
        refs = [nodes.templates(obj_id), nodes.crops(obj_id)]
        refs += [nodes.features(obj_id, layer) for layer in stages.layers]
        refs += [nodes.fitted(obj_id, fit) for fit in stages.fits]
        return [ref.key for ref in refs]

    def _ref(self, image: ImageId, asked: Mapping[int, Detection | None]) -> Ref:
        given = [[obj_id, d and [list(d.bbox_xyxy), d.rle]] for obj_id, d in sorted(asked.items())]
        inputs = {f"object {obj_id}": digest(self._template_keys(obj_id)) for obj_id in asked}
        inputs |= {"proposals": self.proposals.features(image).key, "asked": digest(given)}
        inputs["camera"] = digest(self.context.K(image).tolist())
        return make_ref("searches", {"kind": "searches"} | self.recipe(), inputs)

    def complete(self, detections: Sequence[Detection]) -> list[Detection]:
        """The detections, with those that a search found; a target that was not found says so as its ``defect``."""
        by_target: dict[Target, list[Detection]] = {target: [] for target in self.context.targets}
        named = {(t.scene_id, t.im_id, t.obj_id): t for t in self.context.targets}
        for d in detections:
            by_target[named[d.scene_id, d.im_id, d.obj_id]].append(d)
        asked: dict[ImageId, dict[int, Detection | None]] = {}
        for target, mine in by_target.items():
            usable = [d for d in mine if d.defect is None]
            is_doubtful = self.plan.doubtful > 0 and len(usable) == 1 and target.inst_count == 1
            if not usable or is_doubtful:
                asked.setdefault((target.scene_id, target.im_id), {})[target.obj_id] = usable[0] if usable else None
        found = self._search_images(asked)
        return [d for target, mine in by_target.items() for d in self._decide(target, mine, found.get(target))]

    def _decide(self, target: Target, mine: list[Detection], found: Found | None) -> list[Detection]:
        """A target's detections after the search; ``found`` is None where there was none."""
        if found is None:
            return mine
        is_found = found.proposal is not None and found.confidence >= self.plan.min_confidence
        if found.given is not None and (not is_found or found.confidence <= found.given):
            return mine
        ids = target.scene_id, target.im_id, target.obj_id
        if is_found and found.proposal is not None:
            return [Detection(*ids, found.confidence, -1.0, found.proposal.bbox_xyxy, found.proposal.rle)]
        reason = "not found: no region resembles it enough to estimate a pose"
        if found.proposal is not None:
            needed = f"a confidence of {found.confidence:.2f}, needs {self.plan.min_confidence:g}"
            reason = f"not found: the best pose of {found.tried} candidates has {needed}"
        return [Detection(*ids, 0.0, -1.0, (0.0,) * 4, defect=reason)]

    def _search_images(self, asked: Mapping[ImageId, Mapping[int, Detection | None]]) -> dict[Target, Found]:
        """Search for the objects of each image, where that is missing."""
        missing = [image for image in asked if not self.context.store.is_complete(self._ref(image, asked[image]))]
        objects = sorted({obj_id for image in missing for obj_id in asked[image]})
        with self.context.progress.bar(len(objects), "onboarding", "object") as advance:
            self.context.run_task(self.templates.onboard_task, objects, advance)
        named = {(t.scene_id, t.im_id, t.obj_id): t for t in self.context.targets}
        found: dict[Target, Found] = {}
        with self.context.progress.bar(len(missing), "search", "image") as advance:
            for image in asked:
                ref = self._ref(image, asked[image])
                if not self.context.store.is_complete(ref):
                    self._search_image(ref, image, asked[image])
                    advance(1)
                for obj_id, record in self.context.store.read(ref).document.items():
                    found[named[*image, int(obj_id)]] = _from_record(record)
        return found

    def _search_image(self, ref: Ref, image: ImageId, asked: Mapping[int, Detection | None]) -> None:
        began = time.perf_counter()
        photo = self.context.dataset.image(*image)
        records = {str(obj_id): self._search(photo, obj_id, given) for obj_id, given in asked.items()}
        self.context.store.put_document(ref, records, rows=len(records), time_s=time.perf_counter() - began)
        self.context.progress.add("searches", computed=len(records), time_s=time.perf_counter() - began)

    def _search(self, photo: Image, obj_id: int, given: Detection | None) -> dict[str, Any]:
        """The record of the best candidate; none is tried if the given detection is not doubtful."""
        sure = None
        if given is not None:
            mask = None if given.rle is None else decode_rle(given.rle)
            sure = self._confidence(photo, obj_id, mask, given.bbox_xyxy)
            if sure >= self.plan.doubtful:
                return {"given": sure, "tried": 0, "confidence": 0.0, "proposal": None}
        best, proposal, tried = 0.0, None, 0
        for candidate in self._rank((photo.scene_id, photo.im_id), obj_id):
            tried += 1
            confidence = self._confidence(photo, obj_id, decode_rle(candidate.rle), candidate.bbox_xyxy)
            if confidence > best:
                best, proposal = confidence, proposal_to_record(candidate)
            if confidence >= self.plan.enough:
                break
        return {"given": sure, "tried": tried, "confidence": best, "proposal": proposal}

    def _confidence(self, photo: Image, obj_id: int, mask: Bool[np.ndarray, "H W"] | None, bbox_xyxy: BBox) -> float:
        """Confidence of the pose that a mask leads to; 0 without a pose."""
        stages, bank = self.context.stages, self.templates.bank(obj_id)
        try:
            query = describe_mask(self.context, photo, mask, bbox_xyxy)
            trace = trace_pose(stages, query, bank)
        except NoPose:
            return 0.0
        if trace.best.solution is None or trace.best.pair is None:
            return 0.0
        route = Route(stages, query, bank)
        geometry = route.geometry(route.view(trace.best), trace.best.pair)
        evidence, _ = collect_evidence(trace, query, geometry, self.templates.extents.read(obj_id))
        assert self.context.calibration is not None, "see check"
        return self.context.calibration.rate(evidence)[0]

    def _rank(self, image: ImageId, obj_id: int) -> Iterator[Proposal]:
        """The proposals that resemble the object's templates most, best first, without near duplicates."""
        self.context.run_task(self.proposals.propose_task, [image], lambda steps: None)
        read, nodes = self.context.store.read, self.proposals
        crops = read(nodes.crops(image))
        if not crops.rows:
            return
        masks, bank = crops.array("mask"), self.templates.bank(obj_id)
        maps = self.context.tensor(read(nodes.features(image)).array("maps"))
        cells = cell_mask(self.context.tensor(masks), cells=maps.shape[-1])
        score = best_masked_cosine(maps, cells, bank.features, bank.cell_mask).cpu()
        colours = colour_profile(crops.array("rgb"), masks)
        score = score + self.plan.colour * best_colour_match(colours, self._template_colours(obj_id))
        records = read(nodes.proposals(image)).document
        kept: list[Bool[np.ndarray, "H W"]] = []
        for row in torch.argsort(score, descending=True, stable=True).tolist():
            proposal = proposal_from_record(records[crops.document["kept"][row]])
            mask = decode_rle(proposal.rle)
            if all(_iou(mask, better) <= self.plan.nms_iou for better in kept):
                kept.append(mask)
                yield proposal
            if len(kept) == self.plan.candidates:
                return

    def _template_colours(self, obj_id: int) -> torch.Tensor:
        if obj_id not in self._colours:
            crops = self.templates.context.store.read(self.templates.crops(obj_id))
            rows = range(0, crops.rows, max(1, crops.rows // COLOURED_TEMPLATES))
            self._colours[obj_id] = colour_profile(crops.array("rgb", rows), crops.array("mask", rows))
        return self._colours[obj_id]


def _from_record(record: Mapping[str, Any]) -> Found:
    proposal = record["proposal"]
    found = None if proposal is None else proposal_from_record(proposal)
    return Found(record["confidence"], record["tried"], record["given"], found)


def _iou(a: Bool[np.ndarray, "H W"], b: Bool[np.ndarray, "H W"]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def search_nodes(context: Context, templates: TemplateNodes) -> SearchNodes | None:
    """Nodes of the detector's search; None for a detector that does not search."""
    plan = context.stages.detect.search_plan
    return None if plan is None else SearchNodes(context, templates, plan)
