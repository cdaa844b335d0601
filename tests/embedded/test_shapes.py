"""Objects to train on: of every family, scaled alike, and the same for the same seed."""

import numpy as np
import pytest

from pipeline.embedded import shapes
from pipeline.embedded.shapes import make_training_object

SEEDS = range(24)


@pytest.fixture(scope="module")
def objects():
    return [make_training_object(seed) for seed in SEEDS]


def test_the_box_of_an_object_is_centred_and_its_farthest_vertex_at_distance_1(objects):
    for mesh in objects:
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        # scaled after it is centred, so both are exact up to rounding
        np.testing.assert_allclose(low + high, 0, atol=1e-12)
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)


def test_faces_use_vertices_of_their_own_object(objects):
    for mesh in objects:
        assert mesh.faces.min() >= 0
        assert mesh.faces.max() < len(mesh.vertices)
        assert mesh.colours.shape == mesh.vertices.shape


def test_the_same_seed_gives_the_same_object_and_another_seed_another(objects):
    again = make_training_object(SEEDS[3])
    assert np.array_equal(again.vertices, objects[3].vertices)
    assert np.array_equal(again.colours, objects[3].colours)
    assert len({mesh.vertices.tobytes() for mesh in objects}) == len(objects)


@pytest.mark.parametrize("family", sorted(set(shapes._FAMILIES), key=lambda family: family.__name__))
def test_parts_of_every_family_have_extent_and_no_other_than_finite_vertices(family):
    for seed in range(6):
        for points, faces in family(np.random.default_rng(seed)):
            assert np.isfinite(points).all()
            assert (np.ptp(points, axis=0) > 0).all()
            assert len(faces) >= 12
