"""targets -> detections, of files or of proposals that look like templates: one entry for all of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pipeline.graph.context import Context
from pipeline.graph.proposals import ProposalNodes
from pipeline.io.digests import files_digest
from pipeline.items.records import detection_from_record, detection_to_record
from pipeline.items.views import Detection
from pipeline.spec import digest
from pipeline.stages.detect import DescribingDetector
from pipeline.store import Ref, make_ref


@dataclass(eq=False)
class DetectionNodes:
    """The entry of a run's detections. ``proposals``: what a detector that describes stands on, None for others."""

    context: Context
    proposals: ProposalNodes | None

    @cached_property
    def ref(self) -> Ref:
        """All detections of the targets."""
        recipe = {"kind": "detections", "detect": self.context.stages.detect.recipe()}
        targets = [[t.scene_id, t.im_id, t.obj_id, t.inst_count] for t in self.context.targets]
        return make_ref("detections", recipe, self._sources() | {"targets": self._asked(targets)})

    def _asked(self, targets: list[list[int]]) -> str:
        return digest([targets, None if self.proposals else self.context.dataset.given_bbox_xyxy])

    def _sources(self) -> dict[str, str]:
        """What decides the answer beside the targets."""
        detect, root = self.context.stages.detect, self.context.dataset.root
        if not isinstance(detect, DescribingDetector):
            files = detect.sources(self.context.dataset, self.context.targets)
            named = {p.relative_to(root).as_posix() if p.is_relative_to(root) else p.name: p for p in files}
            return {"sources": files_digest(named)}
        assert self.proposals is not None
        objects = {
            f"object {obj_id}": self.proposals.template_features(obj_id).key for obj_id in self.context.object_ids
        }
        images = {f"image {s}/{i}": self.proposals.features((s, i)).key for s, i in self.context.image_ids}
        return objects | images

    @property
    def known(self) -> bool:
        """Whether they can be had without proposing or describing anything."""
        return self.proposals is None or self.context.store.is_complete(self.ref)

    @cached_property
    def all(self) -> list[Detection]:
        """Detections of the targets, made once."""
        fresh = not self.context.store.is_complete(self.ref)
        if fresh:
            found = self._find()
            self.context.store.put_document(self.ref, [detection_to_record(d) for d in found], rows=len(found))
        found = [detection_from_record(record) for record in self.context.store.read(self.ref).document]
        self.context.progress.add("detections", **{"computed" if fresh else "reused": len(found)})
        return found

    def identity(self, detection: Detection) -> dict[str, Any]:
        """What poses depend on: seconds that were measured here, other in every run, are no part of it."""
        record = detection_to_record(detection)
        return record | {"time_s": 0.0} if self.proposals else record

    def _find(self) -> list[Detection]:
        detect = self.context.stages.detect
        if not isinstance(detect, DescribingDetector):
            return detect(self.context.dataset, self.context.targets)
        assert self.proposals is not None
        with self.context.progress.bar(len(self.context.object_ids), "descriptions", "object") as advance:
            self.context.run_task(self.proposals.describing, self.context.object_ids, advance)
        templates = {obj_id: self.proposals.template_descriptors(obj_id) for obj_id in self.context.object_ids}
        found: list[Detection] = []
        with self.context.progress.bar(len(self.context.image_ids), "proposals", "image") as advance:
            self.context.run_task(self.proposals.proposing_all, self.context.image_ids, advance)
        for image in self.context.image_ids:
            targets = [t for t in self.context.targets if (t.scene_id, t.im_id) == image]
            described = self.proposals.described(image)
            found += detect.by_description(targets, *described, templates, self.proposals.time_s(image))
        return found
