import numpy as np
import pytest
import torch
from array_bank import array_bank, match_truth
from array_bank import match as match_maps
from jaxtyping import TypeCheckError

from pipeline.errors import BadInput, NoPose
from pipeline.functional.masks import cell_mask
from pipeline.functional.rigid import look_at, rigid, rotation_between
from pipeline.items.features import CLASS_FACET_LAYER, CropFeatures
from pipeline.items.online import Query
from pipeline.stages.match import rank
from pipeline.stages.match.cosine import Cosine
from pipeline.stages.match.masked_cosine import MaskedCosine
from pipeline.stages.match.oracle import Oracle
from pipeline.stages.match.words import Words

PER_CELL = [Cosine(top_k=3), *(MaskedCosine(top_k=3, normalise=n) for n in ("intersection", "query", "union"))]
WORDS = [Words(top_k=3, dim=8, count=40, weights=w) for w in ("equal", "gaussian")]


def _bank(n: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    mask = torch.zeros(n, 32, 32, dtype=torch.bool)
    for i in range(n):
        mask[i, 4 : 20 + i % 8, 6 : 28 - i % 5] = True
    return torch.randn(n, 10, 8, 8, generator=generator).half(), mask


def test_scores_of_another_shape_are_refused():
    with pytest.raises((BadInput, TypeCheckError), match=r"needs \(n,\)|score"):  # the tests' check is first
        rank(torch.ones(5, 1), top_k=2)


@pytest.mark.parametrize("match", [*PER_CELL, *WORDS], ids=repr)
def test_template_finds_itself(match):
    bank, mask = _bank()
    found = match_maps(match, bank[5].float(), mask[5], bank, mask)
    assert found.index.tolist()[0] == 5
    assert found.index.shape == found.score.shape == (3,)
    assert (found.score.diff() <= 0).all()
    assert float(found.score[0]) == pytest.approx(1, abs=1e-5)  # float32
    assert found.margin > 0


@pytest.mark.parametrize("match", PER_CELL, ids=repr)
def test_the_scale_of_the_querys_features_plays_no_part(match):
    bank, mask = _bank()
    first, second = (match_maps(match, factor * bank[5].float(), mask[5], bank, mask) for factor in (1, 4))
    assert torch.equal(first.index, second.index)
    assert torch.allclose(first.score, second.score, atol=1e-6)


@pytest.mark.parametrize("match", [MaskedCosine(), *WORDS], ids=repr)
def test_what_lies_outside_the_masks_changes_nothing(match):
    bank, mask = _bank()
    query, background = bank[5].float(), torch.ones(10, 8, 8)
    other = torch.where(cell_mask(mask[5], cells=8), query, background)
    first, second = (match_maps(match, q, mask[5], bank, mask) for q in (query, other))
    assert torch.equal(first.index, second.index)
    assert torch.equal(first.score, second.score)


@pytest.mark.parametrize("normalise", ["intersection", "query", "union"])
def test_masked_cosine_equals_a_loop_over_cells(normalise):
    bank, mask = _bank(4)
    mask = mask[:, ::4, ::4].repeat_interleave(4, 1).repeat_interleave(4, 2)  # whole cells
    query, cells = bank[0].double() + bank[1].double(), mask[:, ::4, ::4]
    found = match_maps(MaskedCosine(top_k=4, normalise=normalise), query, mask[0], bank, mask)
    for index, score in zip(found.index.tolist(), found.score.tolist(), strict=True):
        total = 0.0
        for i, j in (cells[0] & cells[index]).nonzero().tolist():
            a, b = query[:, i, j], bank[index, :, i, j].double()
            total += float(a @ b / a.norm() / b.norm())
        over = {
            "intersection": cells[0] & cells[index],
            "query": cells[0],
            "union": cells[0] | cells[index],
        }[normalise]
        assert score == pytest.approx(total / int(over.sum()), abs=1e-5)  # float32


def test_of_equal_templates_the_first_wins_and_the_margin_is_to_the_first_left_out():
    bank, mask = _bank(3)
    bank, mask = bank.repeat(3, 1, 1, 1), mask.repeat(3, 1, 1)
    found = match_maps(Cosine(top_k=3), bank[1].float(), mask[1], bank, mask)
    assert found.index.tolist() == [1, 4, 7]
    assert match_maps(Cosine(top_k=2), bank[1].float(), mask[1], bank, mask).margin == 0
    assert match_maps(Cosine(top_k=50), bank[1].float(), mask[1], bank, mask).index.shape == (9,)


def test_words_that_are_hidden_in_part_and_moved_about_still_find_their_template():
    bank, mask = _bank()
    everywhere = torch.ones_like(mask)
    shuffled = (
        bank[5].flatten(1)[:, torch.randperm(64, generator=torch.Generator().manual_seed(1))].unflatten(1, (8, 8))
    )
    hidden = everywhere[5].clone()
    hidden[:, 20:] = False
    for match in WORDS:
        assert match_maps(match, shuffled.float(), hidden, bank, everywhere).index.tolist()[0] == 5


def test_fewer_words_than_asked_for_are_those_there_are():
    bank, mask = _bank(2)
    assert match_maps(Words(dim=300, assignments=9), bank[1].float(), mask[1], bank, mask).index.tolist()[0] == 1


@pytest.mark.parametrize("match", PER_CELL, ids=repr)
def test_features_without_content_say_why(match):
    bank, mask = _bank()
    with pytest.raises(NoPose, match="match: query and templates share no feature"):
        match_maps(match, torch.zeros(10, 8, 8), mask[0], bank, mask)
    with pytest.raises(NoPose, match="match: features are not finite"):
        match_maps(match, torch.full((10, 8, 8), torch.nan), mask[0], bank, mask)


@pytest.mark.parametrize("match", [MaskedCosine(), *WORDS], ids=repr)
def test_empty_query_mask_says_why(match):
    bank, mask = _bank()
    with pytest.raises(NoPose, match="match: query mask is empty, needs 1 pixel"):
        match_maps(match, bank[0].float(), torch.zeros(32, 32, dtype=torch.bool), bank, mask)


def test_the_oracle_takes_the_nearest_view_off_the_axis_and_up_to_symmetries():
    T_cam_obj = look_at(np.array([[600.0, 0, 0], [0, 600.0, 0], [0, -600.0, 10], [0, 0, 600.0]]))
    # the object of view 1, moved to the side of the image and turned with the viewing ray, looks the same
    ray = rotation_between(np.array([0.0, 0, 1]), np.array([0.3, -0.2, 1.0]))
    moved = rigid(ray @ T_cam_obj[1, :3, :3], ray @ T_cam_obj[1, :3, 3])
    found = match_truth(Oracle(top_k=2), moved, np.eye(4)[None], T_cam_obj)
    assert found.index.tolist()[0] == 1
    assert float(found.score[0]) == pytest.approx(1, abs=1e-6)
    half_turn = rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    both = match_truth(Oracle(top_k=2), moved, np.stack([np.eye(4), half_turn]), T_cam_obj)
    assert set(both.index.tolist()) == {1, 2}


def test_the_oracle_cannot_work_without_the_truth():
    bank, mask = _bank()
    with pytest.raises(BadInput, match="match=oracle: found features, needs the true pose"):
        match_maps(Oracle(), bank[0].float(), mask[0], bank, mask)


def test_words_of_features_that_are_not_finite_or_tell_nothing_apart_say_why():
    bank, mask = _bank()
    with pytest.raises(NoPose, match="match: features are not finite"):
        match_maps(WORDS[0], torch.full((10, 8, 8), torch.nan), mask[0], bank, mask)
    with pytest.raises(NoPose, match="match: query and templates share no feature"):
        match_maps(WORDS[0], bank[0].float(), mask[0], bank[:1], mask[:1])  # every word is in the only template


@pytest.mark.parametrize("scale", [0.0, 1.0, 30.0])
def test_the_class_token_is_one_more_cell(scale):
    features, mask = _bank()
    tokens = scale * torch.randn(len(mask), 10, 1, 1, generator=torch.Generator().manual_seed(1))
    bank = array_bank(features, mask, maps=lambda layer: tokens if layer == CLASS_FACET_LAYER else features)
    maps = {2: features[3].float() + features[7].float(), CLASS_FACET_LAYER: tokens[4]}
    spec = Cosine(top_k=12, class_token=True)
    found = spec(Query(CropFeatures(maps, mask[3]), np.eye(3), np.eye(3)), bank)
    joined = torch.cat([features.float().flatten(1), tokens.flatten(1)], 1)
    query = torch.cat([maps[2].flatten(), maps[CLASS_FACET_LAYER].flatten()])
    expected = torch.nn.functional.cosine_similarity(joined, query[None])
    assert spec.layers == (2, CLASS_FACET_LAYER)
    assert torch.allclose(found.score, expected[found.index], atol=1e-6)
    assert found.score.tolist() == sorted(found.score.tolist(), reverse=True)
