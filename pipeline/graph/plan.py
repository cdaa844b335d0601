"""Every node of a run with its state, key, size and cost, before anything is spent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.graph.context import Context, ImageId
from pipeline.graph.detections import DetectionNodes
from pipeline.graph.poses import PoseNodes
from pipeline.graph.proposals import ProposalNodes
from pipeline.graph.queries import QueryNodes
from pipeline.graph.templates import TemplateNodes
from pipeline.store import Layout, Ref

TEMPLATE_PIXEL_BYTES = 7  # rgb and float32 depth, before compression


@dataclass(frozen=True)
class Node:
    """One entry as a plan shows it. ``cost``: views to render, images to pass through the backbone, poses to solve."""

    step: str
    of: str
    ref: Ref
    state: str
    nbytes: int
    cost: str


@dataclass(eq=False)
class Plan:
    """Lists nodes. Detections alone are made, since the keys of all that follows depend on them; where they would
    have to be computed the list ends with them.
    """

    run: Context
    templates: TemplateNodes
    queries: QueryNodes
    poses: PoseNodes
    detections: DetectionNodes

    def nodes(self) -> list[Node]:
        """All nodes in the order of the route."""
        nodes = [node for obj_id in self.run.object_ids for node in self._of_object(obj_id)]
        if self.detections.proposals:
            nodes += self._of_proposals(self.detections.proposals)
        if not self.detections.known:
            return nodes
        for image in self.run.image_ids:
            nodes += self._of_image(image)
        for group, targets in self.poses.groups.items():
            of = f"scene {group[0]} object {group[1]}"
            nodes.append(self._node("poses", of, self.poses.poses(group), 0, f"{len(targets)} targets"))
        return nodes

    def _of_object(self, obj_id: int) -> list[Node]:
        _, T_cam_obj, (h, w) = self.run.stages.render.cameras(self.run.model(obj_id).mesh)
        n, of = len(T_cam_obj), f"object {obj_id}"
        size = n * (h * w * TEMPLATE_PIXEL_BYTES + T_cam_obj[0].nbytes)
        nodes = [
            self._node("templates", of, self.templates.templates(obj_id), size, f"{n} views"),
            self._node(
                "template crops", of, self.templates.crops(obj_id), _size(self.run.crops_layout(), n), f"{n} crops"
            ),
        ]
        nodes += [
            self._features("template features", f"{of} layer {layer}", self.templates.features(obj_id, layer), layer, n)
            for layer in self.run.stages.layers
        ]
        return nodes + [
            self._node("fits", f"{of} {fit.kind}", self.templates.fitted(obj_id, fit), 0, f"{n} templates")
            for fit in self.run.stages.fits
        ]

    def _of_image(self, image: ImageId) -> list[Node]:
        n, of = len(self.queries.of_image[image]), f"scene {image[0]} image {image[1]}"
        nodes = [
            self._node("query crops", of, self.queries.crops(image), _size(self.run.crops_layout(), n), f"{n} crops")
        ]
        return nodes + [
            self._features("query features", f"{of} layer {layer}", self.queries.features(image, layer), layer, n)
            for layer in self.run.stages.layers
            if n
        ]

    def _of_description(self, described: ProposalNodes, obj_id: int) -> Node:
        n = len(self.run.stages.render.cameras(self.run.model(obj_id).mesh)[1])
        size = _size(described.run.features_layout(described.detector.describe_layer), n)
        ref, of = described.template_features(obj_id), f"object {obj_id}, to be detected by"
        return self._node("template features", of, ref, size, f"{n} images through the backbone")

    def _of_proposals(self, described: ProposalNodes) -> list[Node]:
        """What detections are computed from, and they themselves."""
        nodes = [self._of_description(described, obj_id) for obj_id in self.run.object_ids]
        for image in self.run.image_ids:
            of = f"scene {image[0]} image {image[1]}"
            nodes.append(self._node("proposals", of, described.proposals(image), 0, "1 image through the proposer"))
            features = described.features(image)
            nodes.append(self._node("proposal features", of, features, 0, "its proposals through the backbone"))
        follows = "query crops, query features, poses and scores follow from them and are not listed"
        of = f"{len(self.run.targets)} targets"
        return [*nodes, self._node("detections", of, self.detections.ref, 0, follows)]

    def _features(self, step: str, of: str, ref: Ref, layer: int, rows: int) -> Node:
        return self._node(
            step, of, ref, _size(self.run.features_layout(layer), rows), f"{rows} images through the backbone"
        )

    def _node(self, step: str, of: str, ref: Ref, nbytes: int, cost: str) -> Node:
        state = self.run.store.state(ref)
        stored = self.run.store.size(ref)
        return Node(step, of, ref, state, nbytes if stored is None else stored, "" if state == "cached" else cost)


def _size(layouts: Mapping[str, Layout], rows: int) -> int:
    return sum(layout.nbytes(rows) for layout in layouts.values())
