"""Cosine similarities: between whole maps, between cells inside masks, between cells with the same label."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.functional.products import row_products

_CPU_BLOCK, _CUDA_BLOCK = 1 << 19, 1 << 27  # values per block: fits the CPU's cache; amortises kernel launches on CUDA
_PAIRS_BLOCK = 1 << 22  # cell pairs compared at a time
_MAX_GROUP_RATIO = 4  # groups hold at most this many times the mean number of rows per label; larger ones are split


def l2_normalize(x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    """Vectors scaled to length 1 along the last axis; zero vectors stay zero."""
    return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp(min=torch.finfo(x.dtype).tiny)


def global_cosine(
    query: Float[Tensor, "c h w"], bank: Float[Tensor, "n c h w"], *, norm: Float[Tensor, " n"] | None = None
) -> Float[Tensor, " n"]:
    """Cosine of the flattened query map with each flattened map of the bank; 0 where a map is all zero.

    The bank may be float16; sums are float32. ``norm``: precomputed ``map_norms(bank)``, which halves the time.
    """
    q = l2_normalize(query.float().flatten())
    dot = torch.cat([block.flatten(1) @ q for block in _float_blocks(bank)])
    return _divide_or_zero(dot, map_norms(bank) if norm is None else norm)


def joint_cosine(
    query: Sequence[Float[Tensor, "_c _h _w"]],
    bank: Sequence[Float[Tensor, "n _c _h _w"]],
    *,
    norms: Sequence[Float[Tensor, " n"]],
) -> Float[Tensor, " n"]:
    """Cosine of several maps as one vector: all values of the query's maps with those of each row of the bank's.

    ``norms``: ``map_norms`` of each map of the bank.
    """
    parts = [
        global_cosine(q, b, norm=norm) * norm * q.float().norm() for q, b, norm in zip(query, bank, norms, strict=True)
    ]
    query_norm = torch.stack([q.float().norm() for q in query]).norm()
    return _divide_or_zero(torch.stack(parts).sum(0), torch.stack(list(norms)).norm(dim=0) * query_norm)


def map_norms(bank: Float[Tensor, "n c h w"]) -> Float[Tensor, " n"]:
    """L2 norms of the flattened maps, float32."""
    return torch.cat([torch.linalg.vector_norm(block.flatten(1), dim=1) for block in _float_blocks(bank)])


def cell_cosine(
    query: Float[Tensor, "c h w"], bank: Float[Tensor, "n c h w"], *, norm: Float[Tensor, "n h w"] | None = None
) -> Float[Tensor, "n h w"]:
    """Cosine of each query cell with the same cell of every map in the bank; 0 where a cell is all zero.

    ``norm``: precomputed ``cell_norms(bank)``, which halves the time.
    """
    q = l2_normalize(query.float().movedim(0, -1)).movedim(-1, 0).contiguous()
    dot = torch.cat([(block * q).sum(1) for block in _float_blocks(bank)])
    return _divide_or_zero(dot, cell_norms(bank) if norm is None else norm)


def cell_norms(bank: Float[Tensor, "n c h w"]) -> Float[Tensor, "n h w"]:
    """L2 norm of every cell of the maps, float32."""
    return torch.cat([(block * block).sum(1).sqrt() for block in _float_blocks(bank)])


def masked_mean(
    values: Float[Tensor, "n h w"], mask: Bool[Tensor, "n h w"], *, count: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """Sum inside the mask divided by ``count`` (which may exceed the mask's size); 0 where the count is 0."""
    return _divide_or_zero((values * mask).sum((1, 2)), count)


def mutual_nearest(similarity: Float[Tensor, "a b"]) -> Int[Tensor, "p 2"]:
    """(row, column) of every entry that is the maximum of both its row and its column, ordered by row."""
    column = similarity.argmax(1)
    row = torch.arange(len(similarity), device=similarity.device)
    mutual = similarity.argmax(0)[column] == row
    return torch.stack([row[mutual], column[mutual]], dim=1)


def nearest_with_same_label(
    a: Float[Tensor, "m c"], a_label: Int[Tensor, " m"], b: Float[Tensor, "n c"], b_label: Int[Tensor, " n"]
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
    """For each row of a: dot product with, and index of, the most similar row of b that has the same label.

    Labels count from 0. Where b has no row of that label the similarity is -inf and the index 0. Rows are compared by
    batched matrix products of equally sized groups of one label each, padded with index -1: a loop over hundreds of
    small labels would spend its time on calls.
    """
    similarity = torch.full((len(a),), -torch.inf, device=a.device)
    index = torch.zeros(len(a), dtype=torch.int64, device=a.device)
    if len(a) == 0 or len(b) == 0:
        return similarity, index
    labels = int(torch.maximum(a_label.max(), b_label.max())) + 1
    present, rows_of_present = _group_by_label(b_label, max_size=len(b))
    rows_of_label = torch.full((labels, rows_of_present.shape[1]), -1, device=b.device)
    rows_of_label[present] = rows_of_present
    mean_size = -(-len(a) // labels)
    max_size = min(_MAX_GROUP_RATIO * mean_size, max(1, _PAIRS_BLOCK // rows_of_label.shape[1]))
    group_label, groups = _group_by_label(a_label, max_size=max_size)
    width = groups.shape[1]
    values_per_group = max(a.shape[1], width) * max(width, rows_of_label.shape[1])  # gathered rows, or their products
    groups_per_batch = max(1, _PAIRS_BLOCK // values_per_group)
    for group, label in zip(groups.split(groups_per_batch), group_label.split(groups_per_batch), strict=True):
        candidates = rows_of_label[label]
        largest = int((candidates >= 0).sum(1).max())
        candidates = candidates[:, : max(1, largest)]
        products = (a[group] @ b[candidates].mT).masked_fill_(candidates[:, None] < 0, -torch.inf)
        best = products.max(dim=2)
        is_row = group >= 0
        similarity[group[is_row]] = best.values[is_row]
        index[group[is_row]] = candidates.gather(1, best.indices)[is_row].clamp(min=0)
    return similarity, index


def nearest_rows(
    a: Float[Tensor, "m c"], b: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"], Bool[Tensor, " m"]]:
    """For each row of a: dot product with, and index of, the most similar row of b, and whether it is also b's best.

    One matrix product serves both directions. Equal products: the first row of b, and every such row of a is its best.
    """
    products = row_products(a, b)
    if products.is_cuda:
        nearest, best = products.argmax(1), products.amax(0)
    else:  # numpy finds maxima several times as fast
        nearest, best = torch.from_numpy(products.numpy().argmax(1)), torch.from_numpy(products.numpy().max(0))
    similarity = products.gather(1, nearest[:, None])[:, 0]
    return similarity, nearest, similarity == best[nearest]


def best_per_group(
    value: Float[Tensor, " m"], group: Int[Tensor, " m"], candidate: Bool[Tensor, " m"], *, count: int
) -> Int[Tensor, " k"]:
    """Indices of the ``count`` candidates with the highest value in each group.

    Ordered by group, then by descending value; ties keep the order of their indices.
    """
    index = candidate.nonzero()[:, 0]
    index = index[torch.sort(value[index], descending=True, stable=True).indices]
    ordered, by_group = torch.sort(group[index], stable=True)
    return index[by_group][_rank_in_run(ordered) < count]


def _group_by_label(label: Int[Tensor, " m"], *, max_size: int) -> tuple[Int[Tensor, " g"], Int[Tensor, "g w"]]:
    """Label of each group, and its indices padded with -1; labels with more than ``max_size`` fill several groups."""
    ordered, order = torch.sort(label, stable=True)
    column = _rank_in_run(ordered) % max_size
    row = (column == 0).cumsum(0) - 1
    table = torch.full((int(row[-1]) + 1, int(column.max()) + 1), -1, device=label.device)
    table[row, column] = order
    return ordered[column == 0], table


def _rank_in_run(ordered: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
    """Position of each element of a sorted tensor among the elements equal to it: [3 3 5] -> [0 1 0]."""
    return torch.arange(len(ordered), device=ordered.device) - torch.searchsorted(ordered, ordered)


def _float_blocks(bank: Tensor) -> Iterator[Tensor]:
    """The bank in float32, block by block, in one reused buffer: allocating each block takes longer than the sums."""
    values = _CUDA_BLOCK if bank.is_cuda else _CPU_BLOCK
    rows = max(1, values // max(1, bank[0].numel()))
    buffer = torch.empty((min(rows, len(bank)), *bank.shape[1:]), dtype=torch.float32, device=bank.device)
    for block in bank.split(rows):
        yield buffer[: len(block)].copy_(block)


def _divide_or_zero(numerator: Tensor, denominator: Tensor) -> Tensor:
    return torch.where(denominator > 0, numerator / denominator, torch.zeros_like(numerator))
