"""Cosine similarities: of whole maps, of cells inside masks, of cells with the same label."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_CPU_BLOCK, _CUDA_BLOCK = 1 << 20, 1 << 27  # values: the CPU's fits its cache, CUDA's amortises launches
_PAIRS_BLOCK = 1 << 22  # cell pairs compared at a time
_EVEN = 4  # labels of up to this many times the mean number of rows are compared as they are, larger ones in parts


def l2_normalize(x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    """Rows of length 1; a row of zeros stays."""
    return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp(min=torch.finfo(x.dtype).tiny)


def global_cosine(
    query: Float[Tensor, "c h w"], bank: Float[Tensor, "n c h w"], *, norm: Float[Tensor, " n"] | None = None
) -> Float[Tensor, " n"]:
    """Cosine of the flattened maps, 0 where a map is all zero. The bank may be float16; sums are float32.

    ``norm``: the bank's ``map_norms``, which take as long as all the rest, where they are known.
    """
    q = l2_normalize(query.float().flatten())
    dot = torch.cat([block.flatten(1) @ q for block in _float_blocks(bank)])
    return _divided(dot, map_norms(bank) if norm is None else norm)


def map_norms(bank: Float[Tensor, "n c h w"]) -> Float[Tensor, " n"]:
    """Lengths of the flattened maps, float32."""
    return torch.cat([torch.linalg.vector_norm(block.flatten(1), dim=1) for block in _float_blocks(bank)])


def cell_cosine(query: Float[Tensor, "c h w"], bank: Float[Tensor, "n c h w"]) -> Float[Tensor, "n h w"]:
    """Cosine of every cell of the query with the same cell of each map of the bank, 0 for cells of zeros."""
    q = l2_normalize(query.float().movedim(0, -1)).movedim(-1, 0).contiguous()
    dot, norm = [], []
    for block in _float_blocks(bank):
        dot.append((block * q).sum(1))
        norm.append((block * block).sum(1).sqrt())
    return _divided(torch.cat(dot), torch.cat(norm))


def sum_over_count(
    values: Float[Tensor, "n h w"], mask: Bool[Tensor, "n h w"], *, over: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """Sum inside the mask over the given cell counts; 0 where the count is 0."""
    return _divided((values * mask).sum((1, 2)), over)


def mutual_nearest(similarity: Float[Tensor, "a b"]) -> Int[Tensor, "p 2"]:
    """Rows and columns that are each other's most similar, by row."""
    column = similarity.argmax(1)
    row = torch.arange(len(similarity), device=similarity.device)
    mutual = similarity.argmax(0)[column] == row
    return torch.stack([row[mutual], column[mutual]], dim=1)


def nearest_with_same_label(
    a: Float[Tensor, "m c"], a_label: Int[Tensor, " m"], b: Float[Tensor, "n c"], b_label: Int[Tensor, " n"]
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
    """Similarity a.b and index of the row of b most similar to each row of a among those with its label.

    Labels count from 0. Similarity is -inf, and the index 0, where b has no row of that label.
    """
    similarity = torch.full((len(a),), -torch.inf, device=a.device)
    index = torch.zeros(len(a), dtype=torch.int64, device=a.device)
    if len(a) == 0 or len(b) == 0:
        return similarity, index
    labels = int(torch.maximum(a_label.max(), b_label.max())) + 1
    there, columns = _by_label(b_label, most=len(b))
    members = torch.full((labels, columns.shape[1]), -1, device=b.device).index_copy_(0, there, columns)
    most = min(_EVEN * -(-len(a) // labels), max(1, _PAIRS_BLOCK // columns.shape[1]))
    label, rows = _by_label(a_label, most=most)
    values = max(a.shape[1], rows.shape[1]) * max(rows.shape[1], columns.shape[1])  # of a line: gathered or compared
    for line, of in zip(*(x.split(max(1, _PAIRS_BLOCK // values)) for x in (rows, label)), strict=True):
        others, real = members[of], line >= 0
        others = others[:, : max(1, int((others >= 0).sum(1).max()))]  # as wide as the largest label of these lines
        pairs = (a[line] @ b[others].mT).masked_fill_(others[:, None] < 0, -torch.inf)
        best = pairs.max(dim=2)
        similarity[line[real]] = best.values[real]
        index[line[real]] = others.gather(1, best.indices)[real].clamp(min=0)
    return similarity, index


def best_per_group(
    value: Float[Tensor, " m"], group: Int[Tensor, " m"], candidate: Bool[Tensor, " m"], *, count: int
) -> Int[Tensor, " k"]:
    """Indices of each group's ``count`` candidates of highest value: by group, best first, of equals the first."""
    index = candidate.nonzero()[:, 0]
    index = index[torch.sort(value[index], descending=True, stable=True).indices]
    ordered, by_group = torch.sort(group[index], stable=True)
    return index[by_group][_rank(ordered) < count]


def _by_label(label: Int[Tensor, " m"], *, most: int) -> tuple[Int[Tensor, " l"], Int[Tensor, "l w"]]:
    """Lines of indices of equal label, at most ``most`` in one and -1 after the last; and the label of each line."""
    ordered, order = torch.sort(label, stable=True)
    place = _rank(ordered) % most
    row = (place == 0).cumsum(0) - 1
    table = torch.full((int(row[-1]) + 1, int(place.max()) + 1), -1, device=label.device)
    table[row, place] = order
    return ordered[place == 0], table


def _rank(ordered: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
    """How many equals stand before each element of a sorted list."""
    return torch.arange(len(ordered), device=ordered.device) - torch.searchsorted(ordered, ordered)


def _float_blocks(bank: Tensor) -> Iterator[Tensor]:
    """Blocks of a bank in float32: each is overwritten by the next, for fresh memory costs more than the sums."""
    values = _CUDA_BLOCK if bank.is_cuda else _CPU_BLOCK
    rows = max(1, values // max(1, bank[0].numel()))
    into = torch.empty((min(rows, len(bank)), *bank.shape[1:]), dtype=torch.float32, device=bank.device)
    for block in bank.split(rows):
        yield into[: len(block)].copy_(block)


def _divided(numerator: Tensor, denominator: Tensor) -> Tensor:
    return torch.where(denominator > 0, numerator / denominator, torch.zeros_like(numerator))
