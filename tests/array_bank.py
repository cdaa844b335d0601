"""A template bank and queries made from arrays, for tests of single stages."""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from pipeline.fits import fit_arrays, foreground_cells
from pipeline.graph.bank import StoredBank
from pipeline.items.features import CropFeatures
from pipeline.items.online import Query, TemplateView, Truth

MATCH_LAYER = 2


def array_bank(
    features: torch.Tensor,
    mask: torch.Tensor,
    T_cam_obj: np.ndarray | None = None,
    views: Sequence[TemplateView] = (),
    maps: Callable[[int], torch.Tensor] | None = None,
) -> StoredBank:
    """A bank of templates in memory: of the match layer alone, or with all ``maps`` or ``views``; it cannot render.

    Fits are computed when asked for.
    """

    def render(*_) -> TemplateView:
        raise AssertionError("this bank cannot render")

    return StoredBank(
        layer=MATCH_LAYER,
        maps=maps or (lambda layer: features),
        masks=lambda: mask,
        view=lambda index: views[index],
        render=render,
        poses=lambda: T_cam_obj,
        fitted=lambda fit: dict(fit_arrays(fit, foreground_cells(features, mask))),
    )


def query_of(layer: int, features: torch.Tensor, mask: torch.Tensor, truth: Truth | None = None) -> Query:
    """A query of one layer's features."""
    return Query(CropFeatures({layer: features}, mask), np.eye(3), np.eye(3), truth)


def match(spec, features: torch.Tensor, mask: torch.Tensor, bank: torch.Tensor, bank_mask: torch.Tensor):
    """What a match variant finds for one query in a bank of maps."""
    return spec(query_of(spec.layer, features, mask), array_bank(bank, bank_mask))


def match_truth(spec, T_true: np.ndarray, symmetries: np.ndarray, T_cam_obj: np.ndarray):
    """What match=oracle finds for a true pose."""
    nothing = torch.zeros(len(T_cam_obj), 1, 1, 1)
    query = query_of(spec.layer, nothing[0], nothing[0, 0] > 0, Truth(T_true, symmetries))
    return spec(query, array_bank(nothing, nothing[:, 0] > 0, T_cam_obj))
