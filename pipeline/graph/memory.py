"""Memory that a run will take at its peak, foretold before anything is spent, and held against the run's budgets.

What follows from shapes is exact: templates of an object as matchers hold them, weights, maps. What a library takes
within a pass is estimated by its largest maps. The process itself is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import psutil
import torch

from pipeline.backbones.batching import BUDGET_SHARE, Footprint, Sized, compute_batch_size
from pipeline.errors import BadInput
from pipeline.graph.context import Context
from pipeline.graph.proposals import ProposalNodes
from pipeline.graph.templates import DRAWN_LARGER
from pipeline.progress import format_bytes

VIEWS_BYTES = 256 << 20  # of whole templates, kept for the next query of their object, where there is a budget
VIEWS_MOST = 64
_VIEWS_DRAWN, _CROPS_CUT = 8, 50  # as templates.py has them at a time
_RAY_BYTES = 160  # origin, direction, hit, colour and normal of a ray
_BATCH, _BANK, _FITS = "a batch", "one object's templates", "fits to one object's templates"
_HELP = {
    _BATCH: "extract.dtype=float16 or a smaller extract.input_size",
    _BANK: "a coarser match.layer or fewer templates (render.count)",
    _FITS: "fewer templates (render.count)",
    "rendering": "a smaller render.size",
    "weights": "extract.dtype=float16 or another model (extract=embedded)",
    "the process": "nothing: that much is taken before anything is computed",
}


@dataclass(frozen=True)
class Memory:
    """Bytes by what takes them: ``always`` through the whole run, and the largest of ``phases``, which come in turn.

    ``unknown``: what is not counted, "" when all is.
    """

    always: Mapping[str, int]
    phases: Mapping[str, int]
    unknown: str = ""

    @property
    def largest(self) -> str:
        """The phase that the peak is in."""
        return max(self.phases, key=lambda name: self.phases[name], default="")

    @property
    def parts(self) -> dict[str, int]:
        """What the peak is made of."""
        return dict(self.always) | ({self.largest: self.phases[self.largest]} if self.phases else {})

    @property
    def peak(self) -> int:
        """Bytes at the peak."""
        return sum(self.parts.values())

    def text(self) -> str:
        """The peak and its parts."""
        told = ", ".join(f"{name} {format_bytes(size)}" for name, size in self.parts.items() if size)
        return f"{format_bytes(self.peak)} ({told}{f'; not counted: {self.unknown}' if self.unknown else ''})"

    def check(self, limit: int | None, field: str, found: object) -> None:
        """Raise BadInput where the peak is above a limit, with what would help."""
        if limit is None or self.peak <= BUDGET_SHARE * limit:
            return
        most = max(self.parts, key=lambda name: self.parts[name])
        helps = dict.fromkeys(_HELP[name.split(" of ")[0]] for name in (self.largest, most) if name)
        spare = f"{format_bytes(self.peak / BUDGET_SHARE)}: a tenth to spare beside {self.text()}"
        raise BadInput(field, found=found, needed=f"{spare}; what would help: {'; '.join(helps)}")


@dataclass(frozen=True)
class Need:
    """What a run's parts take, whatever the device. ``rows``: templates of an object; ``footprint`` None: no pass."""

    rows: int
    weights: int
    footprint: Footprint | None
    render: int
    fits: int
    bank: int
    view: int
    online: int
    look: int
    unknown: tuple[str, ...] = field(default_factory=tuple)


def need_of(context: Context, described: ProposalNodes | None) -> Need:
    """Of the object with most templates, in bytes."""
    stages = context.stages
    _, T_cam_obj, (h, w) = stages.render.cameras(context.model(context.object_ids[0]).mesh)
    n, size = len(T_cam_obj), stages.crop.size
    shapes = {layer: stages.extract.feature_shape(layer) for layer in stages.layers}
    values = {layer: c * rows * columns for layer, (c, rows, columns) in shapes.items()}
    crop = size * size
    finest = max((shapes[layer][1] ** 2 for layer in stages.fuse.layers), default=0)
    cells = {layer: shapes[layer][1] * shapes[layer][2] for layer in shapes}
    if stages.match.fit is not None:
        bank = sum(fit.array_bytes(shapes[fit.layer][0], n) for fit in stages.fits)
    elif stages.match.needs_truth:
        bank = 0
    else:
        bank = n * (2 * values[stages.match.layer] + crop + 24 * cells[stages.match.layer])
    encoded = 0 if stages.fuse.joint else 4 * finest * sum(shapes[layer][0] for layer in stages.fuse.layers)
    footprint, weights, unknown = _extracting(context, described)
    return Need(
        rows=n,
        weights=weights,
        footprint=footprint,
        render=_VIEWS_DRAWN * 8 * h * w + h * w * (1 + getattr(stages.render, "supersample", 1) ** 2) * _RAY_BYTES
        + _CROPS_CUT * (8 * h * w + 4 * crop),
        fits=max((3 * n * values[fit.layer] for fit in stages.fits), default=0),
        bank=bank,
        view=2 * sum(values.values()) + encoded + crop + 4 * h * w,
        online=16 * finest * sum(shapes[layer][0] for layer in stages.fuse.layers),
        look=DRAWN_LARGER**2 * crop * (8 + 2 * _RAY_BYTES) if stages.second_look else 0,
        unknown=unknown,
    )  # fmt: skip


def _extracting(context: Context, described: ProposalNodes | None) -> tuple[Footprint | None, int, tuple[str, ...]]:
    """The larger pass, the weights of all models, and whose size nobody knows."""
    asked = [(context, context.stages.layers)]
    if described is not None and described.context is not context:
        asked.append((described.context, (described.detector.describe_layer,)))
    device = torch.device(context.device).type
    found, unknown = [], []
    for context, layers in asked:
        extract = context.stages.extract
        if isinstance(extract, Sized):
            found.append(extract.footprint(layers, context.stages.crop.size, device))
        else:
            unknown.append(extract.kind)
    weights = sum(footprint.weight_bytes for footprint in found)
    if described is not None:
        weights += getattr(described.detector.proposals, "weight_bytes", int)()
        unknown.append("passes of the proposer")
    return max(found, key=lambda f: f.bytes_per_pass + f.bytes_per_crop, default=None), weights, tuple(unknown)


def memory_of(context: Context, need: Need, *, least: bool = False) -> tuple[Memory, Memory | None]:
    """Of the machine, and of the device where it is another. ``least``: with the smallest batch and one view kept."""
    device = torch.device(context.device)
    process = psutil.Process().memory_info().rss
    batch, a_batch = context.runtime.batch or 1, 0
    if need.footprint is not None:
        if not least:
            fitting = compute_batch_size(need.footprint, context.runtime, device, ahead=need.weights)
            batch = context.runtime.batch or fitting
        batch = min(batch, need.rows)
        a_batch = need.footprint.bytes_per_pass + batch * need.footprint.bytes_per_crop
    views = 1 if least else views_kept(context, need)
    bank = need.bank + need.online + views * need.view
    if need.look and need.footprint is not None:  # a pass while the templates are there
        bank += need.look + need.footprint.bytes_per_pass + need.footprint.bytes_per_crop
    working = {f"{_BATCH} of {batch}": a_batch, _BANK: bank} if a_batch else {_BANK: bank}
    drawing, unknown = {"rendering": need.render, _FITS: need.fits}, ", ".join(need.unknown)
    if device.type == "cpu":
        return Memory({"the process": process, "weights": need.weights}, working | drawing, unknown), None
    passing = {"weights": need.weights, _BANK: need.bank}
    on_device = Memory({"weights": need.weights}, working, unknown)
    return Memory({"the process": process}, drawing | passing, unknown), on_device


def views_kept(context: Context, need: Need) -> int:
    """How many whole templates of an object are kept at a time."""
    on_cpu = context.device == "cpu"
    limit = context.runtime.memory_bytes if on_cpu else context.runtime.vram_bytes
    if limit is None:
        return VIEWS_MOST
    taken = need.weights + need.bank + need.online + (psutil.Process().memory_info().rss if on_cpu else 0)
    room = min(VIEWS_BYTES, int(BUDGET_SHARE * limit) - taken)
    return max(1, min(VIEWS_MOST, room // max(1, need.view)))


def fit_to_budgets(context: Context, described: ProposalNodes | None) -> int:
    """Whole templates that may be kept of an object: VIEWS_MOST, fewer where a budget or their size says so.

    Raises BadInput for a run that cannot fit its budgets whatever its batch, before anything is spent.
    """
    memory, vram = context.runtime.memory_bytes, context.runtime.vram_bytes
    if memory is None and vram is None:
        return VIEWS_MOST
    need = need_of(context, described)
    host, on_device = memory_of(context, need, least=True)
    host.check(memory, "runtime.max_memory", context.runtime.max_memory)
    if on_device is not None:
        on_device.check(vram, "runtime.max_vram", context.runtime.max_vram)
    return views_kept(context, need)
