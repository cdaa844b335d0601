"""Nodes of a plan -> text for the terminal: a table of all nodes and the cost of the missing ones."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.graph.plan import KEY_DIGITS, Node
from pipeline.progress import format_bytes, format_duration


def plan_table(nodes: Sequence[Node]) -> str:
    """One line per node, then a total for each state."""
    lines = [f"{'state':<9}{'size':>10}  {'key':<{KEY_DIGITS}}  node"]
    for node in nodes:
        cost = f"  ({node.cost})" if node.cost else ""
        key = node.ref.key[:KEY_DIGITS]
        lines.append(f"{node.state:<9}{format_bytes(node.nbytes):>10}  {key}  {node.step}: {node.of}{cost}")
    for state in sorted({node.state for node in nodes}):
        sizes = [node.nbytes for node in nodes if node.state == state]
        lines.append(f"{len(sizes)} nodes {state}, {format_bytes(sum(sizes))}")
    return "\n".join(lines)


def plan_costs(nodes: Sequence[Node]) -> str:
    """Disk space, backbone passes and time of the nodes that are not cached, a line each."""
    missing = [node for node in nodes if node.state != "cached"]
    passes = f"{sum(node.passes for node in missing)} images through the backbone"
    return f"disk    {_disk_text(missing)}\npasses  {passes}\ntime    {_time_text(missing)}"


def _disk_text(missing: Sequence[Node]) -> str:
    exact_bytes = sum(node.nbytes for node in missing if not _is_compressed(node))
    at_most_bytes = sum(node.nbytes for node in missing if node.sized and _is_compressed(node))
    text = f"{format_bytes(exact_bytes)} of features, fits and encodings"
    text += f", at most {format_bytes(at_most_bytes)} of templates and crops (compressed)"
    unsized = dict.fromkeys(node.step for node in missing if not node.sized)
    return f"{text}, and the records of {', '.join(unsized)}" if unsized else text


def _is_compressed(node: Node) -> bool:
    return "crops" in node.step or node.step == "templates"


def _time_text(missing: Sequence[Node]) -> str:
    seconds_by_step: dict[str, list[float | None]] = {}
    for node in missing:
        seconds_by_step.setdefault(node.step, []).append(node.seconds)
    measured: dict[str, float] = {}
    unknown: list[str] = []
    for step, seconds in seconds_by_step.items():
        known = [s for s in seconds if s is not None]
        if len(known) == len(seconds):
            measured[step] = sum(known)
        else:
            unknown.append(step)
    parts = []
    if measured:
        by_step = ", ".join(f"{step} {format_duration(seconds)}" for step, seconds in measured.items())
        parts.append(f"{format_duration(sum(measured.values()))} ({by_step})")
    if unknown:
        parts.append(f"unknown for {', '.join(unknown)}: not measured on this machine in this store")
    return " and ".join(parts) or "nothing to compute"
