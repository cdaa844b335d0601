"""The LRU cache: what it recomputes, and what it evicts."""

from pipeline.graph.lru import LRUCache


def test_the_least_recently_used_values_are_evicted():
    made: list[int] = []
    cache = LRUCache(lambda key: made.append(key) or key, lambda value: value, limit=10)
    for key in (3, 4, 3, 5, 3, 4):
        assert cache(key) == key
    assert made == [3, 4, 5, 4]


def test_the_newest_value_is_kept_even_if_it_exceeds_the_limit():
    made: list[int] = []
    cache = LRUCache(lambda key: made.append(key) or key, lambda value: value, limit=10)
    assert [cache(key) for key in (99, 99, 1)] == [99, 99, 1]
    assert made == [99, 1]
    assert list(cache.values) == [1]


def test_a_discarded_value_is_computed_again():
    made: list[int] = []
    cache = LRUCache(lambda key: made.append(key) or key, lambda value: value, limit=10)
    cache(3)
    cache.discard(3)
    cache.discard(4)
    cache(3)
    assert made == [3, 3]
