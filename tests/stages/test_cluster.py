import pytest
import torch

from pipeline.errors import NoPose
from pipeline.functional.similarity import l2_normalize
from pipeline.items.features import FusedPair
from pipeline.stages.cluster.kmeans import KMeans
from pipeline.stages.cluster.one import One

H = 24


def _pair(shift: int = 0) -> FusedPair:
    """Smooth features in a disc; the template's are the query's, ``shift`` columns further right."""
    generator = torch.Generator().manual_seed(0)
    coarse = torch.randn(1, 12, 9, 9, generator=generator)
    query = torch.nn.functional.interpolate(coarse, size=(H, H), mode="bicubic")[0]
    centre = torch.arange(H) - (H - 1) / 2
    mask = centre[:, None] ** 2 + centre**2 < 64
    return FusedPair(query, query.roll(shift, 2), mask, mask.roll(shift, 1))


@pytest.mark.parametrize("cluster", [KMeans(count=30), One()], ids=repr)
def test_labels_cover_the_foreground_alone_and_pairs_name_existing_clusters(cluster):
    pair = _pair()
    found = cluster(pair)
    for label, mask, column in (
        (found.query_label, pair.query_mask, found.pairs[:, 0]),
        (found.template_label, pair.template_mask, found.pairs[:, 1]),
    ):
        assert torch.equal(label >= 0, mask)
        assert set(column.tolist()) <= set(label[mask].tolist())
        assert len(column.unique()) == len(column)
    again = cluster(_pair())
    assert torch.equal(found.query_label, again.query_label)
    assert torch.equal(found.pairs, again.pairs)


def test_identical_sides_pair_every_cluster_with_itself():
    found = KMeans(count=30)(_pair())
    assert torch.equal(found.pairs[:, 0], found.pairs[:, 1])
    assert len(found.pairs) == 30


def test_shifted_template_has_the_same_clusters_shifted():
    found = KMeans(count=30)(_pair(shift=2))
    assert torch.equal(found.template_label, found.query_label.roll(2, 1))


def test_length_of_a_cells_feature_does_not_matter():
    pair = _pair()
    lengths = 0.1 + torch.rand(1, H, H, generator=torch.Generator().manual_seed(1))
    flat = l2_normalize(pair.query.movedim(0, -1)).movedim(-1, 0)
    same = FusedPair(flat, flat, pair.query_mask, pair.template_mask)
    scaled = FusedPair(flat * lengths, flat * lengths, pair.query_mask, pair.template_mask)
    assert (KMeans(count=30)(same).query_label == KMeans(count=30)(scaled).query_label).float().mean() > 0.99  # ties


def test_clamped_clusters_and_a_skipped_epipolar_check_are_said():
    pair = _pair()
    few = torch.zeros(H, H, dtype=torch.bool)
    few[10, 8:12] = True
    found = KMeans(count=30)(FusedPair(pair.query, pair.template, few, few))
    assert found.note == (
        "query: 4 of 30 clusters; template: 4 of 30 clusters; "
        "epipolar check skipped: 4 pairs, a fundamental matrix needs 8"
    )
    assert KMeans(count=30)(pair).note.startswith("epipolar check skipped: near-planar")
    assert KMeans(count=30, epipolar=False)(pair).note == ""


def test_clusters_off_the_epipolar_lines_are_dropped():
    """Two views with parallax: rows stay, columns move by a depth that varies; then some rows are exchanged."""
    generator = torch.Generator().manual_seed(0)
    features = l2_normalize(torch.randn(32 * 32, 48, generator=generator))
    row, column = torch.arange(1024) // 32, torch.arange(1024) % 32
    points = torch.randperm(1024, generator=generator)[:60]
    depth = torch.randint(0, 12, (60,), generator=generator)
    query, template = torch.zeros(1024, 48), torch.zeros(32 * 64, 48)
    template_row = row[points].clone()
    template_row[:12] = (template_row[:12] + 14) % 32
    query[points] = features[points]
    template[template_row * 64 + column[points] + depth] = features[points]
    query_map = torch.zeros(48, 32, 64)
    query_map[:, :, :32] = query.T.reshape(48, 32, 32)
    template_map = template.T.reshape(48, 32, 64)
    pair = FusedPair(query_map, template_map, query_map.any(0), template_map.any(0))
    kept = KMeans(count=60, threshold_cells=0.5)(pair)
    assert "epipolar" not in kept.note
    everything = KMeans(count=60, epipolar=False)(pair)
    assert len(everything.pairs) >= 55
    query_row = torch.stack([(kept.query_label == k).nonzero()[0] for k in kept.pairs[:, 0]])[:, 0]
    matched_row = torch.stack([(kept.template_label == k).nonzero()[0] for k in kept.pairs[:, 1]])[:, 0]
    assert (query_row == matched_row).sum() >= 40  # of 48 pairs that keep their row
    assert (query_row != matched_row).sum() <= 3  # of 12 that do not


@pytest.mark.parametrize("cluster", [KMeans(), One()], ids=repr)
def test_mask_without_a_cell_says_why(cluster):
    pair = _pair()
    empty = torch.zeros_like(pair.query_mask)
    with pytest.raises(NoPose, match="cluster: template mask has no cell"):
        cluster(FusedPair(pair.query, pair.template, pair.query_mask, empty))
