import numpy as np
import pytest
import torch

from pipeline.items.features import Clusters
from pipeline.items.matches import Correspondences
from pipeline.items.views import Image
from pipeline.report.cluster_colours import paint_clusters
from pipeline.report.gallery import INLIER, MAX_LINES, OUTLIER, Card, draw_card, pick_cases, pick_evenly
from pipeline.report.overlay import DrawnPose
from pipeline.report.panels import GAP_PX, PANEL_PX, TITLE_PX
from pipeline.synthetic.objects import make_object

K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])


def grey(side: int = 128, value: int = 200) -> np.ndarray:
    return np.full((side, side, 3), value, np.uint8)


def quarters(pairs: list[tuple[int, int]], *, swapped: bool = False) -> Clusters:
    """Four clusters, the quarters of an 8 x 8 map; in the template left and right may be swapped."""
    label = torch.tensor([[0, 1], [2, 3]]).repeat_interleave(4, 0).repeat_interleave(4, 1)
    other = torch.tensor([[1, 0], [3, 2]]).repeat_interleave(4, 0).repeat_interleave(4, 1) if swapped else label
    return Clusters(label, other, torch.tensor(pairs).reshape(-1, 2))


def card(**known) -> Card:
    rng = np.random.default_rng(0)
    photo = Image(1, 0, rng.integers(0, 256, (240, 320, 3), dtype=np.uint8), K)
    return Card(photo, (100.0, 80.0, 180.0, 150.0), [], grey(), **known)


def matches(count: int) -> Correspondences:
    px = torch.rand((count, 2), generator=torch.Generator().manual_seed(0)) * 127
    return Correspondences(px, px.flip(0), torch.ones(count), torch.zeros(count, dtype=torch.int64))


def test_a_pair_of_clusters_has_one_colour_in_both_pictures():
    clusters = quarters([(0, 0), (1, 1), (2, 2), (3, 3)], swapped=True)
    query, template = paint_clusters(clusters, grey(), grey())
    low, high = PANEL_PX // 4, 3 * PANEL_PX // 4
    for row in (low, high):
        assert (query[row, low] == template[row, high]).all()
        assert (query[row, high] == template[row, low]).all()
    corners = {tuple(query[y, x]) for y in (low, high) for x in (low, high)}
    assert len(corners) == 4


def test_an_unmatched_cluster_is_grey():
    query, _ = paint_clusters(quarters([(0, 0)]), grey(), grey())
    r, g, b = query[3 * PANEL_PX // 4, 3 * PANEL_PX // 4].tolist()
    assert r == g == b


def test_a_complete_card_has_four_rows_and_a_failure_says_why():
    clusters = quarters([(0, 0), (1, 1)])
    known = {"template_rgb": grey(), "clusters": clusters}
    whole = draw_card(card(**known, matches=matches(200), inliers=np.arange(200) % 2 == 0))
    assert whole.shape[1] == 2 * PANEL_PX + GAP_PX
    assert whole.shape[0] > 4 * PANEL_PX
    early = draw_card(card(reason="match: features are not finite"))
    assert 2 * PANEL_PX < early.shape[0] < 3 * PANEL_PX
    assert early.shape[1] == whole.shape[1]
    longer = draw_card(card(reason="solve: " + "few inliers " * 30))
    assert longer.shape[0] > early.shape[0]


def test_the_same_case_gives_the_same_card():
    first, second = (draw_card(card(template_rgb=grey(), matches=matches(50), inliers=None)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_the_number_of_lines_is_limited():
    assert len(pick_evenly(5000, MAX_LINES)) == MAX_LINES
    assert pick_evenly(3, MAX_LINES) == [0, 1, 2]
    assert pick_evenly(0, MAX_LINES) == []


def has(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - colour).max(axis=-1) < 12).any())


@pytest.mark.parametrize(
    ("inliers", "shown"),
    [(np.ones(40, bool), (True, False)), (np.zeros(40, bool), (False, True)), (None, (False, False))],
)
def test_inliers_and_outliers_have_their_colours_unless_no_pose_was_solved(inliers, shown):
    lines = draw_card(card(template_rgb=grey(), matches=matches(40), inliers=inliers))[PANEL_PX + TITLE_PX :]
    lines = lines[: -PANEL_PX - TITLE_PX]
    assert (has(lines, INLIER), has(lines, OUTLIER)) == shown


def test_inliers_are_drawn_over_outliers():
    px = torch.tensor([[64.0, 64.0]]).repeat(2, 1)
    same = Correspondences(px, px, torch.ones(2), torch.zeros(2, dtype=torch.int64))
    for inliers in ([True, False], [False, True]):
        lines = draw_card(card(template_rgb=grey(), matches=same, inliers=np.array(inliers)))[:-PANEL_PX]
        assert has(lines, INLIER)
        assert not has(lines, OUTLIER)


def test_the_photograph_is_shown_without_black_beyond_its_border():
    white = Image(1, 0, np.full((240, 320, 3), 255, np.uint8), K)
    shown = draw_card(Card(white, (280.0, 190.0, 319.5, 239.5), [], grey()))
    assert (shown[-PANEL_PX:] == 255).all()


@pytest.mark.parametrize("bbox", [(-30.0, -20.0, 20.0, 40.0), (300.0, 200.0, 330.0, 250.0), (0.0, 0.0, 319.0, 239.0)])
def test_a_detection_at_the_border_has_a_card_of_full_size(bbox):
    photo = Image(1, 0, np.full((240, 320, 3), 255, np.uint8), K)
    mesh, T = make_object(0), np.eye(4)
    T[2, 3] = 900.0
    shown = draw_card(Card(photo, bbox, [DrawnPose(mesh, T, "correct")], grey()))
    assert shown.shape[1] == 2 * PANEL_PX + GAP_PX


def test_the_best_half_comes_first_and_then_the_worst():
    errors = [0.5, 0.1, None, 0.3, 0.9, 0.2]
    assert pick_cases(errors, count=4) == [1, 5, 2, 4]
    assert pick_cases(errors, count=3) == [1, 5, 2]
    assert pick_cases(errors, count=99) == [1, 5, 3, 0, 4, 2]
    assert pick_cases([], count=4) == []
    assert pick_cases(errors, count=1) == [1]


def test_objects_take_turns_and_each_half_keeps_its_order():
    errors, obj_ids = [0.1, 0.2, 0.3, 0.6, 0.9, 0.8], [1, 1, 1, 2, 2, 2]
    assert pick_cases(errors, count=4) == [0, 1, 4, 5]
    assert pick_cases(errors, count=4, obj_ids=obj_ids) == [0, 3, 4, 2]
    assert sorted(pick_cases(errors, count=6, obj_ids=obj_ids)) == list(range(6))


def test_without_any_error_the_first_answers_are_shown():
    assert pick_cases([None] * 9, count=3) == [0, 1, 2]
