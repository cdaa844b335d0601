"""Nodes of a run with their state, key, size and cost, without computing anything."""

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

KEY_DIGITS = 12  # digits of a key shown in tables and names of folders
TEMPLATE_PIXEL_BYTES = 7  # uint8 rgb and float32 depth, before compression


@dataclass(frozen=True)
class Node:
    """One entry as a plan shows it. ``cost``: what computing it takes; "" for a cached entry.

    For a missing entry, ``passes`` counts images through the backbone (once for all layers of one pass) and
    ``seconds`` estimates its time, None if unknown. ``sized`` is False if ``nbytes`` is unknown before it is computed.
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
    """Lists the nodes of a run.

    All later keys depend on the detections. Detections are read if they come from files; if they would have to be
    computed, the list ends there.
    """

    context: Context
    templates: TemplateNodes
    queries: QueryNodes
    poses: PoseNodes
    detections: DetectionNodes

    def nodes(self) -> Iterator[Node]:
        """All nodes in the order of the route. Raises NotDownloaded after the nodes that need no missing weights."""
        not_downloaded: NotDownloaded | None = None
        for obj_id in self.context.object_ids:
            yield from self._view_nodes(obj_id)
            try:
                yield from self._template_feature_nodes(obj_id)
            except NotDownloaded as error:
                not_downloaded = error
        if not_downloaded is not None:
            raise not_downloaded
        searches = self.detections.searches
        if proposals := self.detections.proposals or (searches and searches.proposals):
            yield from self._proposal_nodes(proposals)
        if not self.detections.known:
            return
        for image in self.context.image_ids:
            yield from self._query_nodes(image)
        yield from self._pose_nodes()

    def _view_nodes(self, obj_id: int) -> Iterator[Node]:
        stages = self.context.stages
        _, T_cam_obj, (h, w) = stages.render.cameras(self.context.model(obj_id).mesh)
        n, of = len(T_cam_obj), f"object {obj_id}"
        nbytes = n * (h * w * TEMPLATE_PIXEL_BYTES + T_cam_obj[0].nbytes)
        timing = timing_key("templates", stages)
        yield self._node("templates", of, self.templates.templates(obj_id), nbytes, f"{n} views", timing, n)
        nbytes, timing = _total_bytes(self.context.crops_layout(), n), timing_key("template crops", stages)
        yield self._node("template crops", of, self.templates.crops(obj_id), nbytes, f"{n} crops", timing, n)
        if (extent := self.templates.extents.ref(obj_id)) is not None:
            yield self._node("symmetries", of, extent, None, "1 mesh")

    def _template_feature_nodes(self, obj_id: int) -> Iterator[Node]:
        n, of, stages = self._count_views(obj_id), f"object {obj_id}", self.context.stages
        refs = {layer: self.templates.features(obj_id, layer) for layer in stages.layers}
        yield from self._feature_nodes("template features", of, refs, n)
        refs_of_fits = {fit: self.templates.fitted(obj_id, fit) for fit in stages.fits}
        missing = [fit for fit, ref in refs_of_fits.items() if not self.context.store.is_complete(ref)]
        share = 1 / len(missing) if missing else 0  # only the time of all fits of an object together was measured
        for fit, ref in refs_of_fits.items():
            nbytes = fit.array_bytes(stages.extract.feature_shape(fit.layer)[0], n)
            timing = timing_key("fits", stages)
            yield self._node("fits", f"{of} {fit.kind}", ref, nbytes, f"{n} templates", timing, share)
        if (encodings := self.templates.encodings(obj_id)) is not None:
            timing = timing_key("template encodings", stages)
            nbytes = _total_bytes(self.templates.encodings_layout(), n)
            yield self._node("template encodings", of, encodings, nbytes, f"{n} templates", timing, n)

    def _proposal_nodes(self, proposals: ProposalNodes) -> Iterator[Node]:
        """The detections and their inputs."""
        for obj_id in self.context.object_ids:
            yield from self._described_template_nodes(proposals, obj_id)
        for image in self.context.image_ids:
            of = f"scene {image[0]} image {image[1]}"
            yield self._node("proposals", of, proposals.proposals(image), None, "1 image through the proposer")
            cost = "its proposals through the backbone"
            yield self._node("proposal features", of, proposals.features(image), None, cost)
        cost = "query crops, query features, poses and scores depend on them and are not listed"
        yield self._node("detections", f"{len(self.context.targets)} targets", self.detections.ref, None, cost)

    def _described_template_nodes(self, proposals: ProposalNodes, obj_id: int) -> Iterator[Node]:
        n, layer = self._count_views(obj_id), proposals.describer.layer
        refs = {layer: proposals.template_features(obj_id)}
        of = f"object {obj_id}, for the detector"
        nodes = self._feature_nodes("template features", of, refs, n, proposals.context)
        listed = {self.templates.features(obj_id, layer) for layer in self.context.stages.layers}
        return (node for node in nodes if node.ref not in listed)

    def _query_nodes(self, image: ImageId) -> Iterator[Node]:
        n, of, stages = len(self.queries.of_image[image]), f"scene {image[0]} image {image[1]}", self.context.stages
        nbytes, timing = _total_bytes(self.context.crops_layout(), n), timing_key("query crops", stages)
        yield self._node("query crops", of, self.queries.crops(image), nbytes, f"{n} crops", timing, n)
        if n:
            refs = {layer: self.queries.features(image, layer) for layer in stages.layers}
            yield from self._feature_nodes("query features", of, refs, n)

    def _pose_nodes(self) -> Iterator[Node]:
        for (scene_id, obj_id), targets in self.poses.groups.items():
            n, of, stages = len(targets), f"scene {scene_id} object {obj_id}", self.context.stages
            timing = timing_key("poses", stages, rows=self._count_views(obj_id))
            ref, passes = self.poses.poses((scene_id, obj_id)), n * stages.second_look.hypotheses
            yield self._node("poses", of, ref, None, f"{n} targets", timing, n, passes)

    def _feature_nodes(
        self, step: str, of: str, refs: Mapping[int, Ref], rows: int, context: Context | None = None
    ) -> Iterator[Node]:
        """A node per layer. One pass computes all missing layers; its cost is listed with the first of them."""
        context = context or self.context
        missing = [layer for layer, ref in refs.items() if not context.store.is_complete(ref)]
        timing = timing_key("features", context.stages, missing) if missing else ""
        for layer, ref in refs.items():
            passes = rows if layer in missing[:1] else 0
            name = f"{of} layer {layer}" if context is self.context else of
            nbytes = _total_bytes(context.features_layout(layer), rows)
            cost = f"{rows} images through the backbone"
            yield self._node(step, name, ref, nbytes, cost, timing, passes, passes)

    def _node(
        self,
        step: str,
        of: str,
        ref: Ref,
        nbytes: int | None,
        cost: str,
        timing: str = "",
        rows: float = 1,
        passes: int = 0,
    ) -> Node:
        """A node with its state. ``nbytes``: None if unknown beforehand; ``timing``: "" if not measured."""
        stored = self.context.store.size(ref)
        if stored is not None:
            return Node(step, of, ref, "cached", stored, "")
        seconds = self.context.timings.seconds(timing, rows) if timing and rows else (0.0 if not rows else None)
        state = self.context.store.state(ref)
        return Node(step, of, ref, state, nbytes or 0, cost, passes, seconds, nbytes is not None)

    def _count_views(self, obj_id: int) -> int:
        return len(self.context.stages.render.cameras(self.context.model(obj_id).mesh)[1])


def _total_bytes(layouts: Mapping[str, Layout], rows: int) -> int:
    return sum(layout.nbytes(rows) for layout in layouts.values())
