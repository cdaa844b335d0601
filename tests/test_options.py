"""Which targets a configuration selects."""

import pytest
from tiny_bop import edit_json, write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.errors import BadInput
from pipeline.options import Select


@pytest.fixture
def dataset(tmp_path):
    return open_dataset(write_tiny_bop(tmp_path / "tiny"), name="tiny")


@pytest.mark.parametrize(("count", "images"), [(1, {0}), (2, {0, 3}), (20, {0, 3})])
def test_a_sample_has_so_many_images_with_all_their_targets(count, images, dataset):
    selected = Select(sample=count).targets(dataset)
    assert {target.im_id for target in selected} == images
    assert selected == tuple(target for target in dataset.targets if target.im_id in images)


def test_a_sample_is_evenly_spaced_over_scenes_and_taken_after_the_ids(tmp_path):
    root = write_tiny_bop(tmp_path / "tiny")
    scene = root / "test" / "000007"
    (root / "test" / "000009").symlink_to(scene)
    targets = [{"scene_id": s, "im_id": i, "obj_id": 2, "inst_count": 1} for s in (7, 9) for i in (0, 3)]
    edit_json(root / "test_targets_bop19.json", lambda records: records.__setitem__(slice(None), targets))
    data = open_dataset(root, name="tiny")
    chosen = {(t.scene_id, t.im_id) for t in Select(sample=2).targets(data)}
    assert chosen == {(7, 0), (9, 0)}
    assert {(t.scene_id, t.im_id) for t in Select(images=(3,), sample=1).targets(data)} == {(7, 3)}


def test_a_sample_of_no_image_is_refused():
    with pytest.raises((BadInput, ValueError)):
        Select(sample=0)
