"""Memory of an extractor: what it will take, known before any weight is loaded, and the batch that fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import psutil
import torch

from pipeline.spec import Runtime

CPU_WORKING_BYTES = 1 << 30  # keeps all of SD 1.5 in float32 under 6 GB; larger batches gain nothing on a CPU
BUDGET_SHARE = 0.9  # of a budget; the rest is for what libraries take unasked
MAPS_BYTES = 10  # a value of a map that is returned: float32, a copy of it, and the float16 that is stored


@dataclass(frozen=True)
class Footprint:
    """Bytes: of the weights, of a pass however many crops it has, and of each crop in it.

    ``max_batch``: crops beyond which a pass gains nothing.
    """

    weight_bytes: int
    bytes_per_pass: int
    bytes_per_crop: int
    max_batch: int


def maps_bytes(shapes: Sequence[tuple[int, int, int]]) -> int:
    """What the maps of one crop take until they are stored."""
    return MAPS_BYTES * sum(c * h * w for c, h, w in shapes)


def compute_batch_size(footprint: Footprint, runtime: Runtime, device: torch.device, *, ahead: int = 0) -> int:
    """Crops per pass that fit into the device's free memory and the run's budgets: 1 to ``footprint.max_batch``.

    ``ahead``: bytes of weights that will be loaded after this call; 0 once they are in memory.
    """
    if device.type == "cuda":
        free = int(0.6 * (torch.cuda.mem_get_info(device)[0] - ahead))
        if (limit := runtime.vram_bytes) is not None:
            free = min(free, int(BUDGET_SHARE * limit) - torch.cuda.memory_allocated(device) - ahead)
    else:
        free = min((psutil.virtual_memory().available - ahead) // 4, CPU_WORKING_BYTES)
        if (limit := runtime.memory_bytes) is not None:
            free = min(free, int(BUDGET_SHARE * limit) - psutil.Process().memory_info().rss - ahead)
    return max(1, min((free - footprint.bytes_per_pass) // max(1, footprint.bytes_per_crop), footprint.max_batch))
