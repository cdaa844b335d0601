import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from pipeline.errors import BadInput, NoPose
from pipeline.fits import fit_arrays, foreground_cells
from pipeline.functional.masks import cell_mask
from pipeline.items.features import CropFeatures
from pipeline.spec import build
from pipeline.stages.fuse.concat import Concat
from pipeline.stages.fuse.pca import Pca
from pipeline.stages.fuse.template_pca import TemplatePca

LAYERS = (2, 5, 8)


def fuse_pair(fuse, query, template, query_mask, template_mask, arrays=None):
    """Fuse two crops; a fit that no ``arrays`` are given for is fitted to the template."""
    if fuse.fit is not None and arrays is None:
        arrays = fit_arrays(fuse.fit, foreground_cells(template[fuse.layers[0]][None], template_mask[None]))
    return fuse(CropFeatures(query, query_mask), CropFeatures(template, template_mask), arrays)


def _maps(seed: int) -> dict[int, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {2: (40, 4), 5: (30, 8), 8: (12, 16)}
    return {
        layer: (5 + torch.randn(c, h, h, generator=generator) * 0.8 ** torch.arange(c)[:, None, None]).half()
        for layer, (c, h) in shapes.items()
    }


def _masks() -> tuple[torch.Tensor, torch.Tensor]:
    query, template = torch.zeros(2, 32, 32, dtype=torch.bool)
    query[2:30, 4:25] = True
    template[5:31, 3:28] = True
    return query, template


@pytest.mark.parametrize(
    "fuse", [Pca(layers=LAYERS, dim=9), Concat(layers=LAYERS), TemplatePca(layers=(8,), dim=4)], ids=repr
)
def test_fused_pair_has_the_finest_layers_resolution_and_masks(fuse):
    pair = fuse_pair(fuse, _maps(0), _maps(1), *_masks())
    assert pair.query.shape == pair.template.shape
    assert pair.query.shape[1:] == (16, 16)
    assert pair.query.dtype == torch.float32
    assert torch.equal(pair.query_mask, cell_mask(_masks()[0], cells=16))
    assert pair.note == ""
    again = fuse_pair(fuse, _maps(0), _maps(1), *_masks())
    assert torch.equal(pair.query, again.query)


def test_projection_equals_scikit_learn_on_the_foreground_of_both():
    query, template, masks = _maps(0), _maps(1), _masks()
    pair = fuse_pair(Pca(layers=(8,), dim=4, normalise=False), query, template, *masks)
    sides = [m[8].double().flatten(1).T.numpy() for m in (query, template)]
    inside = [cell_mask(mask, cells=16).flatten().numpy() for mask in masks]
    reference = PCA(n_components=4, svd_solver="full")
    reference.fit(np.concatenate([side[mask] for side, mask in zip(sides, inside, strict=True)]))
    expected = reference.transform(sides[0]).T
    found = pair.query.flatten(1).numpy()
    sign = np.sign((found * expected).sum(1))[:, None]  # the reference has another rule for signs
    assert np.allclose(found, sign * expected, atol=2e-4)  # float32 Gram matrix, values about 2


def test_axes_of_the_templates_project_both_sides():
    query, template, fuse = _maps(0), _maps(1), TemplatePca(layers=(8,), dim=4)
    bank = torch.stack([_maps(seed)[8] for seed in (1, 2, 3)])
    arrays = fit_arrays(fuse.fit, foreground_cells(bank, _masks()[1].expand(3, -1, -1)))
    pair = fuse_pair(fuse, query, template, *_masks(), arrays)
    for found, side in ((pair.query, query), (pair.template, template)):
        expected = torch.tensordot(arrays["axes"].T, side[8].float() - arrays["mean"][:, None, None], dims=1)
        assert torch.allclose(found, expected, atol=1e-4)  # float32 of values about 5
    # another query changes nothing in the template's map
    assert torch.equal(pair.template, fuse_pair(fuse, _maps(7), template, *_masks(), arrays).template)
    few = fuse_pair(TemplatePca(layers=(8,), dim=99), query, template, *_masks(), arrays)
    assert few.note == "layer 8: 4 of 99 dimensions, the templates span no more"


def test_normalised_layers_weigh_the_same_whatever_their_scale():
    query, template = _maps(0), _maps(1)
    loud = {layer: m.float() * (1000 if layer == 5 else 1) for layer, m in query.items()}
    loud_template = {layer: m.float() * (1000 if layer == 5 else 1) for layer, m in template.items()}
    for fuse in (Pca(layers=LAYERS, dim=9), Concat(layers=LAYERS)):
        first, second = fuse_pair(fuse, query, template, *_masks()), fuse_pair(fuse, loud, loud_template, *_masks())
        assert torch.allclose(first.query, second.query, atol=2e-4)  # float32 Gram matrices of other scale
    block = fuse_pair(Pca(layers=LAYERS, dim=9, cells="all"), query, template, *_masks()).query[6:]
    assert float(block.square().sum(0).mean().sqrt()) == pytest.approx(1, abs=0.1)  # query's share of the joint sample


def test_dimensions_are_split_over_the_layers_or_given_to_each():
    assert Pca(dim=66).dims() == (16, 16, 17, 17)
    assert Pca(dim=66, dim_mode="per_layer").dims() == (66,) * 4


def test_fewer_cells_than_dimensions_are_clamped_and_said():
    small = torch.zeros(32, 32, dtype=torch.bool)
    small[10:17, 10:17] = True
    pair = fuse_pair(Pca(layers=LAYERS, dim=30), _maps(0), _maps(1), small, small)
    assert (
        pair.note
        == "layer 2: 1 of 10 dimensions, 2 cells span no more; layer 5: 5 of 10 dimensions, 6 cells span no more"
    )
    assert len(pair.query) == 16


def test_nothing_to_fuse_says_why():
    maps, (mask, _), empty = _maps(0), _masks(), torch.zeros(32, 32, dtype=torch.bool)
    constant = {layer: torch.ones_like(m) for layer, m in maps.items()}
    broken = {layer: torch.full_like(m, torch.inf) for layer, m in maps.items()}
    arrays = fit_arrays(TemplatePca(layers=(2,)).fit, foreground_cells(maps[2][None], mask[None]))
    for fuse in (Pca(layers=LAYERS), Concat(layers=LAYERS), TemplatePca(layers=(2,))):
        with pytest.raises(NoPose, match="fuse: template mask is empty, needs 1 pixel"):
            fuse_pair(fuse, maps, maps, mask, empty, arrays)
        with pytest.raises(NoPose, match="fuse: features of layer 2 are not finite"):
            fuse_pair(fuse, broken, maps, mask, mask, arrays)
    with pytest.raises(NoPose, match="fuse: features are the same in all cells"):
        fuse_pair(Pca(layers=LAYERS), constant, constant, mask, mask)


def test_options_that_cannot_be_name_what_is_needed():
    with pytest.raises(
        BadInput, match=r"fuse.dim: found 3, needs at least 4, one for each layer, where dim_mode is total"
    ):
        build(Pca, {"dim": 3}, where="fuse")
    with pytest.raises(BadInput, match=r"fuse.layers: found \[\], needs at least 1 value"):
        build(Pca, {"layers": []}, where="fuse")
