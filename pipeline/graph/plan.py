"""Every node of a run with its state, key, size and cost, before anything is spent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from pipeline.graph.context import Context, ImageId
from pipeline.graph.detections import DetectionNodes
from pipeline.graph.poses import PoseNodes
from pipeline.graph.proposals import ProposalNodes
from pipeline.graph.queries import QueryNodes
from pipeline.graph.templates import TemplateNodes
from pipeline.graph.timings import timing_key
from pipeline.io.checkpoints import NotDownloaded
from pipeline.store import Layout, Ref

KEY_DIGITS = 12  # of a key, in tables and in names of folders
TEMPLATE_PIXEL_BYTES = 7  # rgb and float32 depth, before compression


@dataclass(frozen=True)
class Node:
    """One entry as a plan shows it. ``cost``: views to render, images to pass through the backbone, poses to solve.

    Of what is not cached: ``passes``, images through the backbone, counted once for all layers of one pass, and
    ``seconds`` as measured before, None where they are not known. ``sized``: whether ``nbytes`` is known beforehand.
    """

    step: str
    of: str
    ref: Ref
    state: str
    nbytes: int
    cost: str
    passes: int = 0
    seconds: float | None = 0.0
    sized: bool = True


@dataclass(eq=False)
class Plan:
    """Lists nodes. Detections alone are made, since the keys of all that follows depend on them; where they would
    have to be computed the list ends with them.
    """

    context: Context
    templates: TemplateNodes
    queries: QueryNodes
    poses: PoseNodes
    detections: DetectionNodes

    def nodes(self) -> Iterator[Node]:
        """All nodes in the order of the route. Raises NotDownloaded at the first whose key weights decide."""
        unknown: NotDownloaded | None = None
        for obj_id in self.context.object_ids:
            yield from self._views_of_object(obj_id)
            try:
                yield from self._features_of_object(obj_id)
            except NotDownloaded as fault:
                unknown = fault
        if unknown is not None:
            raise unknown
        if self.detections.proposals:
            yield from self._of_proposals(self.detections.proposals)
        if not self.detections.known:
            return
        for image in self.context.image_ids:
            yield from self._of_image(image)
        for group, targets in self.poses.groups.items():
            of, n = f"scene {group[0]} object {group[1]}", len(targets)
            work = timing_key("poses", self.context.stages, rows=self._views(group[1]))
            passes = n * self.context.stages.second_look
            yield self._node("poses", of, self.poses.poses(group), None, f"{n} targets", work, n, passes)

    def _views(self, obj_id: int) -> int:
        return len(self.context.stages.render.cameras(self.context.model(obj_id).mesh)[1])

    def _views_of_object(self, obj_id: int) -> Iterator[Node]:
        _, T_cam_obj, (h, w) = self.context.stages.render.cameras(self.context.model(obj_id).mesh)
        n, of, stages = len(T_cam_obj), f"object {obj_id}", self.context.stages
        size = n * (h * w * TEMPLATE_PIXEL_BYTES + T_cam_obj[0].nbytes)
        ref, crops = self.templates.templates(obj_id), self.templates.crops(obj_id)
        yield self._node("templates", of, ref, size, f"{n} views", timing_key("templates", stages), n)
        size, work = _size(self.context.crops_layout(), n), timing_key("template crops", stages)
        yield self._node("template crops", of, crops, size, f"{n} crops", work, n)

    def _features_of_object(self, obj_id: int) -> Iterator[Node]:
        n, of, stages = self._views(obj_id), f"object {obj_id}", self.context.stages
        refs = {layer: self.templates.features(obj_id, layer) for layer in stages.layers}
        yield from self._features("template features", of, refs, n)
        missing = [fit for fit in stages.fits if not self.context.store.is_complete(self.templates.fitted(obj_id, fit))]
        for fit in stages.fits:
            size = fit.array_bytes(stages.extract.feature_shape(fit.layer)[0], n)
            share = 1 / len(missing) if missing else 0
            ref, work = self.templates.fitted(obj_id, fit), timing_key("fits", stages)
            yield self._node("fits", f"{of} {fit.kind}", ref, size, f"{n} templates", work, share)

    def _of_image(self, image: ImageId) -> Iterator[Node]:
        n, of = len(self.queries.of_image[image]), f"scene {image[0]} image {image[1]}"
        size, work = _size(self.context.crops_layout(), n), timing_key("query crops", self.context.stages)
        yield self._node("query crops", of, self.queries.crops(image), size, f"{n} crops", work, n)
        if n:
            refs = {layer: self.queries.features(image, layer) for layer in self.context.stages.layers}
            yield from self._features("query features", of, refs, n)

    def _of_description(self, described: ProposalNodes, obj_id: int) -> Iterator[Node]:
        n, layer = self._views(obj_id), described.detector.describe_layer
        refs = {layer: described.template_features(obj_id)}
        nodes = self._features("template features", f"object {obj_id}, to be detected by", refs, n, described.context)
        own = {self.templates.features(obj_id, layer) for layer in self.context.stages.layers}
        return (node for node in nodes if node.ref not in own)

    def _of_proposals(self, described: ProposalNodes) -> Iterator[Node]:
        """What detections are computed from, and they themselves."""
        for obj_id in self.context.object_ids:
            yield from self._of_description(described, obj_id)
        for image in self.context.image_ids:
            of = f"scene {image[0]} image {image[1]}"
            ref = described.proposals(image)
            yield self._node("proposals", of, ref, None, "1 image through the proposer")
            ref = described.features(image)
            yield self._node("proposal features", of, ref, None, "its proposals through the backbone")
        follows = "query crops, query features, poses and scores follow from them and are not listed"
        yield self._node("detections", f"{len(self.context.targets)} targets", self.detections.ref, None, follows)

    def _features(
        self, step: str, of: str, refs: Mapping[int, Ref], rows: int, context: Context | None = None
    ) -> Iterator[Node]:
        """A node for every layer; those that are missing come of one pass, which the first of them pays for."""
        context = context or self.context
        missing = [layer for layer, ref in refs.items() if not context.store.is_complete(ref)]
        work = timing_key("features", context.stages, missing) if missing else ""
        for layer, ref in refs.items():
            pays = rows if layer in missing[:1] else 0
            size, cost = _size(context.features_layout(layer), rows), f"{rows} images through the backbone"
            yield self._node(
                step, f"{of} layer {layer}" if context is self.context else of, ref, size, cost, work, pays, pays
            )

    def _node(
        self,
        step: str,
        of: str,
        ref: Ref,
        nbytes: int | None,
        cost: str,
        work: str = "",
        rows: float = 1,
        passes: int = 0,
    ) -> Node:
        """``nbytes`` None: not known beforehand; ``work`` "": seconds nobody measures."""
        stored = self.context.store.size(ref)
        if stored is not None:
            return Node(step, of, ref, "cached", stored, "")
        seconds = self.context.timings.seconds(work, rows) if work and rows else (0.0 if not rows else None)
        state = self.context.store.state(ref)
        return Node(step, of, ref, state, nbytes or 0, cost, passes, seconds, nbytes is not None)


def _size(layouts: Mapping[str, Layout], rows: int) -> int:
    return sum(layout.nbytes(rows) for layout in layouts.values())
