import torch
from sklearn.cluster import KMeans

from pipeline.functional.kmeans import kmeans, kmeans_plus_plus
from pipeline.functional.similarity import l2_normalize


def _points(m: int = 600, c: int = 16) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return l2_normalize(torch.randn(m, 4, generator=generator) @ torch.randn(4, c, generator=generator))


def test_same_seed_gives_identical_results_and_another_seed_another_start():
    points = _points()
    first, again = (kmeans(points.clone(), count=40, seed=3, iterations=20) for _ in range(2))
    assert torch.equal(first[0], again[0])
    assert torch.equal(first[1], again[1])
    assert (
        kmeans_plus_plus(points.numpy(), count=40, seed=3)[0] != kmeans_plus_plus(points.numpy(), count=40, seed=4)[0]
    )


def test_centres_are_means_and_every_point_has_the_nearest_centre():
    points = _points()
    label, centre = kmeans(points, count=40, seed=0, iterations=100)
    assert label.unique().tolist() == list(range(40))
    assert torch.equal(torch.cdist(points, centre).argmin(1), label)
    means = torch.stack([points[label == k].mean(0) for k in range(40)])
    assert torch.allclose(means, centre, atol=1e-6)  # float32 means


def test_separate_groups_become_clusters():
    groups = l2_normalize(torch.eye(5, 8)).repeat_interleave(30, 0) + 0.01 * _points(150, 8)
    label, _ = kmeans(groups, count=5, seed=0, iterations=20)
    assert all(len(label[i * 30 : i * 30 + 30].unique()) == 1 for i in range(5))
    assert len(label.unique()) == 5


def test_inertia_is_close_to_scikit_learns():
    points = _points()
    label, centre = kmeans(points, count=60, seed=0, iterations=50)
    ours = float((points - centre[label]).square().sum())
    assert (
        ours < 1.15 * KMeans(60, n_init=1, random_state=0).fit(points.numpy()).inertia_
    )  # its seeding tries 6 candidates


def test_fewer_distinct_points_than_clusters_give_one_cluster_each():
    points = torch.eye(3).repeat(4, 1)
    label, centre = kmeans(points, count=10, seed=0, iterations=20)
    assert len(centre) == 3
    assert torch.equal(centre[label], points)
    assert kmeans(points[:1], count=10, seed=0, iterations=20)[0].tolist() == [0]


def test_labels_do_not_depend_on_the_block_size(monkeypatch):
    whole = kmeans(_points(), count=40, seed=0, iterations=20)
    monkeypatch.setattr("pipeline.functional.kmeans._BLOCK", 64)
    blocks = kmeans(_points(), count=40, seed=0, iterations=20)
    assert torch.equal(whole[0], blocks[0])
    assert torch.allclose(whole[1], blocks[1])
