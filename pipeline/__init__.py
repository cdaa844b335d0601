"""Zero-shot 6DoF object poses from diffusion features. ``PoseEstimator`` is the Python API."""

import os
from typing import Any

__version__ = "0.1.0"
__all__ = ["BadInput", "DzopError", "PoseEstimator", "PoseResult", "save_results"]

# Before torch starts its threads: on a busy machine threads that spin while they wait slow small operations tenfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_PLACES = {
    "BadInput": "pipeline.errors",
    "DzopError": "pipeline.errors",
    "PoseEstimator": "pipeline.estimator",
    "PoseResult": "pipeline.outputs.pose_result",
    "save_results": "pipeline.outputs.photo_files",
}


def __getattr__(name: str) -> Any:
    """Import what the API offers when it is first used: torch and the others take seconds."""
    from importlib import import_module

    if name not in _PLACES:
        raise AttributeError(f"module 'pipeline' has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)
