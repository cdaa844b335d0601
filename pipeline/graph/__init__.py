"""The cached graph: every intermediate result of a run, and the only code that reads and writes the store.

A node is an entry of the store. Its key is derived from specs and file digests, so it is known before anything is
computed: plans are free, a run computes only what is missing, and a sweep over a matching parameter reuses all
renderings and features.

mesh -> templates -> template crops -> template features (by timestep and layer)    templates.py
template features -> fitted arrays, for stages that need them                       templates.py
image -> proposals -> crops -> features, for detectors that describe proposals      proposals.py
files, or features of proposals and templates -> detections                         detections.py
image, detections -> query crops -> query features (by timestep and layer)          queries.py
template features, query features, stages -> poses (by scene and object) -> run     poses.py
poses, ground truth -> scores                                                       scores.py
"""

from pipeline.graph.context import Context
from pipeline.graph.graph import Graph
from pipeline.graph.memory import Memory
from pipeline.graph.plan import KEY_DIGITS, Node
from pipeline.graph.plan_text import plan_costs, plan_table
from pipeline.graph.replay import Replay
from pipeline.graph.scores import PoseEvaluation, ScoreNodes
from pipeline.graph.tasks import Counts, Workers

__all__ = [
    "KEY_DIGITS",
    "Context",
    "Counts",
    "Graph",
    "Memory",
    "Node",
    "PoseEvaluation",
    "Replay",
    "ScoreNodes",
    "Workers",
    "plan_costs",
    "plan_table",
]
