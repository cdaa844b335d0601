"""Passes of an extractor: the memory they take, known before any weight is loaded, and how many crops each has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import psutil
import torch

from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.parallel import ordered_map, worker_count
from pipeline.spec import Runtime

BUDGET_SHARE = 0.9  # of a budget; the rest is headroom for what libraries allocate on their own
MAP_VALUE_BYTES = 10  # a value of a returned map: float32, a copy of it, and the float16 that is stored
CPU_PASS_BYTES = 1 << 30  # keeps all of SD 1.5 in float32 under 6 GB; larger passes are no faster per crop on a CPU


@dataclass(frozen=True)
class Footprint:
    """Memory of a model and its passes. A pass of n crops needs ``bytes_per_pass`` + n ``bytes_per_crop``.

    ``max_batch``: crops beyond which a larger pass on a GPU is no faster per crop. ``cpu_pass``: crops of a pass on
    the CPU.
    """

    weight_bytes: int
    bytes_per_pass: int
    bytes_per_crop: int
    max_batch: int
    cpu_pass: int = 1


def maps_bytes(shapes: Sequence[tuple[int, int, int]]) -> int:
    """Bytes of one crop's maps until they are stored."""
    return MAP_VALUE_BYTES * sum(c * h * w for c, h, w in shapes)


def choose_cpu_pass(bytes_per_pass: int, bytes_per_crop: int, max_batch: int) -> int:
    """Crops of a pass on the CPU.

    Kernels round differently for other shapes, so it follows from the model alone, not from memory, threads or
    ``runtime.batch``.
    """
    return max(1, min((CPU_PASS_BYTES - bytes_per_pass) // bytes_per_crop, max_batch))


def compute_batch_size(footprint: Footprint, runtime: Runtime, device: torch.device, *, ahead: int = 0) -> int:
    """Crops per call: ``runtime.batch``, or what fits into the device's free memory and the run's budgets.

    On a GPU a call is one pass, of 1 to ``footprint.max_batch`` crops. On the CPU it is a whole number of passes of
    ``footprint.cpu_pass`` crops, by default one for each worker thread. ``ahead``: bytes of weights that will be loaded
    after this call; 0 once they are in memory.
    """
    if device.type == "cuda":
        return runtime.batch or _fit_gpu_batch(footprint, runtime, device, ahead)
    if runtime.batch:
        return footprint.cpu_pass * -(-runtime.batch // footprint.cpu_pass)
    free = (psutil.virtual_memory().available - ahead) // 4
    if (limit := runtime.memory_bytes) is not None:
        free = min(free, int(BUDGET_SHARE * limit) - psutil.Process().memory_info().rss - ahead)
    passes = free // max(1, footprint.bytes_per_pass + footprint.cpu_pass * footprint.bytes_per_crop)
    return footprint.cpu_pass * max(1, min(passes, worker_count()))


def _fit_gpu_batch(footprint: Footprint, runtime: Runtime, device: torch.device, ahead: int) -> int:
    free = int(0.6 * (torch.cuda.mem_get_info(device)[0] - ahead))
    if (limit := runtime.vram_bytes) is not None:
        free = min(free, int(BUDGET_SHARE * limit) - torch.cuda.memory_allocated(device) - ahead)
    return max(1, min((free - footprint.bytes_per_pass) // max(1, footprint.bytes_per_crop), footprint.max_batch))


def bytes_of_batch(footprint: Footprint, batch: int, device: torch.device) -> int:
    """Memory that a call with ``batch`` crops takes, besides the weights."""
    passes = 1 if device.type == "cuda" else min(-(-batch // footprint.cpu_pass), worker_count())
    return passes * footprint.bytes_per_pass + batch * footprint.bytes_per_crop


@dataclass(frozen=True)
class Passes:
    """How a backbone splits its crops: ``batch`` crops per call, ``size`` per pass, a divisor of ``batch``."""

    device: torch.device
    batch: int
    size: int

    @classmethod
    def choose(cls, footprint: Footprint, runtime: Runtime, device: torch.device) -> Passes:
        """Passes that fit into memory; on a GPU a call is one pass."""
        batch = compute_batch_size(footprint, runtime, device)
        return cls(device, batch, batch if device.type == "cuda" else footprint.cpu_pass)

    def run(self, run_pass: Callable[[Crops], FeatureMaps], crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of all crops; on the CPU several passes run at the same time.

        On the CPU the bytes depend neither on threads nor on ``batch``: each pass has the same shape and the same crops
        whatever the batch, and its kernels run on one thread.
        """
        parts = [crops[i : i + self.size] for i in range(0, len(crops), self.size)]
        maps = [run_pass(p) for p in parts] if self.device.type == "cuda" else list(ordered_map(run_pass, parts))
        # concatenated outside inference mode: the maps are ordinary tensors again, free for use in place
        return {layer: torch.cat([found[layer] for found in maps]).contiguous() for layer in layers}
