"""The graph of one run: its nodes, its steps and its plan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch

from pipeline.errors import BadInput
from pipeline.graph.checks import check_layers, detection_warnings, distance_warnings, mesh_warnings
from pipeline.graph.context import Context
from pipeline.graph.detections import DetectionNodes
from pipeline.graph.memory import Memory, estimate_peak, fit_to_budgets
from pipeline.graph.memory_needs import estimate_needs
from pipeline.graph.plan import Node, Plan
from pipeline.graph.poses import PoseNodes
from pipeline.graph.proposals import proposal_nodes
from pipeline.graph.queries import QueryNodes
from pipeline.graph.replay import Replayer
from pipeline.graph.scores import ScoreNodes
from pipeline.graph.searches import search_nodes
from pipeline.graph.tasks import Counts, Task
from pipeline.graph.templates import TemplateNodes
from pipeline.items.records import Answer
from pipeline.items.views import Detection
from pipeline.machine import describe_machine, machine_text
from pipeline.parallel import one_thread_per_kernel
from pipeline.scoring import Scorer


class Graph:
    """All nodes of one run. ``templates``: reused from a graph with the same stages and objects."""

    def __init__(self, context: Context, templates: TemplateNodes | None = None) -> None:
        self.context = context
        self.templates = templates or TemplateNodes(context)
        searches = search_nodes(context, self.templates)
        self.detections = DetectionNodes(context, proposal_nodes(context), searches)
        self.queries = QueryNodes(context, self.detections)
        self.poses = PoseNodes(context, self.templates, self.queries)

    def check(self) -> None:
        """Check device, budgets, weights and layers before anything is computed. Raises BadInput."""
        runtime, stages = self.context.runtime, self.context.stages
        self.context.store.made_by = describe_machine(runtime.torch_device())
        _ = runtime.memory_bytes, runtime.vram_bytes  # these raise BadInput for text that is no size
        stages.fuse.check(stages.extract)
        check_layers(stages)
        self.poses.priors.check()
        if stages.detect.finds_objects and (where := self.context.dataset.location_field):
            raise BadInput(where, found=f"with {stages.detect.kind}", needed="detect=photo, or no mask and no box")
        if self.detections.proposals:
            self.detections.proposals.check()
        if self.detections.searches:
            self.detections.searches.check()
        self.templates.views = fit_to_budgets(self.context, self.detections.proposals)

    def memory(self, *, passes: bool) -> tuple[Memory, Memory | None]:
        """Estimated peak memory of the machine, and of the device if that is a GPU.

        ``passes`` says whether any image has to pass through a backbone.
        """
        needs = estimate_needs(self.context, self.detections.proposals)
        return estimate_peak(self.context, needs if passes else replace(needs, weights=0, footprint=None))

    def limit_vram(self) -> None:
        """Limit torch's allocator, including the memory it caches, to ``runtime.max_vram``."""
        vram, device = self.context.runtime.vram_bytes, self.context.device
        if vram is not None and device.startswith("cuda"):
            total = torch.cuda.get_device_properties(device).total_memory
            torch.cuda.set_per_process_memory_fraction(min(1.0, vram / total), device)

    # --- steps -------------------------------------------------------------------------------------------------------

    def onboard(self) -> None:
        """Compute everything that needs no image, for all objects of the targets."""
        tasks = [self.templates.onboard_task]
        if self.detections.proposals and not self.detections.known:
            tasks.append(self.detections.proposals.describe_task)
        object_ids = self.context.object_ids
        with self.context.progress.bar(len(tasks) * len(object_ids), "onboarding", "object") as advance:
            for task in tasks:
                self.context.run_task(task, object_ids, advance)

    def detect(self) -> list[Detection]:
        """Detections of all targets, including those that cannot be used."""
        return self.detections.all

    def detection_warnings(self) -> list[str]:
        """Results of sanity checks on detections and cameras, one line each; no mesh is read for them."""
        return detection_warnings(self.context, self.detect())

    def warnings(self) -> list[str]:
        """Results of sanity checks on dataset, detections, cameras and meshes, one line each."""
        distances = distance_warnings(self.context, self.detect(), self.templates.mesh_facts)
        return self.detection_warnings() + self.mesh_warnings() + distances

    def mesh_warnings(self) -> list[str]:
        """Results of sanity checks on meshes. A mesh is read only if its templates are missing."""
        return mesh_warnings(self.context, self.templates.mesh_facts)

    def estimate(self) -> list[Answer]:
        """An answer for every detection of every target, and for every target without one."""
        # Read detections and meshes first, so that errors in their files do not appear after hours of onboarding.
        self.detect()
        if not self.context.store.is_complete(self.poses.run_ref()):
            for obj_id in self.context.object_ids:
                self.templates.mesh_facts(obj_id)
        self.onboard()
        return self.poses.estimate()

    def scores(self, scorer: Scorer, *, correspondences: bool = False) -> ScoreNodes:
        """The node of the poses' scores, optionally including scores of their correspondences."""
        replayer = self.replayer() if correspondences else None
        return ScoreNodes(self.context, self.templates, self.poses, scorer, replayer)

    def replayer(self) -> Replayer:
        """Recomputes the intermediate results of an answer from stored features."""
        return Replayer(self.templates, self.queries, self.poses)

    def machines(self) -> list[str]:
        """One line per machine, with its versions, that computed templates, features or poses of this run."""
        templates, queries, context = self.templates, self.queries, self.context
        refs = [templates.templates(obj_id) for obj_id in context.object_ids]
        refs += [templates.features(obj_id, layer) for obj_id in context.object_ids for layer in context.stages.layers]
        refs += [queries.features(image, layer) for image in context.image_ids for layer in context.stages.layers]
        refs += [self.poses.poses(group) for group in self.poses.groups]
        makers = [context.store.maker(ref) for ref in refs]
        return sorted({machine_text(maker) for maker in makers if maker})

    @one_thread_per_kernel()
    def run_item(self, task: str, item: Any) -> Counts:
        """Run one item of the task with this name, in a worker; returns the counts of its steps."""
        tasks: list[Task[Any]] = [self.templates.onboard_task, self.queries.describe_task, self.poses.solve_task]
        if self.detections.proposals:
            tasks += [self.detections.proposals.describe_task, self.detections.proposals.propose_task]
        if self.detections.searches:
            tasks.append(self.detections.searches.proposals.propose_task)
        if task in (self.queries.describe_task.name, self.poses.solve_task.name):
            self.detect()  # does not belong to the item's counts
        self.context.progress.counts.clear()
        next(t for t in tasks if t.name == task).do(item, lambda steps: None)
        return dict(self.context.progress.counts)

    def plan(self) -> Iterator[Node]:
        """Every node with its state, key, size and cost. Raises NotDownloaded if a key depends on missing weights."""
        return Plan(self.context, self.templates, self.queries, self.poses, self.detections).nodes()
