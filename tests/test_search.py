"""detect=search in the graph: objects are found among masks or named as not found, doubtful detections replaced."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from command import run_dzop

from pipeline.bop.dataset import open_dataset
from pipeline.bop.detections import write_detections
from pipeline.bop.masks import decode_rle, encode_rle
from pipeline.confidence.calibration import choose_calibration
from pipeline.configuration import build_stages, compose_settings
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.graph import Context, Graph
from pipeline.items.views import Detection, Image, Proposal
from pipeline.spec import Runtime, spec
from pipeline.stages.detect import SearchPlan
from pipeline.stages.detect.json import Json
from pipeline.stages.detect.proposals import Proposer
from pipeline.stages.detect.search import Search
from pipeline.stages.extract.coordinates import Coordinates
from pipeline.store import LocalStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset


@spec
class SomeMasks(Proposer):
    """True masks of the objects ``shown``, and squares in the corners of the image."""

    kind: ClassVar[str] = "proposals.some_masks"
    root: str
    shown: tuple[int, ...] = (1, 2)

    def recipe(self) -> dict[str, Any]:
        return super().recipe() | {"root": ""}

    def load(self, runtime: Runtime):
        dataset = open_dataset(Path(self.root), name="toy")

        def propose(image: Image) -> list[Proposal]:
            masks = [np.zeros(image.rgb.shape[:2], bool) for _ in range(3)]
            masks[0][:40, :40] = masks[1][-40:, :40] = masks[2][-40:, -40:] = True
            for gt in dataset.ground_truth(image.scene_id, image.im_id):
                if gt.obj_id in self.shown:
                    masks.append(dataset.mask(image.scene_id, image.im_id, gt.gt_id))
            return [Proposal(box, encode_rle(mask), 1.0) for mask in masks if (box := mask_bbox(mask))]

        return propose


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("toy") / "scene"
    write_dataset(root, objects=2, images=1, seed=6, size_hw=(240, 320), per_image=2, occluded=0.0, progress=False)
    return root


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def graph_of(scene: Path, cache: Path, detect: Any, *settings: str, calibrated: bool = True, **stages: Any) -> Graph:
    values = compose_settings(["dataset=demo", "render.count=60", "render.size=128", *settings])
    chosen = replace(build_stages(values), detect=detect, **stages)
    data, store = open_dataset(scene, name="toy"), Store(LocalStoreConfig(root=str(cache)))
    calibration = choose_calibration(chosen, "auto") if calibrated else None
    runtime = Runtime(progress=False, device="cpu")
    graph = Graph(Context(chosen, data, data.targets, store, runtime, calibration=calibration))
    graph.check()
    return graph


def overlap(detection: Detection, graph: Graph) -> float:
    """IoU with the visible mask of the detection's object."""
    data, image = graph.context.dataset, (detection.scene_id, detection.im_id)
    (gt,) = [gt for gt in data.ground_truth(*image) if gt.obj_id == detection.obj_id]
    mask, true = detection.rle and decode_rle(detection.rle), data.mask(*image, gt.gt_id)
    return 0.0 if mask is None else float((mask & true).sum() / (mask | true).sum())


def detect(graph: Graph) -> dict[int, Detection]:
    return {d.obj_id: d for d in graph.detect()}


def test_each_object_is_found_among_the_masks_and_read_back(scene, cache):
    plan = SearchPlan(proposals=SomeMasks(root=str(scene)))
    graph = graph_of(scene, cache, Search(plan=plan))
    found = detect(graph)
    assert {obj_id: overlap(d, graph) > 0.9 for obj_id, d in found.items()} == {1: True, 2: True}
    assert all(d.score >= plan.min_confidence and d.defect is None for d in found.values())
    assert "searches" in graph.context.progress.table()
    again = graph_of(scene, cache, Search(plan=plan))
    assert detect(again) == found
    assert again.context.progress.counts["detections"].computed == 0


def test_an_object_that_no_mask_shows_is_not_found_and_the_reason_is_given(scene, cache):
    plan = SearchPlan(proposals=SomeMasks(root=str(scene), shown=()))
    graph = graph_of(scene, cache, Search(plan=plan))
    defects = {d.defect for d in graph.detect()}
    assert all(defect is not None and defect.startswith("not found: ") for defect in defects)
    answers = graph.poses.estimate()
    assert {(answer.obj_id, answer.stage) for answer in answers} == {(1, "detect"), (2, "detect")}


def test_missing_and_doubtful_detections_are_searched_for_and_good_ones_kept(scene, cache, tmp_path):
    graph = graph_of(scene, cache, Search(plan=SearchPlan(proposals=SomeMasks(root=str(scene)))))
    good = detect(graph)
    corner = np.zeros((240, 320), bool)
    corner[:50, :60] = True
    wrong = replace(good[2], bbox_xyxy=(-0.5, -0.5, 59.5, 49.5), rle=encode_rle(corner), score=1.0)

    def complete(given: Sequence[Detection], doubtful: float) -> dict[int, Detection]:
        plan = SearchPlan(proposals=SomeMasks(root=str(scene)), doubtful=doubtful)
        searches = graph_of(scene, cache, Search(plan=plan)).detections.searches
        return {d.obj_id: d for d in searches.complete(given)}

    missing = complete([wrong], 0.0)
    assert overlap(missing[1], graph) > 0.9
    assert missing[2] == wrong
    doubtful = complete([good[1], wrong], 0.5)
    assert doubtful[1] == good[1]
    assert overlap(doubtful[2], graph) > 0.9
    path = tmp_path / "detections.json"
    write_detections(path, [wrong])
    assert Json(path=str(path)).search_plan is None
    assert Json(path=str(path)).recipe().keys() == {"kind", "version", "path", "keep"}  # old keys stay


@pytest.mark.parametrize(
    ("calibrated", "stages", "message"),
    [
        (False, {}, "detect: found a search whose results nothing could verify, needs a method with"),
        (True, {"extract": Coordinates()}, "detect: found a search with extract=coordinates, needs detections made"),
    ],
)
def test_a_search_that_cannot_be_verified_is_refused(scene, cache, calibrated, stages, message):
    with pytest.raises(BadInput) as raised:
        graph_of(scene, cache, Search(), "method=dzop", "extract=hog", calibrated=calibrated, **stages)
    assert message in str(raised.value)


def test_a_mask_beside_a_search_is_refused(scene, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    ran = run_dzop(
        capsys, monkeypatch, "dataset=photo", "detect=search", f"dataset.mesh={scene}/models/obj_000001.ply",
        f"dataset.image={scene}/test/000001/rgb/000000.png", "dataset.K=[300,300,160,120]", "dataset.bbox=[9,9,40,40]",
    )  # fmt: skip
    assert ran.status == 1
    assert ran.err.strip() == "error: dataset.bbox: found with detect.search, needs detect=photo, or no mask and no box"
