"""A template bank and queries made from arrays, for tests of single stages."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from pipeline.fits import fit_arrays, foreground_cells
from pipeline.functional.masks import cell_mask
from pipeline.functional.similarity import cell_norms, map_norms
from pipeline.items.features import CropFeatures
from pipeline.items.online import Query, TemplateView, Truth


@dataclass(eq=False)
class ArrayBank:
    """Templates in memory: of the match layer alone, or with full ``views``. Fits are computed when asked for."""

    features: torch.Tensor
    mask: torch.Tensor
    T_cam_obj: np.ndarray | None = None
    views: tuple[TemplateView, ...] = ()

    @cached_property
    def norms(self) -> torch.Tensor:
        return map_norms(self.features)

    def maps(self, layer: int) -> torch.Tensor:
        return self.features

    @cached_property
    def cell_norms(self) -> torch.Tensor:
        return cell_norms(self.features)

    @cached_property
    def cell_mask(self) -> torch.Tensor:
        return cell_mask(self.mask, cells=self.features.shape[-1])

    def view(self, index: int) -> TemplateView:
        return self.views[index]

    def draw(self, T_cam_obj, A_crop_img, K) -> TemplateView:
        raise AssertionError("this bank cannot render")

    def fitted(self, fit) -> dict[str, torch.Tensor]:
        return dict(fit_arrays(fit, foreground_cells(self.features, self.mask)))


def query_of(layer: int, features: torch.Tensor, mask: torch.Tensor, truth: Truth | None = None) -> Query:
    """A query of one layer's features."""
    return Query(CropFeatures({layer: features}, mask), np.eye(3), np.eye(3), truth)


def match(spec, features: torch.Tensor, mask: torch.Tensor, bank: torch.Tensor, bank_mask: torch.Tensor):
    """What a match variant finds for one query in a bank of maps."""
    return spec(query_of(spec.layer, features, mask), ArrayBank(bank, bank_mask))


def match_truth(spec, T_true: np.ndarray, symmetries: np.ndarray, T_cam_obj: np.ndarray):
    """What match=oracle finds for a true pose."""
    nothing = torch.zeros(len(T_cam_obj), 1, 1, 1)
    query = query_of(spec.layer, nothing[0], nothing[0, 0] > 0, Truth(T_true, symmetries))
    return spec(query, ArrayBank(nothing, nothing[:, 0] > 0, T_cam_obj))
