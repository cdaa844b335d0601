import numpy as np
import torch

from pipeline.functional import similarity
from pipeline.functional.similarity import (
    best_per_group,
    cell_cosine,
    global_cosine,
    l2_normalize,
    mutual_nearest,
    nearest_rows,
    nearest_with_same_label,
)


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_cosines_ignore_the_scale_of_query_and_bank():
    query, bank = _random(6, 4, 4), _random(9, 6, 4, 4, seed=1)
    for function in (global_cosine, cell_cosine):
        assert torch.allclose(function(query, bank), function(3 * query, 0.2 * bank), atol=1e-6)  # float32 rounding


def test_global_cosine_equals_numpy_in_double():
    query, bank = _random(6, 4, 4), _random(9, 6, 4, 4, seed=1).half()
    q, b = query.double().flatten().numpy(), bank.double().flatten(1).numpy()
    expected = b @ q / np.linalg.norm(b, axis=1) / np.linalg.norm(q)
    assert np.allclose(global_cosine(query, bank).numpy(), expected, atol=1e-6)  # float32 sums of 96 products


def test_cell_cosine_equals_a_loop_over_cells():
    query, bank = _random(6, 3, 3), _random(4, 6, 3, 3, seed=1).half()
    bank[2, :, 1, 1] = 0
    found = cell_cosine(query, bank)
    for n in range(4):
        for i in range(3):
            for j in range(3):
                a, b = query[:, i, j].double(), bank[n, :, i, j].double()
                expected = 0.0 if not b.any() else float(a @ b / a.norm() / b.norm())
                assert abs(float(found[n, i, j]) - expected) < 1e-6  # float32


def test_result_does_not_depend_on_the_block_size(monkeypatch):
    query, bank = _random(6, 4, 4), _random(9, 6, 4, 4, seed=1)
    whole = cell_cosine(query, bank)
    monkeypatch.setattr(similarity, "_CPU_BLOCK", 200)
    assert torch.equal(cell_cosine(query, bank), whole)


def test_mutual_nearest_pairs_are_best_in_row_and_column():
    similarity_matrix = torch.tensor([[0.9, 0.1, 0.2], [0.8, 0.3, 0.1], [0.0, 0.2, 0.7]])
    assert mutual_nearest(similarity_matrix).tolist() == [[0, 0], [2, 2]]


def test_nearest_with_same_label_equals_a_loop(monkeypatch):
    a, b = l2_normalize(_random(40, 5)), l2_normalize(_random(30, 5, seed=1))
    generator = torch.Generator().manual_seed(2)
    a_label, b_label = torch.randint(0, 6, (40,), generator=generator), torch.randint(0, 5, (30,), generator=generator)
    for block in (1 << 22, 1 << 7, 8):
        monkeypatch.setattr(similarity, "_PAIRS_BLOCK", block)
        value, index = nearest_with_same_label(a, a_label, b, b_label)
        for i in range(40):
            members = [j for j in range(30) if b_label[j] == a_label[i]]
            if not members:
                assert value[i] == -torch.inf
                continue
            best = max(members, key=lambda j: float(a[i] @ b[j]))
            assert index[i] == best
            assert abs(float(value[i] - a[i] @ b[best])) < 1e-6  # float32, different order of summation


def test_label_much_larger_than_the_others_is_split():
    a, b = l2_normalize(_random(300, 5)), l2_normalize(_random(200, 5, seed=1))
    a_label, b_label = (torch.arange(n).sub(n - 30).clamp(min=0) for n in (300, 200))  # 0 except for the last 29
    similarity_matrix = (a @ b.T).masked_fill(a_label[:, None] != b_label, -torch.inf)
    value, index = nearest_with_same_label(a, a_label, b, b_label)
    assert torch.equal(index, similarity_matrix.argmax(1))
    assert torch.allclose(value, similarity_matrix.max(1).values, atol=1e-6)  # float32, different order of summation


def test_best_per_group_keeps_the_highest_and_breaks_ties_by_index():
    value = torch.tensor([0.5, 0.9, 0.9, 0.1, 0.7, 0.8])
    group = torch.tensor([1, 1, 1, 1, 0, 0])
    candidate = torch.tensor([True, True, True, True, True, False])
    assert best_per_group(value, group, candidate, count=2).tolist() == [4, 1, 2]


def test_empty_inputs_give_empty_results():
    value, index = nearest_with_same_label(
        torch.zeros(0, 3), torch.zeros(0, dtype=torch.long), torch.zeros(2, 3), torch.tensor([0, 1])
    )
    assert len(value) == len(index) == 0
    assert (
        len(best_per_group(torch.zeros(0), torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.bool), count=3))
        == 0
    )


def test_nearest_rows_and_whether_they_are_mutual_equal_a_search_in_both_directions():
    a, b = _random(40, 6), _random(30, 6, seed=1)
    found, nearest, mutual = nearest_rows(a, b)
    products = a @ b.T
    assert torch.equal(nearest, products.argmax(1))
    assert torch.equal(found, products.max(1).values)
    assert torch.equal(mutual, products.argmax(0)[nearest] == torch.arange(40))
    assert 0 < mutual.sum() < 30
