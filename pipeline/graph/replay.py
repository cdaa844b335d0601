"""answer -> its intermediate results, recomputed from stored features for the template it used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from pipeline.graph.poses import PoseNodes
from pipeline.graph.queries import QueryNodes
from pipeline.graph.templates import TemplateNodes
from pipeline.items.online import Hypothesis
from pipeline.items.records import Answer
from pipeline.items.views import Detection
from pipeline.parallel import one_thread_per_kernel


@dataclass(frozen=True, eq=False)
class Replay:
    """Crops of a detection and of the matched view, and the hypothesis; None for steps that were not reached."""

    detection: Detection
    query_rgb: UInt8[np.ndarray, "S S 3"]
    template_rgb: UInt8[np.ndarray, "S S 3"] | None = None
    hypothesis: Hypothesis | None = None


@dataclass(eq=False)
class Replayer:
    """Repeats the online route of answers of one run; the last ones are still in memory."""

    templates: TemplateNodes
    queries: QueryNodes
    poses: PoseNodes

    @one_thread_per_kernel()
    def __call__(self, answer: Answer) -> Replay | None:
        """The intermediate results of an answer; None where there is no crop to show."""
        if answer.detection_id is None:
            return None
        context, image = self.queries.context, (answer.scene_id, answer.im_id)
        index, detection = self.queries.of_target[*image, answer.obj_id][answer.detection_id]
        found = next((f for f in self.queries.found(image) if f.index == index), None)
        if found is None:
            return None
        query_rgb = context.store.read(self.queries.crops(image)).array("rgb", [found.row])[0]
        if answer.template_id is None:
            return Replay(detection, query_rgb)
        trace = self.poses.retrace(found, self.templates.bank(answer.obj_id))
        hypothesis = trace.best
        if trace.query is not None and trace.query.rgb is not None:
            query_rgb = trace.query.rgb
        if hypothesis.rerendered is not None:
            return Replay(detection, query_rgb, hypothesis.rerendered.rgb, hypothesis)
        crops = context.store.read(self.templates.crops(answer.obj_id))
        return Replay(detection, query_rgb, crops.array("rgb", [answer.template_id])[0], hypothesis)
