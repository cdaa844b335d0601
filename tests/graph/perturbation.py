"""Tiny runs whose inputs are changed one at a time: which keys they have, and the bytes of every entry they store."""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from presets import QUICK
from test_configuration import VARIANTS, loaded

from pipeline.bop.dataset import Dataset
from pipeline.confidence.calibration import SHIPPED, read_calibration
from pipeline.errors import BadInput
from pipeline.graph import Context, Graph, ScoreNodes
from pipeline.io.digests import track_files
from pipeline.method import Stages
from pipeline.options import Evaluate, Select
from pipeline.scoring import Scorer
from pipeline.spec import Runtime, Spec, build, digest
from pipeline.stages.crop.virtual import Virtual
from pipeline.stages.match.cosine import Cosine
from pipeline.stages.render.raycast import Raycast
from pipeline.store import MemoryStoreConfig, Store
from pipeline.store.admin import list_entries

SECONDS = {"time_s", "times_s"}  # measured, different in every run
BASE = replace(
    QUICK,
    render=Raycast(count=3, size=32),
    crop=Virtual(size=64),
    match=Cosine(top_k=2),
)


@dataclass(frozen=True)
class TinyRun:
    """A run on a dataset that ``open`` reads anew."""

    open: Callable[[], Dataset]
    stages: Stages = BASE
    select: Select = Select()  # noqa: RUF009
    evaluate: Evaluate = Evaluate()  # noqa: RUF009
    runtime: Runtime = Runtime(device="cpu", progress=False)  # noqa: RUF009

    def graph(self, store: Store | None = None) -> tuple[Graph, ScoreNodes | None]:
        """The run's nodes, by default with an empty store. Raises BadInput for settings that a run refuses."""
        data, evaluate = self.open(), self.evaluate
        evaluate.check_theta_max()
        store = store or Store(MemoryStoreConfig())
        searches = self.stages.detect.search_plan is not None  # only a confidence verifies what a search finds
        calibration = read_calibration(min(SHIPPED.glob("*.json"))) if searches else None
        targets = self.select.targets(data)
        graph = Graph(Context(self.stages, data, targets, store, self.runtime, calibration=calibration))
        graph.check()
        if not all(data.has_ground_truth(target.scene_id) for target in data.targets):
            return graph, None
        models, targets = evaluate.models_folder(data), graph.context.targets
        scorer = Scorer(data, targets, models, vsd_delta_mm=evaluate.vsd_delta_mm, with_vsd=evaluate.vsd)
        return graph, graph.scores(scorer, correspondences=evaluate.correspondences)

    def keys(self) -> set[str]:
        """Paths of all nodes that are known before anything is computed."""
        with track_files():
            graph, scores = self.graph()
            paths = {node.ref.path for node in graph.plan()} | {graph.detections.ref.path}
            if scores is not None and graph.detections.known:
                paths.add(scores.ref.path)
            return paths

    def contents(self) -> dict[str, str]:
        """Digest of each entry that the run stores, by its path."""
        store = Store(MemoryStoreConfig())
        with track_files():
            self.compute(store)
        return digest_entries(store)

    def compute(self, store: Store) -> None:
        """Estimate and score."""
        graph, scores = self.graph(store)
        answers = graph.estimate()
        if scores is not None:
            scores.evaluate(answers)


def digest_entries(store: Store) -> dict[str, str]:
    """Digest of each complete entry's arrays and document, by its path."""
    return {info.path: entry_digest(store, info) for info in list_entries(store) if info.complete}


def entry_digest(store: Store, info: Any) -> str:
    entry = store.read(info.ref)
    arrays = [[name, sha256(entry.array(name).tobytes()).hexdigest()] for name in entry.arrays]
    return digest([arrays, _without_seconds(entry.document)])


def _without_seconds(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _without_seconds(item) for name, item in value.items() if name not in SECONDS}
    return [_without_seconds(item) for item in value] if isinstance(value, list) else value


# --- values -----------------------------------------------------------------------------------------------------------


def other_values(value: Any, annotation: Any) -> Iterator[Any]:
    """Values of a field that differ from ``value``, the most useful first; some may be invalid."""
    options = list(_literals(annotation))
    if options:
        yield from (option for option in options if option != value)
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from (value + 1, value * 2, value - 1, value // 2, value + 8, value * 4, 2, 5, 8, 11)
    elif isinstance(value, float):
        yield from (value * 0.5, value * 0.9 + 0.01, value + 0.25, value * 2)
    elif isinstance(value, str):
        yield from ("a", value + "b")
    elif isinstance(value, tuple):
        doubled = tuple(2 * item for item in value if isinstance(item, int))
        yield from (value[:-1], value[1:], (*value[:-1], 8), (2, 5), (11,), doubled)
    elif value is None:
        yield from (1, 2, 4, 8.0, (0,), "a")


def _literals(annotation: Any) -> Iterator[Any]:
    origin = typing.get_origin(annotation)
    if origin is typing.Literal:
        yield from typing.get_args(annotation)
    elif origin in (typing.Union, types.UnionType, typing.Annotated):
        for part in typing.get_args(annotation):
            yield from _literals(part)


@cache
def annotations(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls, include_extras=True)


def changed_specs(spec: Any, skip: frozenset[str] = frozenset()) -> Iterator[tuple[str, list[Any]]]:
    """Each field of a spec and of the specs inside it, with the specs in which it alone has another value.

    A choice comes once for each of its options.
    """
    for field in fields(spec):
        if field.name in skip:
            continue
        value = getattr(spec, field.name)
        if isinstance(value, Spec):
            for name, variants in changed_specs(value, skip):
                yield f"{field.name}.{name}", [replace(spec, **{field.name: variant}) for variant in variants]
            continue
        variants = []
        for other in other_values(value, annotations(type(spec))[field.name]):
            try:
                variants.append(build(type(spec), _values(spec) | {field.name: other}, where=field.name))
            except (BadInput, TypeError):
                continue
        if list(_literals(annotations(type(spec))[field.name])):
            yield from ((field.name, [variant]) for variant in variants)
        else:
            yield field.name, variants


def _values(spec: Any) -> dict[str, Any]:
    return {field.name: getattr(spec, field.name) for field in fields(spec)}


# --- verdicts ---------------------------------------------------------------------------------------------------------


class Perturbations:
    """Compares runs with one changed input with the run before; counts what it found."""

    def __init__(self, run: TinyRun) -> None:
        self.run, self.keys = run, run.keys()
        self.by_key = self.by_bytes = 0
        self.wrong: list[str] = []
        self._contents: dict[str, str] | None = None

    def contents(self) -> dict[str, str]:
        """Entries of the run before, computed when first needed. Call it before files are changed."""
        self._contents = self._contents or self.run.contents()
        return self._contents

    def change(self, name: str, run: TinyRun, *, thorough: bool = False) -> None:
        """Check a changed run: another key, or the same bytes. ``thorough``: entries of equal keys have equal bytes."""
        keys = run.keys()
        if keys - self.keys and not thorough:
            self.by_key += 1
            return
        before, now = self.contents(), run.contents()
        differing = [path for path in before.keys() & now.keys() if before[path] != now[path]]
        self.wrong += [f"{name}: other bytes under one key, {path}" for path in differing]
        if keys - self.keys:
            self.by_key += 1
        else:
            self.by_bytes += 1
            self.wrong += [f"{name}: no other key, but entry {path}" for path in sorted(before.keys() ^ now.keys())]


def first_valid(runs: list[TinyRun]) -> TinyRun | None:
    """The first run whose settings are not refused."""
    for run in runs:
        try:
            run.keys()
            return run
        except BadInput:
            continue
    return None


def variant(name: str, **values: Any) -> Any:
    """A stage variant by its yaml, such as "match/words"."""
    cls, defaults = loaded(next(path for path in VARIANTS if f"{path.parent.name}/{path.stem}" == name))
    spec = build(cls, defaults | values, where=name)
    return (
        spec.resolve_for("hog")
        if hasattr(spec, "resolve_for")
        else spec.resolve()
        if hasattr(spec, "resolve")
        else spec
    )


def copy_file(path: Path, to: Path) -> Path:
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_bytes(path.read_bytes())
    return to
