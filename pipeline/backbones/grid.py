"""Layers of the extractors without a network, with the numbers and sizes of Stable Diffusion's at 512 px, hook pre."""

from __future__ import annotations

from pipeline.errors import BadInput

CELLS = {2: 8, 5: 16, 8: 32, 11: 64}


def count_cells(layer: int) -> int:
    """Cells along one side of a layer's map. Raises BadInput for a layer that does not exist."""
    if layer not in CELLS:
        raise BadInput("extract layer", found=layer, needed=f"one of {', '.join(map(str, CELLS))}")
    return CELLS[layer]
