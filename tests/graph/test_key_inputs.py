"""Every input of every node's key is needed, and the runs below show it: without it, other bytes have one key.

Runs that differ in one input are computed. Of all entries that they store, the inputs and the bytes are known, so each
input can be left out afterwards: if then no two runs have an entry of one key with other bytes, a key that lacks this
input would go unnoticed, and another run is needed here.
"""

from __future__ import annotations

import re
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from graph.perturbation import TinyRun, entry_digest, variant
from graph.test_keys import FILES, bop, field_of, photo, stages_of, stages_with, weights, write_dataset, write_labels  # noqa: F401  a fixture
from tiny_bop import edit_json

import pipeline.graph.detections
import pipeline.graph.poses
import pipeline.graph.queries
import pipeline.graph.scores
from pipeline.io.digests import track_files
from pipeline.method import SecondLook, Stages
from pipeline.options import Evaluate
from pipeline.spec import canonical, digest
from pipeline.store import MemoryStoreConfig, Store
from pipeline.store.admin import list_entries

DIGESTING = (pipeline.graph.detections, pipeline.graph.poses, pipeline.graph.queries, pipeline.graph.scores)
NAMES_NOTHING = {"recipe kind", "recipe version"}


@dataclass(frozen=True)
class StoredEntry:
    """``parts``: what each digest among the inputs was made from, where that is known."""

    run: str
    folder: str
    recipe: Mapping[str, Any]
    inputs: Mapping[str, str]
    parts: Mapping[str, list[Any]]
    bytes: str

    @property
    def kind(self) -> str:
        return str(self.recipe["kind"])

    @property
    def text(self) -> str:
        """The hashed text, with the folder."""
        return self._text(self.recipe, self.inputs)

    def without(self) -> Iterator[tuple[str, str]]:
        """Name of each part of the key, and the hashed text without it."""
        for name in self.recipe:
            yield f"recipe {name}", self._text({k: v for k, v in self.recipe.items() if k != name}, self.inputs)
        for pattern in sorted({_pattern(name) for name in self.inputs}):
            named = [name for name in self.inputs if _pattern(name) == pattern]
            yield pattern, self._text(self.recipe, {k: v for k, v in self.inputs.items() if k not in named})
            count = max((len(self.parts.get(self.inputs[name], ())) for name in named), default=0)
            for n in range(count):
                less = {name: _without_item(self.parts.get(self.inputs[name]), n) for name in named}
                yield f"{pattern}[{n}]", self._text(self.recipe, dict(self.inputs) | less)

    def _text(self, recipe: Mapping[str, Any], inputs: Mapping[str, Any]) -> str:
        return canonical([self.folder, dict(recipe), dict(inputs)])


def _pattern(name: str) -> str:
    return re.sub(r"\d+", "N", name)


def _is_matrix(value: list[Any]) -> bool:
    return all(isinstance(item, list) and all(isinstance(x, float | int) for x in item) for item in value)


def _columns(value: list[Any]) -> list[Any]:
    """The columns of a list of detections, which have the same fields; other lists as they are."""
    is_table = all(isinstance(item, list) and len(item) == len(value[0]) and isinstance(item[0], int) for item in value)
    return [list(column) for column in zip(*value, strict=True)] if value and is_table else value


def _without_item(parts: list[Any] | None, n: int) -> Any:
    return None if parts is None else [part for k, part in enumerate(parts) if k != n]


class RecordedDigests(dict):
    """``digest`` for lists, which keeps what each was made from."""

    def __call__(self, value: Any) -> str:
        found = digest(value)
        if isinstance(value, list) and not _is_matrix(value):
            self[found] = _columns(value)
        return found


def compute(name: str, run: TinyRun, monkeypatch: pytest.MonkeyPatch) -> list[StoredEntry]:
    digests, store = RecordedDigests(), Store(MemoryStoreConfig())
    for module in DIGESTING:
        monkeypatch.setattr(module, "digest", digests)
    with track_files():
        run.compute(store)
    return [
        StoredEntry(name, info.folder, info.made_from["recipe"], info.made_from["inputs"], digests,
                    entry_digest(store, info))
        for info in list_entries(store)
    ]  # fmt: skip


def unnoticed(entries: list[StoredEntry]) -> set[str]:
    """Parts of keys without which no two runs have an entry of one key with other bytes."""
    mutated = [(entry, dict(entry.without())) for entry in entries]
    names: dict[str, set[str]] = defaultdict(set)
    for entry, texts in mutated:
        names[entry.kind] |= texts.keys() - NAMES_NOTHING
    found: dict[str, dict[str, dict[str, set[str]]]] = defaultdict(lambda: defaultdict(lambda: defaultdict(set)))
    for entry, texts in mutated:
        for name in names[entry.kind]:
            found[f"{entry.kind}: {name}"][texts.get(name, entry.text)][entry.run].add(entry.bytes)
    return {name for name, texts in found.items() if not any(map(_differ, texts.values()))}


def _differ(by_run: Mapping[str, set[str]]) -> bool:
    runs = list(by_run.values())
    return any(a != b for k, a in enumerate(runs) for b in runs[:k])


# Files that are changed in runs of each way to estimate; an input that all ways have, where it is cheap.
EDITS = {
    "masks": ("image", "visible mask", "vertex", "cam_K[0]", "fewer targets", "cam_t_m2c"),
    "poses": ("image", "vertex", "cam_K[0]", "cam_t_m2c", "depth", "depth_scale", "vertex of models_eval"),
    "words": ("vertex", "image"),
    "truth": ("cam_t_m2c", "symmetries_discrete", "vertex", "cam_K[0]"),
    "boxes": ("bbox_obj", "cam_t_m2c", "principal point"),
    "detections": ("score of a detection", "box of a detection", "image", "first target missing"),
    "cnos": ("image", "vertex", "cam_K[0]", "fewer targets"),
}  # fmt: skip

MORE_FILES = {
    "principal point": field_of("test/000007/scene_camera.json", "0", "cam_K", 2, value=lambda v: v + 2),
    "first target missing": lambda root: edit_json(root / "test_targets_bop19.json", lambda targets: targets.pop(0)),
}
EXPLAINED = {
    "features: recipe layer": "the folder is named by the layer",
    "features: geometry[2]": "a version, which is the same in all runs",
    "scores: depth[2]": "a version, which is the same in all runs",
    "fitted: base": "made of the same features; its recipe is part of the fit's",
    "poses: fit N": "made of the template layers; its recipe is part of the matcher's or the fuser's",
    "poses: templates": "in the keys of the template crops",
    "poses: template crops": "in the keys of the template layers",
    "poses: template layer N": "their crops are another part, their extractor is in the image's features",
    "poses: image N[1]": "crops, which are in the keys of the image's features",
    "query crops: detections[0]": "the object, which its crops do not depend on",
}
"""Parts of keys that may be left out, for another part of the key differs wherever they do."""


def ways_of(original: Path, weights: Path) -> dict[str, Stages]:  # noqa: F811
    """Stages that together have every node with every input."""
    cnos = stages_with("detect/cnos", original, weights)
    lenient = replace(cnos.detect.proposals, points_per_side=3, min_iou=0.0, min_stability=0.1)
    square = {"crop": variant("crop/square", size=64), "extract": variant("extract/coordinates")}
    return {
        "masks": stages_of("masks", original),
        "poses": stages_of("oracle, full masks", original),
        "words": stages_with("match/words", original, weights),
        "truth": stages_of("true correspondences", original),
        "boxes": replace(stages_of("boxes", original), **square),
        "detections": stages_of("detections", original),
        "cnos": replace(cnos, detect=replace(cnos.detect, proposals=lenient, min_score=0.0)),
    }


def changed_stages(way: str, stages: Stages) -> Iterator[dict[str, Any]]:
    """Fields of a way's stages that are changed, one at a time."""
    if way == "masks":
        yield {"render": replace(stages.render, count=4)}
        yield {"crop": replace(stages.crop, size=72)}
        yield {"extract": replace(stages.extract, orientations=stages.extract.orientations + 1)}
        yield {"match": replace(stages.match, top_k=1)}
        yield {"choose": variant("choose/agreement")}
        yield {"detect": replace(stages.detect, visible=False)}
    elif way == "poses":
        yield {"fuse": replace(stages.fuse, layers=(2, 8))}
        yield {"cluster": variant("cluster/kmeans", count=2)}
        yield {"correspond": variant("correspond/cyclic")}
        yield {"solve": replace(stages.solve, threshold_px=1.0)}
        yield {"choose": variant("choose/agreement")}
        yield {"refine": variant("refine/featuremetric")}
        yield {"solve": replace(stages.solve, min_inliers=10_000)}
        yield {"solve": replace(stages.solve, min_inliers=10_000), "fallback": True}
        cosine = {"match": variant("match/cosine", top_k=3)}
        yield cosine
        yield cosine | {"second_look": SecondLook(hypotheses=2)}
    elif way == "words":
        yield {"match": replace(stages.match, count=9)}
        yield {"match": replace(stages.match, dim=5)}
    elif way == "boxes":
        yield {"detect": variant("detect/gt_bbox", bbox="visib")}
        yield {"segment": variant("segment/grabcut")}
    elif way == "cnos":
        yield {"crop": replace(stages.crop, size=72)}
        yield {"detect": replace(stages.detect, describe_layer=2)}
        yield {"detect": replace(stages.detect, proposals=replace(stages.detect.proposals, points_per_side=2))}
        yield {"detect": replace(stages.detect, min_score=1.0)}
        yield {"render": replace(stages.render, count=4)}
    elif way == "detections":
        yield {"detect": replace(stages.detect, keep=1)}


def runs_of(tmp_path: Path, weights: Path) -> Iterator[tuple[str, TinyRun]]:  # noqa: F811
    """A run for each way to estimate, and runs that differ from it in one input."""
    original = write_dataset(tmp_path / "original")
    for way, stages in ways_of(original, weights).items():
        yield way, bop(original, stages)
        for edit in EDITS[way]:
            root = tmp_path / f"{way} {edit}"
            shutil.copytree(original, root)
            (FILES | MORE_FILES)[edit](root)
            yield f"{way}, {edit}", bop(root, stages_of(way, root) if way == "detections" else stages)
        for n, changed in enumerate(changed_stages(way, stages)):
            yield f"{way}, {n} {sorted(changed)}", bop(original, replace(stages, **changed))
    poses = ways_of(original, weights)["poses"]
    looks = replace(poses, match=variant("match/cosine", top_k=3), second_look=SecondLook(hypotheses=2))
    root = tmp_path / "looks diameter"
    shutil.copytree(original, root)
    FILES["diameter"](root)
    yield "looks", bop(original, looks)
    yield "looks, diameter", bop(root, looks)
    yield "poses, vsd_delta_mm", bop(original, poses, evaluate=Evaluate(vsd_delta_mm=0.01))
    yield "poses, correspondences", bop(original, poses, evaluate=Evaluate(correspondences=True))
    labels = {"mask": write_labels(original / "labels.png")}
    for n in (1, 2):
        yield f"photo, label {n}", photo(original, **labels, mask_label=n)
    for width in (9.0, 13.0):
        yield f"photo, box {width}", photo(original, mask=None, bbox=(15.0, 17.0, width, 12.0))


@pytest.mark.faults
@pytest.mark.timeout(1800)
def test_each_input_of_each_key_is_needed_and_none_is_missing(tmp_path, weights, monkeypatch, record_property):  # noqa: F811
    entries: list[StoredEntry] = []
    for name, run in runs_of(tmp_path, weights):
        entries += compute(name, run, monkeypatch)
    keys: dict[str, set[str]] = defaultdict(set)
    for entry in entries:
        keys[entry.text].add(entry.bytes)
    assert [key for key, contents in keys.items() if len(contents) > 1] == []
    assert unnoticed(entries) <= EXPLAINED.keys()
    parts = len({(entry.kind, name) for entry in entries for name, _ in entry.without()})
    runs = len({entry.run for entry in entries})
    text = f"{parts} parts of keys left out, one at a time, in {runs} runs with {len(entries)} entries"
    record_property("summary", f"{text}: noticed, or the same in another part ({len(EXPLAINED)})")
