"""What is asked of each network: reconstruction, noise, correspondences, retrieval."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pipeline.embedded.batches import CELLS, PairBatch
from pipeline.functional.masks import cell_mask

_BLUR_CELLS = 0.6  # of a correspondence's target: points lie between cells
_NEAR_DEG = 12.0  # templates about this far off are half as good as the query's own view


def reconstruction_loss(
    made: Float[Tensor, "n 3 H W"], image: Float[Tensor, "n 3 H W"], mean: Tensor, logvar: Tensor
) -> Float[Tensor, ""]:
    """L1 of pixels and of their differences, and a trace of the prior (Kingma, Welling, ICLR 2014)."""
    error = made - image
    slope = error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
    prior = 0.5 * (mean.square() + logvar.exp() - 1 - logvar).mean()
    return error.abs().mean() + slope + 1e-4 * prior


def sides(
    maps: Float[Tensor, "n c h w"], batch: PairBatch
) -> tuple[Float[Tensor, "b q c h w"], Float[Tensor, "b t c h w"]]:
    """Maps of queries and of templates, by cluster."""
    b, q, t = batch.angle_deg.shape
    by_cluster = maps.unflatten(0, (b, q + t))
    return by_cluster[:, :q], by_cluster[:, q:]


def correspondence_logits(
    descriptors: Float[Tensor, "n d h w"], batch: PairBatch
) -> tuple[Float[Tensor, "b q t m k"], Bool[Tensor, "b t k"]]:
    """Cosines of each query cell in question with all cells of each template, and which of these are foreground."""
    query, template = sides(normalize(descriptors.float(), dim=1), batch)
    index = (batch.query_xy[..., 1] * CELLS + batch.query_xy[..., 0]).long()
    b, q, t, m = index.shape
    flat = query.flatten(3).transpose(2, 3)  # b q k d
    asked = flat.gather(2, index.reshape(b, q, t * m, 1).expand(-1, -1, -1, flat.shape[-1])).unflatten(2, (t, m))
    cosine = torch.einsum("bqtmd,btdk->bqtmk", asked, template.flatten(3))
    inside = cell_mask(batch.mask, cells=CELLS).flatten(1).unflatten(0, (b, q + t))[:, q:]
    return cosine, inside


def correspondence_loss(
    cosine: Float[Tensor, "b q t m k"], inside: Bool[Tensor, "b t k"], batch: PairBatch, scale: Tensor
) -> Float[Tensor, ""]:
    """Cross entropy over a template's foreground cells, against a Gaussian round the true place (InfoNCE)."""
    logits = (cosine * scale).masked_fill(~inside[:, None, :, None], -1e4)
    k = torch.arange(CELLS * CELLS)
    xy = torch.stack([k % CELLS, k // CELLS], dim=-1).float()
    distance = (batch.template_xy[..., None, :] - xy).square().sum(-1)
    target = torch.exp(-distance / (2 * _BLUR_CELLS**2)) * inside[:, None, :, None]
    total = target.sum(-1)
    usable = batch.matched & (total > 0.1)
    loss = -(target * logits.log_softmax(-1)).sum(-1) / total.clamp(min=0.1)
    return (loss * usable).sum() / usable.sum().clamp(min=1)


def retrieval_scores(maps: Float[Tensor, "n c h w"], batch: PairBatch) -> Float[Tensor, "b q t"]:
    """As ``match=masked_cosine`` does: cosines cell by cell inside both masks, over the cells inside either."""
    query, template = sides(normalize(maps.float(), dim=1), batch)
    b, q, t = batch.angle_deg.shape
    inside = cell_mask(batch.mask, cells=maps.shape[-1]).unflatten(0, (b, q + t))
    of_query, of_template = inside[:, :q, None], inside[:, None, q:]
    cosine = torch.einsum("bqchw,btchw->bqthw", query, template)
    both, either = of_query & of_template, of_query | of_template
    return (cosine * both).sum((-2, -1)) / either.sum((-2, -1)).clamp(min=1)


def retrieval_loss(
    scores: Float[Tensor, "b q t"], angle_deg: Float[Tensor, "b q t"], scale: Tensor
) -> Float[Tensor, ""]:
    """Cross entropy over an object's templates, against weights that fall with the angle to the query's view."""
    target = torch.softmax(-0.5 * (angle_deg / _NEAR_DEG) ** 2, dim=-1)
    return -(target * (scores * scale).log_softmax(-1)).sum(-1).mean()
