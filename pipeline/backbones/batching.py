"""Memory that an extractor needs, estimated before any weight is loaded, and the batch size that fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import psutil
import torch

from pipeline.spec import Runtime

CPU_WORKING_BYTES = 1 << 30  # keeps all of SD 1.5 in float32 under 6 GB; larger batches gain nothing on a CPU
BUDGET_SHARE = 0.9  # of a budget; the rest is headroom for what libraries allocate on their own
MAP_VALUE_BYTES = 10  # a value of a returned map: float32, a copy of it, and the float16 that is stored


@dataclass(frozen=True)
class Footprint:
    """Memory of a model and its passes. A pass of n crops needs ``bytes_per_pass`` + n ``bytes_per_crop``.

    ``max_batch``: crops beyond which a larger pass is no faster per crop.
    """

    weight_bytes: int
    bytes_per_pass: int
    bytes_per_crop: int
    max_batch: int


def maps_bytes(shapes: Sequence[tuple[int, int, int]]) -> int:
    """Bytes of one crop's maps until they are stored."""
    return MAP_VALUE_BYTES * sum(c * h * w for c, h, w in shapes)


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
