import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.confidence.evidence import Extent, collect_evidence, measure_extent
from pipeline.functional.rigid import rigid
from pipeline.functional.viewpoints import icosphere_mesh
from pipeline.items.features import CropFeatures, FusedPair, PairGeometry
from pipeline.items.matches import Correspondences, TemplateMatch
from pipeline.items.objects import Mesh, ObjectModel
from pipeline.items.online import Hypothesis, Query, TemplateView, Trace
from pipeline.items.poses import PoseEstimate, PoseSolution
from pipeline.items.records import answer_from_record, answer_to_record

K = np.array([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]])
DISC = torch.ones(64, 64, dtype=torch.bool)
PAIR = FusedPair(torch.ones(2, 8, 8), torch.ones(2, 8, 8), DISC[::8, ::8], DISC[::8, ::8])
HALF_TURN = rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def pose(angle_deg: float = 0.0, shift_mm: float = 0.0) -> np.ndarray:
    return rigid(Rotation.from_euler("z", angle_deg, degrees=True).as_matrix(), np.array([shift_mm, 0.0, 500.0]))


def extent(*symmetries: np.ndarray) -> Extent:
    points = np.array([[50.0, 0, 0], [-50, 0, 0], [0, 20, 0], [0, 0, 20]])
    return Extent(points, np.stack([np.eye(4), *symmetries]), 100.0)


def hypothesis(T: np.ndarray, score: float | None, first: Hypothesis | None = None, mask=DISC) -> Hypothesis:
    inliers = np.array([True, True, True, False])
    px, similarity = torch.zeros(4, 2), torch.tensor([1.0, 0.5, 0.0, 0.1])
    view = TemplateView(CropFeatures({}, mask), np.eye(3), np.zeros((64, 64)), K, T)
    return Hypothesis(
        template_id=0,
        template_score=0.5,
        pair=PAIR,
        matches=Correspondences(px, px, similarity, torch.zeros(4, dtype=torch.long)),
        points_obj=np.zeros((4, 3)),
        query_px_img=np.zeros((4, 2)),
        solution=PoseSolution(T, inliers, 2.0),
        rerendered=view if first else None,
        first=first,
        score=score,
    )


def collect(*hypotheses: Hypothesis, known: Extent | None = None):
    query = Query(CropFeatures({}, DISC), np.eye(3), K)
    match = TemplateMatch(torch.zeros(1, dtype=torch.long), torch.ones(1), 0.25)
    geometry = PairGeometry(PAIR, np.zeros((64, 3)), K, 64)
    return collect_evidence(Trace(match, hypotheses, {}), query, geometry, known or extent())


def test_copies_of_a_symmetric_object_have_no_distance():
    assert extent().distance(pose(180), pose()) == pytest.approx(1.0)
    assert extent(HALF_TURN).distance(pose(180), pose()) == pytest.approx(0, abs=1e-12)
    assert extent().distance(pose(shift_mm=30), pose()) == pytest.approx(0.3)


def test_extent_measures_as_all_vertices_do():
    points, faces = icosphere_mesh(3)
    model = ObjectModel(1, Mesh(100 * points, faces), 200.0)
    measured = measure_extent(model)
    assert len(measured.points) == 48
    assert measured.distance(pose(20), pose()) == pytest.approx(np.sin(np.radians(10)), rel=0.02)


def test_agreement_rivals_and_alternatives_are_those_of_the_hypotheses():
    looks = (pose(), pose(5), pose(180), pose(178), pose(90))
    scores = (10.0, 9.0, 8.0, 6.0, 2.0)
    evidence, alternatives = collect(*map(hypothesis, looks, scores))
    assert evidence["agreeing"] == pytest.approx(1 / 4)
    assert evidence["rival"] == pytest.approx(0.8)
    assert [a.support for a in alternatives] == pytest.approx([0.8])  # the copy and the weak one are left out
    np.testing.assert_array_equal(alternatives[0].T_cam_obj, pose(180))
    evidence, alternatives = collect(*map(hypothesis, looks, scores), known=extent(HALF_TURN))
    assert evidence["agreeing"] == pytest.approx(3 / 4)
    assert not alternatives


def test_scores_of_first_looks_are_compared_with_the_first_look():
    first = hypothesis(pose(2), 3.0)
    evidence, _ = collect(hypothesis(pose(), 30.0, first), hypothesis(pose(180), 2.4))
    assert evidence["rival"] == pytest.approx(0.8)
    assert evidence["moved"] == pytest.approx(2 * 0.5 * np.sin(np.radians(1)), rel=1e-6)


def test_silhouettes_are_compared_with_the_mask():
    half = DISC.clone()
    half[:, 32:] = False
    evidence, _ = collect(hypothesis(pose(), 1.0, hypothesis(pose(), 1.0), mask=half))
    assert (evidence["overlap"], evidence["explained"], evidence["visible"]) == (0.5, 0.5, 1.0)


def test_without_a_second_look_or_others_the_evidence_says_less():
    evidence, alternatives = collect(hypothesis(pose(), None))
    assert not {"value", "agreeing", "rival", "overlap", "moved"} & evidence.keys()
    assert evidence["inlier_ratio"] == 0.75
    assert evidence["similarity"] == pytest.approx(0.5)
    assert not alternatives


def test_records_keep_evidence_and_alternatives():
    evidence, alternatives = collect(hypothesis(pose(), 2.0), hypothesis(pose(180), 1.0))
    answer = PoseEstimate(0, 0, 1, 0, pose(), 0.75, 1.0, 0, 0.5, 0.25, 4, 3, 2.0, evidence=evidence,
                          alternatives=alternatives, confidence=0.9, decision="accept")  # fmt: skip
    record = answer_to_record(answer)
    again = answer_from_record(record)
    assert answer_to_record(again) == record
    assert again.evidence == evidence
    assert again.alternatives[0].support == 0.5
    old = {k: v for k, v in record.items() if k not in ("evidence", "alternatives", "confidence", "decision")}
    assert answer_from_record(old).alternatives == ()
