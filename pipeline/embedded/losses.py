"""Losses of the training stages: reconstruction, correspondences, retrieval."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from pipeline.embedded.batches import CELLS, PairBatch
from pipeline.functional.masks import cell_mask

_NEAR_DEG = 12.0  # standard deviation of the target weights over the angle to the query's view
_MATCHED_DEG = 25.0  # poses are solved from templates about this near; correspondences with others weigh less


def reconstruction_loss(
    decoded: Float[Tensor, "n 3 H W"], image: Float[Tensor, "n 3 H W"], mean: Tensor, logvar: Tensor
) -> Float[Tensor, ""]:
    """L1 of pixels and their gradients, and a small weight on the prior (Kingma, Welling, ICLR 2014)."""
    error = decoded - image
    slope = error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
    prior = 0.5 * (mean.square() + logvar.exp() - 1 - logvar).mean()
    return error.abs().mean() + slope + 1e-4 * prior


def split_by_role(
    maps: Shaped[Tensor, "n d h w"], batch: PairBatch
) -> tuple[Shaped[Tensor, "b c q d h w"], Shaped[Tensor, "b c t d h w"]]:
    """Maps of queries and of templates, by object and cluster of views."""
    b, c, q, t = batch.matched.shape[:4]
    by_cluster = maps.unflatten(0, (b, c, q + t))
    return by_cluster[:, :, :q], by_cluster[:, :, q:]


def correspondence_loss(descriptors: Float[Tensor, "n d h w"], batch: PairBatch, scale: Tensor) -> Float[Tensor, ""]:
    """Cross entropy of a query cell's cosines over a template's foreground cells (InfoNCE).

    The target is the bilinear weight of the four cells around the true position. Correspondences with less than half
    of this weight in the foreground are ignored, and those with distant templates have low weight.
    """
    query, template = (maps.flatten(0, 1) for maps in split_by_role(normalize(descriptors.float(), dim=1), batch))
    xy = batch.query_xy.flatten(0, 1)
    g, q, t, m = xy.shape[:4]  # g: clusters of all objects
    flat = query.flatten(3).transpose(2, 3)  # g q k d
    query_cells = flat.gather(2, _index(xy).reshape(g, q, t * m, 1).expand(-1, -1, -1, flat.shape[-1]))
    query_cells = scale * query_cells.unflatten(2, (t, m)).transpose(1, 2).reshape(g * t, q * m, -1)
    inside = cell_mask(batch.mask, cells=CELLS).flatten(1).unflatten(0, (g, q + t))[:, q:].reshape(g * t, 1, -1)
    logits = torch.baddbmm(torch.where(inside, 0.0, -1e4), query_cells, template.reshape(g * t, -1, CELLS * CELLS))

    place, weight = _bilinear(batch.template_xy.flatten(0, 1).transpose(1, 2).reshape(g * t, q * m, 2))
    weight = weight * inside.expand(-1, q * m, -1).gather(2, place)
    total = weight.sum(-1)
    usable = batch.matched.flatten(0, 1).transpose(1, 2).reshape(g * t, q * m) & (total > 0.5)
    hit = (weight * logits.gather(2, place)).sum(-1) / total.clamp(min=0.5)
    counted = usable * _angle_weight(batch).reshape(g * t, q, 1).expand(-1, -1, m).reshape(g * t, q * m)
    return ((logits.logsumexp(-1) - hit) * counted).sum() / counted.sum().clamp(min=1)


def _angle_weight(batch: PairBatch) -> Float[Tensor, "g t q"]:
    """Weight of each query with each template of its own cluster, by their angle."""
    by_cluster = batch.angle_deg.unflatten(3, (-1, batch.matched.shape[3]))  # b c q c t
    own = by_cluster.diagonal(dim1=1, dim2=3).permute(0, 3, 2, 1).flatten(0, 1)  # b q t c -> g t q
    return torch.exp(-0.5 * (own / _MATCHED_DEG) ** 2)


def _index(xy: Float[Tensor, "*n 2"]) -> Int64[Tensor, "*n"]:
    return (xy[..., 1] * CELLS + xy[..., 0]).long()


def _bilinear(xy: Float[Tensor, "*n 2"]) -> tuple[Int64[Tensor, "*n 4"], Float[Tensor, "*n 4"]]:
    """Indices of the four cells around each position, and their bilinear weights."""
    xy = xy.clamp(0, CELLS - 1.001)
    low = xy.floor()
    part = xy - low
    corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], device=xy.device)
    weight = (1 - corners - part[..., None, :]).abs().prod(-1)
    return _index(low[..., None, :] + corners), weight


def retrieval_scores(maps: Float[Tensor, "n d h w"], batch: PairBatch) -> Float[Tensor, "b c q ct"]:
    """As in match=masked_cosine: sum of cosines over the cells in both masks / number of cells in either."""
    query, template = split_by_role(normalize(maps.float(), dim=1), batch)
    of_query, of_template = split_by_role(cell_mask(batch.mask, cells=maps.shape[-1])[:, None], batch)
    template, of_template = template.flatten(1, 2)[:, None, None], of_template.flatten(1, 2)[:, None, None, :, 0]
    query, of_query = query[:, :, :, None], of_query[:, :, :, None, 0]
    cosine = (query * template).sum(-3)
    both, either = of_query & of_template, of_query | of_template
    return (cosine * both).sum((-2, -1)) / either.sum((-2, -1)).clamp(min=1)


def retrieval_loss(
    scores: Float[Tensor, "b c q ct"], angle_deg: Float[Tensor, "b c q ct"], scale: Tensor
) -> Float[Tensor, ""]:
    """Cross entropy over an object's templates; the target decreases with the angle to the query's view."""
    target = torch.softmax(-0.5 * (angle_deg / _NEAR_DEG) ** 2, dim=-1)
    return -(target * (scores * scale).log_softmax(-1)).sum(-1).mean()
