"""detect=cnos in the graph, on a scene whose objects differ by colour."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from command import run_dzop
from make_sam import write_sam
from PIL import Image as Picture
from presets import QUICK

from pipeline.backbones.batching import Passes
from pipeline.backbones.extractor import Extractor
from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.bop.detections import write_detections
from pipeline.bop.masks import encode_rle
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.graph import Context, Graph
from pipeline.io.meshes import read_mesh, write_ply
from pipeline.items.features import CLASS_TOKEN_LAYER, FeatureMaps
from pipeline.items.poses import NoEstimate
from pipeline.items.views import Crops, Image, Proposal
from pipeline.spec import Runtime, spec
from pipeline.stages.detect.cnos import Cnos
from pipeline.stages.detect.gt_mask import GtMask
from pipeline.stages.detect.json import Json
from pipeline.stages.detect.proposals import Proposer
from pipeline.stages.extract.coordinates import Coordinates
from pipeline.stages.extract.hog import Hog
from pipeline.stages.match.cosine import Cosine
from pipeline.store import LocalStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset

COLOURS = {1: (220, 40, 40), 2: (40, 60, 220)}
CALLS: list[str] = []


@spec
class TrueMasks(Proposer):
    """Ground-truth masks, and squares in the corners of the image; no proposals in ``blind`` images."""

    kind: ClassVar[str] = "proposals.true_masks"
    root: str
    blind: tuple[int, ...] = ()

    def recipe(self) -> dict[str, Any]:
        return super().recipe() | {"root": ""}

    def load(self, runtime: Runtime):
        CALLS.append("load proposer")
        dataset = open_dataset(Path(self.root), name="toy")

        def propose(image: Image) -> list[Proposal]:
            CALLS.append(f"propose {image.im_id}")
            if image.im_id in self.blind:
                return []
            truths = dataset.ground_truth(image.scene_id, image.im_id)
            masks = [dataset.mask(image.scene_id, image.im_id, gt.gt_id) for gt in truths]
            for rows in (slice(0, 30), slice(-30, None)):
                masks.append(np.zeros(image.rgb.shape[:2], bool))
                masks[-1][rows, :30] = True
            return [Proposal(box, encode_rle(mask), 0.9) for mask in masks if (box := mask_bbox(mask))]

        return propose


@spec
class Hue(Extractor):
    """A class token that is the crop's mean colour minus its grey: a perfect descriptor in this scene."""

    kind: ClassVar[str] = "extract.hue"
    model: ClassVar[str] = "hue"
    passes: ClassVar[Passes] = Passes(torch.device("cpu"), batch=7, size=7)

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        if layer != CLASS_TOKEN_LAYER:
            raise BadInput("layer", found=layer, needed=str(CLASS_TOKEN_LAYER))
        return (3, 1, 1)

    def load(self, runtime: Runtime):
        return self

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        CALLS.append("describe")
        colour = [rgb[mask].mean(0) if mask.any() else np.zeros(3) for rgb, mask in zip(crops.rgb, crops.mask)]  # noqa: B905
        token = torch.from_numpy(np.stack(colour)).float()
        token = token - token.min(1, keepdim=True).values
        return dict.fromkeys(layers, token[:, :, None, None])


@pytest.fixture(scope="module")
def painted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic scene of objects with one colour each in front of a grey wall."""
    root = tmp_path_factory.mktemp("painted") / "scene"
    write_dataset(root, objects=2, images=2, seed=5, size_hw=(240, 320), per_image=2, occluded=0.0, progress=False)
    for obj_id, colour in COLOURS.items():
        path = root / "models" / f"obj_{obj_id:06d}.ply"
        mesh = read_mesh(path)
        write_ply(path, replace(mesh, colours=np.tile(np.uint8(colour), (len(mesh.vertices), 1))))
    dataset = open_dataset(root, name="toy")
    for image in dataset.images:
        grey = np.repeat(dataset.image(*image).rgb.mean(-1, keepdims=True), 3, axis=-1)
        for gt in dataset.ground_truth(*image):
            mask = dataset.mask(*image, gt.gt_id)
            grey[mask] = np.array(COLOURS[gt.obj_id]) * (grey[mask] / 255 * 0.5 + 0.4)
        Picture.fromarray(grey.astype(np.uint8)).save(dataset.image_path(*image))
    return root


@pytest.fixture(autouse=True)
def calls() -> list[str]:
    CALLS.clear()
    return CALLS


def graph_of(scene: Path, cache: Path, *, extract: Any = None, **changes: Any) -> Graph:
    fields: dict[str, Any] = {"describe": Hue(), "proposals": TrueMasks(root=str(scene))}
    detect = changes.pop("detect", None) or Cnos(**{**fields, **changes})
    stages = replace(QUICK, extract=extract or QUICK.extract, detect=detect)
    data, store = open_dataset(scene, name="toy"), Store(LocalStoreConfig(root=str(cache)))
    return Graph(Context(stages, data, data.targets, store, Runtime(progress=False, device="cpu")))


def computed(graph: Graph) -> dict[str, int]:
    return {step: count.computed for step, count in graph.context.progress.counts.items()}


def dataset_of(scene: Path) -> Dataset:
    return open_dataset(scene, name="toy")


def test_a_perfect_descriptor_finds_every_object_of_the_scene(painted: Path, cache: Path):
    graph = graph_of(painted, cache)
    graph.check()
    found, data = graph.detections.all, dataset_of(painted)
    truth = GtMask()(data, data.targets)
    assert [(d.im_id, d.obj_id, d.rle, d.bbox_xyxy) for d in found] == [
        (d.im_id, d.obj_id, d.rle, d.bbox_xyxy) for d in truth
    ]
    assert all(d.score > 0.95 and d.time_s > 0 and d.gt_id is None for d in found)


def test_a_second_run_proposes_and_describes_nothing(painted: Path, cache: Path):
    graph_of(painted, cache).estimate()
    CALLS.clear()
    again = graph_of(painted, cache)
    answers = again.estimate()
    assert len(answers) == len(again.context.targets)
    assert set(computed(again).values()) == {0}
    assert CALLS == []


def test_a_sweep_over_thresholds_proposes_and_describes_nothing(painted: Path, cache: Path):
    graph_of(painted, cache).detect()
    CALLS.clear()
    swept = graph_of(painted, cache, min_score=0.4, nms_iou=0.5, best=3, keep="all")
    assert swept.detect()
    assert {step for step, count in computed(swept).items() if count} == {"detections"}
    assert CALLS == []


def test_another_proposer_reuses_the_templates_descriptors(painted: Path, cache: Path):
    graph_of(painted, cache).detect()
    graph = graph_of(painted, cache, proposals=TrueMasks(root=str(painted), blind=(7,)))
    graph.detect()
    counts = computed(graph)
    assert (counts["template features"], counts["templates"]) == (0, 0)
    assert counts["proposals"] == counts["proposal features"] > 0


def test_templates_of_the_route_are_reused_for_descriptors(painted: Path, cache: Path):
    graph = graph_of(painted, cache, describe=Hog(), describe_layer=Cosine().layer)
    described = graph.detections.proposals
    assert described is not None
    assert described.context is graph.context  # one backbone in memory
    assert described.template_features(1) == graph.templates.features(1, Cosine().layer)
    graph.estimate()
    rows = 24 * len(graph.context.object_ids)
    assert (
        graph.context.progress.step("template features").computed <= 2 * rows
    )  # layer 2 for both, layer 8 for the route


def test_written_detections_are_read_back_equal(painted: Path, cache: Path, tmp_path: Path):
    graph = graph_of(painted, cache, keep="all")
    usable = [d for d in graph.detections.all if d.defect is None]
    write_detections(tmp_path / "detections.json", graph.detections.all)
    read = Json(path=str(tmp_path / "detections.json"), keep="all")(graph.context.dataset, graph.context.targets)
    assert read == usable
    entry = json.loads((tmp_path / "detections.json").read_text())[0]
    assert set(entry) == {"scene_id", "image_id", "category_id", "bbox", "score", "time", "segmentation"}
    assert isinstance(entry["segmentation"]["counts"], list)


def test_an_image_without_proposals_says_why(painted: Path, cache: Path):
    graph = graph_of(painted, cache, proposals=TrueMasks(root=str(painted), blind=(0,)))
    answers = [a for a in graph.estimate() if a.im_id == 0]
    assert len(answers) == len([t for t in graph.context.targets if t.im_id == 0]) > 0
    for answer in answers:
        assert isinstance(answer, NoEstimate)
        assert (answer.stage, answer.reason) == ("detect", "no mask was proposed in the image")


def test_a_plan_ends_at_missing_detections(painted: Path, tmp_path: Path):
    graph = graph_of(painted, tmp_path)
    nodes = list(graph.plan())
    assert CALLS == []
    assert {node.state for node in nodes} == {"missing"}
    assert (nodes[-1].step, "not listed" in nodes[-1].cost) == ("detections", True)
    assert {node.step for node in nodes} >= {"templates", "template features", "proposals", "proposal features"}
    graph_of(painted, tmp_path).estimate()
    warm = list(graph_of(painted, tmp_path).plan())
    assert {node.state for node in warm} == {"cached"}
    assert "poses" in {node.step for node in warm}


def test_keys_do_not_depend_on_measured_seconds(painted: Path, cache: Path, tmp_path: Path):
    keys = set()
    for place in (cache, tmp_path):
        graph = graph_of(painted, place)
        graph.detect()
        keys.add(graph.poses.run_ref().key)
    assert len(keys) == 1


def test_an_interrupted_run_resumes_with_the_remaining_images(painted: Path, tmp_path: Path):
    graph = graph_of(painted, tmp_path)
    described = graph.detections.proposals
    assert described is not None
    first, *others = graph.context.image_ids
    graph.run_item("proposals", first)
    CALLS.clear()
    graph_of(painted, tmp_path).detect()
    assert [call for call in CALLS if call.startswith("propose")] == [f"propose {im_id}" for _, im_id in others]


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"describe": Hog()}, r"detect\.describe_layer: found .*extract@detect\.describe"),
        ({"describe_layer": 3}, r"detect\.describe_layer"),
        ({"describe": Coordinates()}, r"detect\.describe: found extract\.coordinates, an oracle"),
    ],
)
def test_an_impossible_descriptor_is_refused_before_any_work(painted: Path, cache: Path, changes: dict, part: str):
    with pytest.raises(BadInput, match=part) as raised:
        graph_of(painted, cache, **changes).check()
    assert "\n" not in str(raised.value)
    assert CALLS == []


# --- the command line ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sam(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sam(tmp_path_factory.mktemp("sam") / "small")


@pytest.fixture
def photo(capsys, monkeypatch, tmp_path, painted, cache, sam):
    """The command line on a photograph with neither mask nor box; ``detect=cnos`` by default."""
    monkeypatch.chdir(tmp_path)
    found = (
        "detect=cnos", "extract@detect.describe=hog", "detect.describe_layer=8", f"detect.proposals.weights={sam}",
        "detect.proposals.points_per_side=3", "detect.proposals.min_iou=0", "detect.proposals.min_stability=0.1",
    )  # fmt: skip

    def run(*arguments: str):
        detect = () if any(a.startswith("detect=") for a in arguments) else found
        return run_dzop(
            capsys, monkeypatch, "dataset=photo", f"dataset.mesh={painted}/models/obj_000001.ply",
            f"dataset.image={painted}/test/000001/rgb/000000.png", "dataset.K=[300,300,160,120]", "extract=hog",
            "render.count=12", "render.size=128", "runtime.progress=false", "runtime.device=cpu", "overlays=false",
            f"store.root={cache}", *detect, *arguments,
        )  # fmt: skip

    return run


def test_a_photograph_and_a_mesh_are_enough(photo, tmp_path: Path):
    ran = photo("step=detect")
    assert (ran.status, ran.err) == (0, "")
    (path,) = tmp_path.glob("results/*/*/detections.json")
    (entry,) = json.loads(path.read_text())
    assert (entry["scene_id"], entry["image_id"], entry["category_id"]) == (0, 0, 1)
    assert entry["segmentation"]["size"] == [240, 320]
    estimated = photo("step=estimate")
    assert estimated.status == 0
    assert str(path.relative_to(tmp_path)) in estimated.out
    counts = estimated.counts()[0]
    assert counts["detections"] == (0, 1)
    assert "proposals" not in counts


def test_several_meshes_are_found_in_one_photograph(photo, painted, tmp_path: Path):
    both = f"dataset.mesh=[{painted}/models/obj_000001.ply,{painted}/models/obj_000002.ply]"
    ran = photo("step=estimate", both, "detect.proposals.points_per_side=4")
    assert ran.status == 0, ran.err
    answers = json.loads(next(tmp_path.glob("results/*/*/poses.json")).read_text())["answers"]
    assert {answer["obj_id"] for answer in answers} == {1, 2}


def test_the_detections_file_gives_the_same_pose(photo, tmp_path: Path):
    assert photo("step=estimate").status == 0
    (path,) = tmp_path.glob("results/*/*/detections.json")
    ran = photo("step=estimate", "detect=json", f"detect.path={path}", "out=again")
    assert ran.status == 0
    assert ran.counts()[0]["query features"] == (0, 1)
    records = [json.loads(next(tmp_path.glob(f"{out}/*/*/poses.json")).read_text()) for out in ("results", "again")]
    ours, theirs = ([{**a, "times_s": None} for a in record["answers"]] for record in records)
    assert ours == theirs


def test_a_photograph_without_detections_says_why(photo):
    ran = photo("step=detect", "detect.proposals.min_stability=1")
    assert ran.status == 0
    assert "0 detections" in ran.out
    assert "object 1 in scene 0, image 0: no mask was proposed in the image" in ran.out
    ran = photo("step=estimate", "detect.proposals.min_stability=1")
    assert ran.status == 1
    assert ran.err.startswith("error: found no pose, needs one (object 1: detect: no mask was proposed in the image")


def test_a_plan_of_a_photograph_runs_no_model(photo):
    ran = photo("plan=true", "detect.proposals.points_per_side=4")
    assert ran.status == 0
    assert "not listed" in ran.out
    assert "missing" in ran.out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("detect.min_score=1.5",), "detect.min_score: found 1.5"),
        (("detect.proposals.min_iou=2",), "detect.proposals.min_iou"),
        (("detect.proposals.weights=./nowhere",), "detect.proposals.weights: found './nowhere'"),
        (("detect.describe_layer=-2",), "detect.describe_layer"),
        (("dataset.mask=a.png", "dataset.bbox=[1,2,3,4]"), "mask and bbox, needs only one of them"),
        (
            ("dataset.mesh=[a.ply,b.ply]", "dataset.mask=a.png"),
            "found 2 meshes and the location of one object",
        ),
        (("dataset.mesh=[]",), "dataset.mesh: found 0 meshes"),
    ],
)
def test_bad_input_is_one_line(photo, arguments: tuple[str, ...], part: str):
    ran = photo(*arguments)
    assert ran.status == 1
    assert part in ran.err
    assert len(ran.err.strip().splitlines()) == 1


def test_a_photograph_without_mask_or_box_suggests_a_search(photo):
    ran = photo("detect=photo")
    assert ran.status == 1
    assert "neither of mask and bbox" in ran.err
    assert "detect=search" in ran.err


def test_a_mask_with_a_detector_that_finds_objects_is_refused(photo):
    ran = photo("dataset.bbox=[10,10,40,40]")
    assert ran.status == 1
    assert "dataset.bbox: found with detect.cnos, needs detect=photo, or no mask and no box" in ran.err
