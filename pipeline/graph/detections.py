"""targets -> detections, read from files or made from proposals that look like templates. One entry per run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from pipeline.bop.images import image_digest
from pipeline.bop.masks import encode_rle
from pipeline.errors import BadInput
from pipeline.graph.context import Context
from pipeline.graph.proposals import ProposalNodes
from pipeline.graph.searches import SearchNodes
from pipeline.io.digests import file_digest
from pipeline.items.records import detection_from_record, detection_to_record
from pipeline.items.views import Detection
from pipeline.parallel import one_thread_per_kernel
from pipeline.spec import digest
from pipeline.stages.detect import Descriptors
from pipeline.store import Ref, make_ref

MAX_REASONS = 4  # reasons listed in the error that no detection is usable


@dataclass(eq=False)
class DetectionNodes:
    """The entry of a run's detections. ``proposals``: None for detectors that read files and have no describer."""

    context: Context
    proposals: ProposalNodes | None
    searches: SearchNodes | None = None

    @property
    def computed(self) -> bool:
        """Whether detections are computed, not only read from files."""
        return self.proposals is not None or self.searches is not None

    @cached_property
    def ref(self) -> Ref:
        """All detections of the targets."""
        stages = self.context.stages
        recipe = {"kind": "detections", "detect": stages.detect.recipe()}
        if stages.segments:
            recipe["segment"] = stages.segment.recipe()
        if self.searches is not None:
            recipe["search"] = self.searches.recipe()
        targets = [[t.scene_id, t.im_id, t.obj_id, t.inst_count] for t in self.context.targets]
        asked: list[Any] = [targets, None]
        if not self.proposals:
            asked = [targets, self.context.dataset.given_bbox_xyxy, *self.context.dataset.given_location]
        return make_ref("detections", recipe, self._sources() | {"targets": digest(asked)})

    def _sources(self) -> dict[str, str]:
        """Digests of the detector's inputs: files, or features of proposals and templates."""
        proposals, context = self.proposals, self.context
        if proposals is None:
            files = context.stages.detect.sources(context.dataset, context.targets)
            digests = {"sources": _digest_sources(files, context.dataset.root)}
            if self.searches is not None:
                digests |= self.searches.inputs()
            if not context.stages.segments:
                return digests
            return digests | {f"image {s}/{i}": context.dataset.image_digest(s, i) for s, i in context.image_ids}
        objects = {f"object {obj_id}": proposals.template_features(obj_id).key for obj_id in context.object_ids}
        images = {f"image {s}/{i}": proposals.features((s, i)).key for s, i in context.image_ids}
        return objects | images

    @property
    def known(self) -> bool:
        """Whether the detections are available without computing proposals or features."""
        return not self.computed or self.context.store.is_complete(self.ref)

    @cached_property
    def all(self) -> list[Detection]:
        """Detections of the targets, read from the store or computed.

        Raises BadInput if they come from files and none is usable. A detector that finds nothing is no error.
        """
        store, is_new = self.context.store, not self.context.store.is_complete(self.ref)
        if is_new:
            detections = self._detect()
            store.put_document(self.ref, [detection_to_record(d) for d in detections], rows=len(detections))
        detections = [detection_from_record(record) for record in store.read(self.ref).document]
        if not self.computed and detections and all(d.defect for d in detections):
            raise self._no_usable_detection(detections)
        self.context.progress.add("detections", **{"computed" if is_new else "reused": len(detections)})
        return detections

    def identity(self, detection: Detection) -> dict[str, Any]:
        """The part of a detection that poses depend on: all but the measured seconds, which differ in every run."""
        record = detection_to_record(detection)
        return record | {"time_s": 0.0} if self.computed else record

    def _no_usable_detection(self, detections: Sequence[Detection]) -> BadInput:
        """The error that lists the reasons, each with its first detection."""
        context, first = self.context, {d.defect: d for d in reversed(detections)}
        counts = Counter(d.defect for d in detections).most_common(MAX_REASONS)
        places = [(first[why], n) for why, n in counts]
        reasons = [f"{n} x {d.defect} (scene {d.scene_id}, image {d.im_id}, object {d.obj_id})" for d, n in places]
        files = context.stages.detect.sources(context.dataset, context.targets)
        found = f"{len(detections)} detections of targets and none that is usable: {'; '.join(reasons)}"
        return BadInput(files[0] if files else "detect", found=found, needed="at least one usable detection")

    @one_thread_per_kernel()
    def _detect(self) -> list[Detection]:
        descriptors = None if self.proposals is None else self._describe(self.proposals)
        detections = self.context.stages.detect(self.context.dataset, self.context.targets, descriptors)
        if self.context.stages.segments:
            detections = [self._segment(d) for d in detections]
        return detections if self.searches is None else self.searches.complete(detections)

    def _segment(self, detection: Detection) -> Detection:
        """The detection, with a mask segmented inside its box if it had none and that succeeds; keeps the given box."""
        if detection.rle is not None or detection.defect is not None:
            return detection
        photo = self.context.dataset.image(detection.scene_id, detection.im_id)
        mask = self.context.stages.segment(photo.rgb, detection.bbox_xyxy)
        return detection if mask is None else replace(detection, rle=encode_rle(mask), guessed=True)

    def _describe(self, proposals: ProposalNodes) -> Descriptors:
        """Descriptors of all objects and images; missing ones are computed."""
        context = self.context
        with context.progress.bar(len(context.object_ids), "descriptions", "object") as advance:
            context.run_task(proposals.describe_task, context.object_ids, advance)
        with context.progress.bar(len(context.image_ids), "proposals", "image") as advance:
            context.run_task(proposals.propose_task, context.image_ids, advance)
        templates = {obj_id: proposals.template_descriptors(obj_id) for obj_id in context.object_ids}
        return Descriptors(templates, proposals.image_descriptors)


def _digest_sources(files: Sequence[Path], root: Path) -> str:
    """Digest of a detector's files, independent of the dataset's location. Files of equal name all count."""
    digest_of: dict[str, str] = {}
    for path in dict.fromkeys(files):
        name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
        while name in digest_of:
            name += "'"  # a photograph and its mask often have the same name, in different folders
        is_json = path.suffix in (".json", ".gz")
        digest_of[name] = file_digest(path) if is_json else image_digest(path, photograph=False)
    lines = "".join(f"{name}\0{content}\n" for name, content in sorted(digest_of.items()))
    return sha256(lines.encode()).hexdigest()
