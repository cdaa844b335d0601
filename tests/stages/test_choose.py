"""Which of several poses answers: most inliers, or best agreement of what is seen with what the template shows."""

import numpy as np
import pytest
import torch

from pipeline.errors import BadInput
from pipeline.functional.agreement import measure_agreement
from pipeline.items.features import FusedPair, PairGeometry
from pipeline.items.online import Truth
from pipeline.spec import build
from pipeline.stages.choose.agreement import Agreement
from pipeline.stages.choose.inliers import Inliers
from pipeline.stages.choose.oracle import Oracle

CELLS, SIZE, FOCAL, FAR = 32, 64, 400.0, 400.0
K_CROP = np.array([[FOCAL, 0, 31.5], [0, FOCAL, 31.5], [0, 0, 1]])
MM_PER_CELL = SIZE / CELLS * FAR / FOCAL


def pair_of(query_mask: torch.Tensor) -> FusedPair:
    """Random descriptors and themselves: of a template whose foreground is a square, seen again in full or part."""
    maps = torch.randn(8, CELLS, CELLS, generator=torch.Generator().manual_seed(0))
    return FusedPair(maps, maps.clone(), query_mask, square())


def square(low: int = 8, high: int = 24) -> torch.Tensor:
    mask = torch.zeros(CELLS, CELLS, dtype=torch.bool)
    mask[low:high, low:high] = True
    return mask


def points() -> np.ndarray:
    """Object points of the template's foreground: a plane that the true pose puts where the template has it."""
    row, column = square().nonzero().double().numpy().T
    return np.stack([column - 15.5, row - 15.5, 0 * row], axis=1) * MM_PER_CELL


def pose(shift_cells: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = shift_cells * MM_PER_CELL, 0, FAR
    return T


def judged(spec, T: np.ndarray, inliers: int = 20, query_mask: torch.Tensor | None = None) -> float:
    pair = pair_of(square() if query_mask is None else query_mask)
    return spec(T, inliers, PairGeometry(pair, points(), K_CROP, SIZE))


def values(T: np.ndarray, query_mask: torch.Tensor) -> tuple[float, float]:
    pair, K_cell = pair_of(query_mask), np.diag([CELLS / SIZE, CELLS / SIZE, 1]) @ K_CROP
    K_cell[:2, 2] = (CELLS - 1) / 2
    return measure_agreement(pair.query, pair.template, pair.query_mask, pair.template_mask, points(), K_cell, T)


def test_the_true_pose_agrees_in_every_cell():
    cosine, coverage = values(pose(), square())
    assert cosine == pytest.approx(1, abs=1e-5)
    assert coverage == 1


def test_coverage_is_the_share_of_the_query_that_the_template_reaches():
    """Shifted by 4 of 16 columns, three quarters are reached; random descriptors then have nothing in common."""
    cosine, coverage = values(pose(4), square())
    assert coverage == pytest.approx(12 / 16)
    assert abs(cosine) < 0.1


def test_what_hides_a_part_of_the_query_costs_nothing():
    hidden = square()
    hidden[:, :14] = False
    assert values(pose(), hidden) == (pytest.approx(1, abs=1e-5), 1)


def test_gaps_between_landed_cells_count_as_reached():
    """Twice as near, a template's cells land two cells apart."""
    T = pose()
    T[2, 3] /= 2
    everything = torch.ones(CELLS, CELLS, dtype=torch.bool)
    assert values(T, everything)[1] == pytest.approx(1, abs=0.07)


@pytest.mark.parametrize("T", [pose(100), -pose()], ids=["beside the picture", "behind the camera"])
def test_a_pose_that_shows_nothing_is_worth_nothing(T):
    assert values(T, square()) == (0.0, 0.0)
    assert judged(Agreement(), T) == 0


def test_points_off_the_object_are_left_out():
    some = points()
    some[::3] = np.nan
    geometry = PairGeometry(pair_of(square()), some, K_CROP, SIZE)
    assert Agreement(inlier_power=0)(pose(), 9, geometry) == pytest.approx(1, abs=0.05)


def test_agreement_prefers_the_right_pose_to_more_inliers_and_inliers_do_not():
    right, wrong = (pose(), 20), (pose(5), 60)
    assert judged(Agreement(), *right) > judged(Agreement(), *wrong)
    assert judged(Inliers(), *right) < judged(Inliers(), *wrong)


def test_inliers_decide_between_poses_that_agree_alike():
    assert judged(Agreement(), pose(), 40) == pytest.approx(2**0.5 * judged(Agreement(), pose(), 20))
    assert judged(Agreement(inlier_power=0), pose(), 40) == judged(Agreement(inlier_power=0), pose(), 20)


def test_a_negative_power_is_refused():
    with pytest.raises(BadInput, match=r"choose.inlier_power: found -1.0, needs greater than or equal to 0"):
        build(Agreement, {"inlier_power": -1.0}, where="choose")


def test_a_power_of_the_cosine_weighs_similarity_against_inliers():
    noisy = pair_of(square())
    half = torch.randn(8, CELLS, CELLS, generator=torch.Generator().manual_seed(1))
    similar = PairGeometry(noisy, points(), K_CROP, SIZE)
    unlike = PairGeometry(
        FusedPair(noisy.query, noisy.template + half, noisy.query_mask, noisy.template_mask), points(), K_CROP, SIZE
    )
    for power, choice in ((1.0, "unlike"), (2.0, "similar")):
        spec = Agreement(cosine_power=power)
        scores = {"similar": spec(pose(), 20, similar), "unlike": spec(pose(), 50, unlike)}
        assert max(scores, key=scores.__getitem__) == choice, scores


def test_the_power_of_the_cosine_is_left_out_of_keys_at_its_earlier_value():
    assert Agreement().recipe() == Agreement(cosine_power=1.0).recipe()
    assert "cosine_power" not in Agreement().recipe()
    assert Agreement(cosine_power=2.0).recipe()["cosine_power"] == 2.0


def test_the_oracle_prefers_the_nearest_pose_up_to_symmetry():
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    truth = Truth(pose(), np.stack([np.eye(4), half_turn]))
    geometry = PairGeometry(pair_of(square()), points(), K_CROP, SIZE)
    scores = [Oracle()(T, 20, geometry, truth) for T in (pose() @ half_turn, pose(1.0), pose(2.0))]
    assert scores[0] == pytest.approx(1)
    assert scores[0] > scores[1] > scores[2] > 0
    with pytest.raises(BadInput, match="choose=oracle: found features, needs the true pose"):
        Oracle()(pose(), 20, geometry)
