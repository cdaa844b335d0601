"""Estimate peak memory up front and enforce the budgets ``runtime.max_memory`` and ``runtime.max_vram``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import psutil
import torch

from pipeline.backbones.batching import BUDGET_SHARE, bytes_of_batch, compute_batch_size
from pipeline.errors import BadInput
from pipeline.graph.context import Context
from pipeline.graph.memory_needs import MemoryNeeds, estimate_needs
from pipeline.graph.proposals import ProposalNodes
from pipeline.progress import format_bytes

MAX_CACHED_VIEWS = 64
CACHED_VIEWS_BYTES = 256 << 20  # limit of cached views if there is a budget
_BATCH, _BANK, _FITS = "a batch", "one object's templates", "fits to one object's templates"
_HELP = {
    _BATCH: "extract.dtype=float16 or a smaller extract.input_size",
    _BANK: "a coarser match.layer or fewer templates (render.count)",
    _FITS: "fewer templates (render.count)",
    "rendering": "a smaller render.size",
    "weights": "extract.dtype=float16 or another model (extract=embedded)",
    "the process": "a larger budget, since the imports alone take that much",
}


@dataclass(frozen=True)
class Memory:
    """Bytes by purpose: ``always`` during the whole run, ``phases`` one after the other.

    ``unknown`` names what is not counted, "" if everything is.
    """

    always: Mapping[str, int]
    phases: Mapping[str, int]
    unknown: str = ""

    @property
    def largest_phase(self) -> str:
        """The phase with the highest need."""
        return max(self.phases, key=lambda name: self.phases[name], default="")

    @property
    def parts(self) -> dict[str, int]:
        """Bytes by purpose at the peak."""
        return dict(self.always) | ({self.largest_phase: self.phases[self.largest_phase]} if self.phases else {})

    @property
    def peak(self) -> int:
        """Bytes at the peak."""
        return sum(self.parts.values())

    def text(self) -> str:
        """The peak and its parts, for the terminal."""
        parts = ", ".join(f"{name} {format_bytes(size)}" for name, size in self.parts.items() if size)
        return f"{format_bytes(self.peak)} ({parts}{f'; not counted: {self.unknown}' if self.unknown else ''})"

    def check(self, limit: int | None, field: str, found: object) -> None:
        """Raise BadInput if the peak exceeds a limit; the message says what would reduce it."""
        if limit is None or self.peak <= BUDGET_SHARE * limit:
            return
        largest_part = max(self.parts, key=lambda name: self.parts[name])
        helps = dict.fromkeys(_HELP[name.split(" of ")[0]] for name in (self.largest_phase, largest_part) if name)
        needed = f"{format_bytes(self.peak / BUDGET_SHARE)}: {self.text()} and a tenth of headroom"
        raise BadInput(field, found=found, needed=f"{needed}; what would help: {'; '.join(helps)}")


def estimate_peak(context: Context, needs: MemoryNeeds, *, minimal: bool = False) -> tuple[Memory, Memory | None]:
    """Peak memory of the machine, and of the device if that is a GPU.

    ``minimal``: with the smallest batch and one cached view, the minimum for a run.
    """
    device = torch.device(context.device)
    process = psutil.Process().memory_info().rss
    batch, batch_bytes = _estimate_batch(context, needs, device, minimal=minimal)
    views = 1 if minimal else count_cached_views(context, needs)
    bank = needs.bank + needs.online + views * needs.view
    if needs.rerender and needs.footprint is not None:  # hypotheses are rendered and encoded with the bank in memory
        bank += needs.rerender + bytes_of_batch(needs.footprint, 1, device)
    on_device = {f"{_BATCH} of {batch}": batch_bytes, _BANK: bank} if batch_bytes else {_BANK: bank}
    on_cpu, unknown = {"rendering": needs.render, _FITS: needs.fits}, ", ".join(needs.unknown)
    if device.type == "cpu":
        return Memory({"the process": process, "weights": needs.weights}, on_device | on_cpu, unknown), None
    loading = {"weights": needs.weights, _BANK: needs.bank}  # both go through the machine's memory
    machine = Memory({"the process": process}, on_cpu | loading, unknown)
    return machine, Memory({"weights": needs.weights}, on_device, unknown)


def _estimate_batch(context: Context, needs: MemoryNeeds, device: torch.device, *, minimal: bool) -> tuple[int, int]:
    """Crops per backbone pass, and bytes of a pass; 0 bytes if nothing passes through a backbone."""
    runtime, footprint = context.runtime, needs.footprint
    if footprint is None:
        return runtime.batch or 1, 0
    if minimal:
        runtime = replace(runtime, batch=runtime.batch or 1)
    batch = compute_batch_size(footprint, runtime, device, ahead=needs.weights)
    return min(batch, needs.templates), bytes_of_batch(footprint, min(batch, needs.templates), device)


def count_cached_views(context: Context, needs: MemoryNeeds) -> int:
    """How many complete templates of an object fit into the cache: 1 to MAX_CACHED_VIEWS."""
    on_cpu = context.device == "cpu"
    limit = context.runtime.memory_bytes if on_cpu else context.runtime.vram_bytes
    if limit is None:
        return MAX_CACHED_VIEWS
    taken = needs.weights + needs.bank + needs.online + (psutil.Process().memory_info().rss if on_cpu else 0)
    room = min(CACHED_VIEWS_BYTES, int(BUDGET_SHARE * limit) - taken)
    return max(1, min(MAX_CACHED_VIEWS, room // max(1, needs.view)))


def fit_to_budgets(context: Context, proposals: ProposalNodes | None) -> int:
    """Number of complete templates to cache, so that the run stays within its budgets.

    Raises BadInput before anything is computed if even the smallest batch exceeds a budget.
    """
    memory, vram = context.runtime.memory_bytes, context.runtime.vram_bytes
    if memory is None and vram is None:
        return MAX_CACHED_VIEWS
    needs = estimate_needs(context, proposals)
    machine, device = estimate_peak(context, needs, minimal=True)
    machine.check(memory, "runtime.max_memory", context.runtime.max_memory)
    if device is not None:
        device.check(vram, "runtime.max_vram", context.runtime.max_vram)
    return count_cached_views(context, needs)
