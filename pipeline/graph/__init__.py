"""The cached graph: what every result is made from, and the only caller of the store.

A node is an entry of the store. Its key follows from digests of files and from specs alone, so it is known before
anything is computed: a plan costs nothing, a step runs only what is missing, and a sweep over a matching parameter
touches no template and no backbone.

mesh -> templates -> template crops -> template features (by timestep and layer)    templates.py
template features -> what is fitted to them, where a stage stands on it             templates.py
image -> proposals -> crops -> features, for a detector that describes them         proposals.py
files, or features of proposals and templates -> detections                         detections.py
image, detections -> query crops -> query features (by timestep and layer)          queries.py
template features, query features, stages -> poses (by scene and object) -> run     poses.py
poses, ground truth -> scores                                                       scores.py
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch

from pipeline.errors import BadInput
from pipeline.graph.checks import detection_warnings
from pipeline.graph.context import Context
from pipeline.graph.detections import DetectionNodes
from pipeline.graph.memory import Memory, fit_to_budgets, memory_of, need_of
from pipeline.graph.plan import KEY_DIGITS, Node, Plan
from pipeline.graph.plan_text import plan_costs, plan_table
from pipeline.graph.poses import PoseNodes
from pipeline.graph.proposals import proposal_nodes
from pipeline.graph.queries import QueryNodes
from pipeline.graph.replay import Retraced, Retracer
from pipeline.graph.scores import PoseEvaluation, ScoreNodes
from pipeline.graph.tasks import Counts, Task, Workers, use_threads
from pipeline.graph.templates import TemplateNodes
from pipeline.items.features import PSEUDO_LAYERS, SALIENCY_LAYER
from pipeline.items.records import Answer
from pipeline.items.views import Detection
from pipeline.scoring import Scorer

__all__ = [
    "KEY_DIGITS",
    "Context",
    "Counts",
    "Graph",
    "Memory",
    "Node",
    "PoseEvaluation",
    "Retraced",
    "ScoreNodes",
    "Workers",
    "plan_costs",
    "plan_table",
    "use_threads",
]


class Graph:
    """All nodes of one run."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.templates = TemplateNodes(context)
        self.detections = DetectionNodes(context, proposal_nodes(context))
        self.queries = QueryNodes(context, self.detections)
        self.poses = PoseNodes(context, self.templates, self.queries)

    def check(self) -> None:
        """Raise BadInput for a device, weights or a layer that are not there, before any work."""
        self.context.runtime.torch_device()
        _ = self.context.runtime.memory_bytes, self.context.runtime.vram_bytes
        stages = self.context.stages
        stages.fuse.check(stages.extract.model)
        asked = {SALIENCY_LAYER: "correspond"} | dict.fromkeys(stages.fuse.layers, "fuse.layers")
        asked[stages.match.layer] = "match.layer"
        for layer in stages.layers:
            try:
                stages.extract.feature_shape(layer)
            except BadInput as fault:
                if layer == SALIENCY_LAYER and "layer" in fault.where:
                    found = f"{stages.correspond.kind}, and {stages.extract.kind} has no saliency"
                    raise BadInput("correspond", found=found, needed="extract=dino or dinov2") from None
                if "layer" in fault.where:
                    needed = fault.needed.replace(f", {PSEUDO_LAYERS}", "")  # no maps: neither field takes them
                    raise BadInput(asked[layer], found=fault.found, needed=needed) from None
                raise
        if self.detections.proposals:
            if where := self.context.dataset.location_field:
                raise BadInput(where, found=f"with {stages.detect.kind}", needed="detect=photo, or no mask and no box")
            self.detections.proposals.check()
        self.templates.views = fit_to_budgets(self.context, self.detections.proposals)

    def memory(self, *, passes: bool) -> tuple[Memory, Memory | None]:
        """What the run will take at its peak: of the machine, and of the device where that is another.

        ``passes``: whether any image has to go through a backbone.
        """
        need = need_of(self.context, self.detections.proposals)
        return memory_of(self.context, need if passes else replace(need, weights=0, footprint=None))

    def limit_vram(self) -> None:
        """Limit torch's allocator, including the memory it caches, to ``runtime.max_vram``."""
        vram, device = self.context.runtime.vram_bytes, self.context.device
        if vram is not None and device.startswith("cuda"):
            total = torch.cuda.get_device_properties(device).total_memory
            torch.cuda.set_per_process_memory_fraction(min(1.0, vram / total), device)

    def onboard(self) -> None:
        """Everything offline, for every object of the targets."""
        kinds = [self.templates.onboarding]
        if self.detections.proposals and not self.detections.known:
            kinds.append(self.detections.proposals.describing)
        with self.context.progress.bar(len(kinds) * len(self.context.object_ids), "onboarding", "object") as advance:
            for task in kinds:
                self.context.run_task(task, self.context.object_ids, advance)

    def do(self, work: str, unit: Any) -> Counts:
        """One unit of a kind of work, for whoever asks for it by name; returns what was computed for it."""
        before: list[Task[Any]] = [self.templates.onboarding]
        if self.detections.proposals:
            before += [self.detections.proposals.describing, self.detections.proposals.proposing_all]
        after: list[Task[Any]] = [self.queries.describing, self.poses.solving]
        if work in [kind.name for kind in after]:
            self.detect()
        self.context.progress.counts.clear()
        next(kind for kind in before + after if kind.name == work).do(unit, lambda rows: None)
        return dict(self.context.progress.counts)

    def detect(self) -> list[Detection]:
        """Detections of all targets, those that cannot be used included."""
        return self.detections.all

    def warnings(self) -> list[str]:
        """What is odd about the detections, a line each."""
        return detection_warnings(self.context, self.detect())

    def estimate(self) -> list[Answer]:
        """An answer for every detection of every target, and for every target without one."""
        self.detect()  # first: a fault in its files must not wait for hours of onboarding
        if not self.context.store.is_complete(self.poses.run_ref()):
            for obj_id in self.context.object_ids:
                self.context.model(obj_id)  # nor must a mesh that does not fit its annotations
        self.onboard()
        return self.poses.estimate()

    def scores(self, scorer: Scorer, *, correspondences: bool = False) -> ScoreNodes:
        """The node of the poses' scores, and with them those of the correspondences they were solved from."""
        retrace = self.retracer() if correspondences else None
        return ScoreNodes(self.context, self.templates, self.poses, scorer, retrace)

    def retracer(self) -> Retracer:
        """Shows how answers came about."""
        return Retracer(self.templates, self.queries, self.poses)

    def plan(self) -> Iterator[Node]:
        """Every node with its state, key, size and cost. Raises NotDownloaded at a key that missing weights decide."""
        return Plan(self.context, self.templates, self.queries, self.poses, self.detections).nodes()
