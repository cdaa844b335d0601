from dataclasses import replace

import pytest
import torch

from pipeline.errors import NoPose
from pipeline.items.features import Clusters, FusedPair
from pipeline.stages.cluster.kmeans import KMeans
from pipeline.stages.cluster.one import One
from pipeline.stages.correspond.cosine import Cosine
from pipeline.stages.correspond.cyclic import Cyclic
from pipeline.stages.correspond.salient import Salient

H = 20


def _smooth(seed: int = 0, shift: float = 0.0) -> torch.Tensor:
    coarse = torch.randn(1, 16, 8, 8, generator=torch.Generator().manual_seed(seed))
    axis = (torch.arange(H) + 0.5) / H * 2 - 1
    y, x = torch.meshgrid(axis, axis + 2 * shift / H, indexing="ij")
    return torch.nn.functional.grid_sample(coarse, torch.stack([x, y], -1)[None], "bicubic", align_corners=False)[0]


def _disc() -> torch.Tensor:
    centre = torch.arange(H) - (H - 1) / 2
    return centre[:, None] ** 2 + centre**2 < 50


def _pair(shift: float = 0.0, noise: float = 0.0) -> FusedPair:
    template = _smooth() + noise * torch.randn(16, H, H, generator=torch.Generator().manual_seed(5))
    return FusedPair(_smooth(shift=shift), template, _disc(), _disc())


@pytest.mark.parametrize("kernel", [1, 3, 5])
@pytest.mark.parametrize("cluster", [One(), KMeans(count=20)], ids=repr)
def test_query_against_itself_matches_every_point_to_itself(cluster, kernel):
    pair = _pair()
    found = Cosine(per_cluster=100, kernel=kernel)(pair, cluster(pair), crop_size=80)
    assert torch.equal(found.query_px, found.template_px)
    assert len(found.query_px) == int(pair.query_mask.sum())
    assert torch.allclose(found.similarity, torch.ones(len(found.similarity)), atol=1e-6)  # float32


def test_points_are_cell_centres_in_crop_pixels():
    pair = _pair()
    found = Cosine(kernel=1)(pair, One()(pair), crop_size=80)
    first = _disc().nonzero()[0]
    expected = [(float(first[1]) + 0.5) * 4 - 0.5, (float(first[0]) + 0.5) * 4 - 0.5]
    assert expected in found.query_px.tolist()


@pytest.mark.parametrize("mutual", [True, False])
def test_matches_equal_a_loop_over_the_cells_of_paired_clusters(mutual):
    pair = _pair(shift=0.4, noise=0.3)
    clusters = KMeans(count=12)(pair)
    found = Cosine(per_cluster=4, mutual=mutual, kernel=1)(pair, clusters, crop_size=H)
    q, t = (m.flatten(1).T / m.flatten(1).norm(dim=0)[:, None] for m in (pair.query, pair.template))
    expected = []
    for p, (a, b) in enumerate(clusters.pairs.tolist()):
        rows = (clusters.query_label.flatten() == a).nonzero()[:, 0].tolist()
        columns = (clusters.template_label.flatten() == b).nonzero()[:, 0].tolist()
        best = {i: max(columns, key=lambda j, i=i: float(q[i] @ t[j])) for i in rows}
        back = {j: max(rows, key=lambda i, j=j: float(q[i] @ t[j])) for j in columns}
        candidates = [(float(q[i] @ t[j]), i, j) for i, j in best.items() if not mutual or back[j] == i]
        expected += [(p, i, j) for s, i, j in sorted(candidates, reverse=True)[:4] if s > 0]
    flat = [
        (px.double().round() @ torch.tensor([1.0, H], dtype=torch.float64)).long().tolist()
        for px in (found.query_px, found.template_px)
    ]
    assert list(zip(found.cluster.tolist(), *flat, strict=True)) == expected


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
@pytest.mark.parametrize("cluster", [One(), KMeans(count=8)], ids=["one", "kmeans"])
def test_cyclic_buddies_equal_a_loop_over_the_cells_of_paired_clusters(cluster, metric):
    pair = _pair(shift=0.4, noise=1.5)
    clusters = cluster(pair)
    found = Cyclic(count=90, metric=metric)(pair, clusters, crop_size=H)
    q, t = (m.flatten(1).T.double() for m in (pair.query, pair.template))

    def cosine(i, j):
        return float(q[i] @ t[j] / q[i].norm() / t[j].norm())

    def near(i, j):
        return cosine(i, j) if metric == "cosine" else -float((q[i] - t[j]).norm())

    cycles = []
    for p, (a, b) in enumerate(clusters.pairs.tolist()):
        rows = (clusters.query_label.flatten() == a).nonzero()[:, 0].tolist()
        columns = (clusters.template_label.flatten() == b).nonzero()[:, 0].tolist()
        there = {i: max(columns, key=lambda j, i=i: near(i, j)) for i in rows}
        back = {j: max(rows, key=lambda i, j=j: near(i, j)) for j in there.values()}
        for i, j in there.items():
            off = ((i % H - back[j] % H) ** 2 + (i // H - back[j] // H) ** 2) ** 0.5
            cycles.append((off, -cosine(i, j), p, i, j))
    best = sorted(cycles)[:90]
    assert {off for off, *_ in best} > {0.0}  # not the mutual ones alone
    expected = [(p, i, j) for _, _, p, i, j in sorted(best, key=lambda cycle: cycle[2])]
    flat = [
        (px.double().round() @ torch.tensor([1.0, H], dtype=torch.float64)).long().tolist()
        for px in (found.query_px, found.template_px)
    ]
    assert list(zip(found.cluster.tolist(), *flat, strict=True)) == expected
    similarity = [cosine(i, j) for _, i, j in expected]
    assert found.similarity.tolist() == pytest.approx(similarity, abs=1e-5)  # float32


def test_cyclic_buddies_of_a_query_with_itself_are_all_its_cells_and_of_few_the_most_similar():
    pair = _pair()
    found = Cyclic()(pair, One()(pair), crop_size=80)
    assert torch.equal(found.query_px, found.template_px)
    assert len(found.query_px) == int(pair.query_mask.sum())
    assert len(Cyclic(count=7)(pair, One()(pair), crop_size=80).query_px) == 7
    # lengths count for the Euclidean distance and not for the cosine
    longer = FusedPair(pair.query, 1.5 * pair.template, pair.query_mask, pair.template_mask)
    found = Cyclic(metric="cosine")(longer, One()(longer), crop_size=80)
    assert torch.equal(found.query_px, found.template_px)
    found = Cyclic()(longer, One()(longer), crop_size=80)
    assert not torch.equal(found.query_px, found.template_px)


def test_subpixel_places_points_nearer_to_the_truth_than_cell_centres():
    pair = _pair(shift=0.4)
    truth = torch.tensor([0.4, 0.0])
    error = {}
    for kernel in (1, 3):
        found = Cosine(kernel=kernel)(pair, One()(pair), crop_size=H)
        error[kernel] = float((found.template_px - found.query_px - truth).norm(dim=1).mean())
    assert error[3] < 0.95 * error[1]


def test_cells_never_match_outside_their_pair_and_query_cells_are_used_once():
    pair = _pair(shift=0.4, noise=0.3)
    clusters = KMeans(count=15)(pair)
    found = Cosine(mutual=False, kernel=1)(pair, clusters, crop_size=H)
    for side, label, column in (
        (found.query_px, clusters.query_label, 0),
        (found.template_px, clusters.template_label, 1),
    ):
        x, y = side.round().long().T
        assert torch.equal(label[y, x], clusters.pairs[found.cluster, column])
    assert len(found.query_px.unique(dim=0)) == len(found.query_px)
    assert torch.bincount(found.cluster).max() <= 10


def test_nothing_to_match_says_why():
    pair = _pair()
    none = torch.zeros(0, 2, dtype=torch.long)
    one = One()(pair)
    for correspond in (Cosine(), Cyclic()):
        with pytest.raises(NoPose, match="correspond: 0 cluster pairs, none with cells on both sides"):
            correspond(pair, Clusters(one.query_label, one.template_label, none), crop_size=80)
    opposite = FusedPair(torch.ones(4, H, H), -torch.ones(4, H, H), _disc(), _disc())
    with pytest.raises(NoPose, match="correspond: no cells of 1 cluster pairs have a positive cosine"):
        Cosine()(opposite, one, crop_size=80)


def _salient_pair(noise: float = 0.3) -> FusedPair:
    generator = torch.Generator().manual_seed(9)
    query, template = (torch.rand(H, H, generator=generator) for _ in range(2))
    return replace(_pair(shift=0.4, noise=noise), query_saliency=query, template_saliency=template)


def test_salient_keeps_the_most_salient_mutual_neighbours():
    pair = _salient_pair()
    found = Salient(count=1000, threshold=0.3)(pair, One()(pair), crop_size=H)
    q, t = (m.flatten(1).T / m.flatten(1).norm(dim=0)[:, None] for m in (pair.query, pair.template))
    sides = [(pair.query_mask & (pair.query_saliency > 0.3)), (pair.template_mask & (pair.template_saliency > 0.3))]
    rows, columns = (side.flatten().nonzero()[:, 0].tolist() for side in sides)
    best = {i: max(columns, key=lambda j, i=i: float(q[i] @ t[j])) for i in rows}
    back = {j: max(rows, key=lambda i, j=j: float(q[i] @ t[j])) for j in columns}
    buddies = [(i, j) for i, j in best.items() if back[j] == i]
    saliency = [pair.query_saliency.flatten()[i] + pair.template_saliency.flatten()[j] for i, j in buddies]
    expected = [buddies[k] for k in torch.stack(saliency).sort(descending=True, stable=True).indices]
    flat = [
        (px.double().round() @ torch.tensor([1.0, H], dtype=torch.float64)).long().tolist()
        for px in (found.query_px, found.template_px)
    ]
    assert list(zip(*flat, strict=True)) == expected


def test_salient_gives_one_pair_a_group_and_the_same_ones_again():
    pair = _salient_pair()
    every = Salient(count=1000)(pair, One()(pair), crop_size=H)
    few, again = (Salient(count=7)(pair, One()(pair), crop_size=H) for _ in range(2))
    assert len(few.query_px) == 7
    assert torch.equal(few.query_px, again.query_px)
    assert {tuple(px) for px in few.query_px.tolist()} < {tuple(px) for px in every.query_px.tolist()}
    assert few.query_px[0].tolist() == every.query_px[0].tolist()


def test_salient_says_that_nothing_is():
    pair = replace(_salient_pair(), query_saliency=torch.zeros(H, H))
    with pytest.raises(NoPose, match="more salient than 0"):
        Salient()(pair, One()(pair), crop_size=H)


def test_saliency_alone_is_the_foreground_where_asked():
    pair = _salient_pair()
    spec = Salient(count=1000, threshold=0.3, foreground="saliency")
    found = spec(pair, One()(pair), crop_size=H)
    no_mask = torch.zeros_like(pair.query_mask)
    no_mask[0, 0] = True
    masked = replace(pair, query_mask=no_mask, template_mask=no_mask)
    again = spec(masked, One()(masked), crop_size=H)
    assert torch.equal(found.query_px, again.query_px)
    assert torch.equal(found.template_px, again.template_px)
    similarity = torch.einsum(
        "ca,cb->ab", *(torch.nn.functional.normalize(m.flatten(1), dim=0) for m in (pair.query, pair.template))
    )
    forth, back = similarity.argmax(1).tolist(), similarity.argmax(0).tolist()
    salient = [(s.flatten() > 0.3).tolist() for s in (pair.query_saliency, pair.template_saliency)]
    expected = {(i, j) for i, j in enumerate(forth) if back[j] == i and salient[0][i] and salient[1][j]}
    flat = [
        (px.double().round() @ torch.tensor([1.0, H]).double()).long().tolist()
        for px in (found.query_px, found.template_px)
    ]
    assert set(zip(*flat, strict=True)) == expected
    assert found.cluster.unique().tolist() == [0]
    nothing = replace(pair, query_saliency=torch.zeros(H, H))
    with pytest.raises(NoPose, match=f"no salient mutual neighbours among {H * H} and {H * H} cells"):
        spec(nothing, One()(nothing), crop_size=H)


def test_a_mask_as_foreground_keeps_the_key():
    assert Salient().recipe() == Salient(foreground="mask").recipe()
    assert Salient().recipe() != Salient(foreground="saliency").recipe()
    assert "foreground" not in Salient().recipe()
