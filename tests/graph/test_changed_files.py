"""A file that changes during a run never leaves a wrong entry: the run ends with its name, or did not need it."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from graph.perturbation import BASE, TinyRun, digest_entries, variant
from graph.test_keys import FILES, SCENE, bop, change_tensor, field_of, stages_of, write_dataset
from make_vit import write_vit

from pipeline.errors import BadInput
from pipeline.io import digests
from pipeline.io.digests import FileChanged, track_files
from pipeline.store import MemoryStoreConfig, Store

CHANGES: dict[str, tuple[str, str, Callable[[Path], None]]] = {  # which stages, which file, its change
    "image": ("masks", f"{SCENE}/rgb/000000.png", FILES["image"]),
    "mask": ("masks", f"{SCENE}/mask_visib/000000_000001.png", FILES["visible mask"]),
    "missing mask": ("masks", f"{SCENE}/mask_visib/000000_000001.png", FILES["missing mask"]),
    "depth": ("true correspondences", f"{SCENE}/depth/000000.png", FILES["depth"]),
    "annotations": ("true correspondences", f"{SCENE}/scene_gt.json", FILES["cam_t_m2c"]),
    "boxes": ("boxes", f"{SCENE}/scene_gt_info.json", FILES["bbox_obj"]),
    "cameras": ("masks", f"{SCENE}/scene_camera.json", FILES["cam_K[0]"]),
    "mesh": ("masks", "models/obj_000001.ply", FILES["vertex"]),
    "mesh for scores": ("true correspondences", "models_eval/obj_000001.ply", FILES["vertex of models_eval"]),
    "texture": ("masks", "models/skin.png", FILES["texture"]),
    "models_info": ("true correspondences", "models/models_info.json", FILES["symmetries_discrete"]),
    "detections": ("detections", "detections.json", FILES["box of a detection"]),
    "weights": ("weights", "vit/model.safetensors", lambda root: change_tensor(root / "vit" / "model.safetensors")),
    "config of weights": ("weights", "vit/config.json", field_of("vit/config.json", "layer_norm_eps", value=1e-3)),
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "original")


@pytest.fixture(scope="module")
def originals() -> dict[str, dict]:
    """The entries that runs of the unchanged dataset store, by their stages."""
    return {}


def run_of(reader: str, root: Path) -> TinyRun:
    if reader == "weights":
        if not (root / "vit").exists():
            write_vit(root / "vit")
        dino = variant("extract/dino", weights=str(root / "vit"), input_size=64, facet="token", norm_last=True)
        return bop(root, replace(BASE, extract=dino))
    return bop(root, stages_of(reader, root))


@contextmanager
def at_event(
    number: int, act: Callable[[], None], then: tuple[int, Callable[[], None]] | None = None
) -> Iterator[list]:
    """Call ``act`` at the n-th use of a file or write of an entry, and what follows at a later one."""
    events: list[str] = []
    actions = {number: act} | ({} if then is None else {then[0]: then[1]})

    def count(name: str) -> None:
        events.append(name)
        if len(events) in actions:
            actions[len(events)]()

    original = {name: getattr(Store, name) for name in ("fill", "put_document")}
    record = digests.TrackedFiles.record

    def counting(name: str) -> Any:
        def call(self: Store, *args: Any, **kwargs: Any) -> Any:
            count(name)
            return original[name](self, *args, **kwargs)

        return call

    def recording(self: Any, name: str, digest: str) -> None:
        record(self, name, digest)
        count(Path(name).name)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(digests.TrackedFiles, "record", recording)
        for name in original:
            patch.setattr(Store, name, counting(name))
        yield events


def attempt(run: TinyRun, store: Store) -> str:
    """Run to the end, or to the error that names a changed or missing file, which is returned."""
    try:
        with track_files():
            run.compute(store)
    except (FileChanged, BadInput) as error:
        return str(error)
    return ""


class Change:
    """A file of a run with two contents, and the entries that a run with each of them stores."""

    def __init__(self, kind: str, root: Path, originals: dict[str, dict]) -> None:
        self.reader, name, edit = CHANGES[kind]
        self.root, self.path, self.name = root, root / name, Path(name).name
        shared = kind if self.reader == "weights" else self.reader  # weights are random, datasets are all the same
        if shared not in originals:
            originals[shared] = self.run.contents()
        backup = root.parent / "backup"
        shutil.copytree(root, backup)
        edit(backup)
        self.before = self.path.read_bytes()
        self.after = (backup / name).read_bytes() if (backup / name).exists() else None
        self.write(self.after)
        self.entries = originals[shared] | self.run.contents()
        self.write(self.before)

    @property
    def run(self) -> TinyRun:
        """The run with new specs, as every command builds them: a spec keeps the digest of its weights."""
        return run_of(self.reader, self.root)

    def write(self, content: bytes | None) -> None:
        """Replace the file, as a copy over it would."""
        if content is None:
            self.path.unlink(missing_ok=True)
        else:
            self.path.write_bytes(content)

    def events(self) -> int:
        with at_event(0, lambda: None) as events:
            assert not attempt(self.run, Store(MemoryStoreConfig()))
        return len(events)

    def check(self, number: int, back: int | None = None) -> bool:
        """Whether the run noticed a change at this event; nothing wrong may be stored either way."""
        store = Store(MemoryStoreConfig())
        then = None if back is None else (back, lambda: self.write(self.before))
        with at_event(number, lambda: self.write(self.after), then):
            message = attempt(self.run, store)
        self.write(self.before)
        if message:
            gone = self.after is None and f"{self.name}: found No such file" in message
            assert gone or f"{self.name}: found a file that changed during the run" in message
            assert "\n" not in message
        stored = digest_entries(store)
        wrong = [path for path, content in stored.items() if self.entries.get(path) != content]
        assert not wrong, f"changed at event {number}, back at {back}: {wrong}, message {message!r}"
        return bool(message)


@pytest.mark.parametrize("kind", CHANGES)
def test_a_file_that_changes_during_a_run_leaves_no_wrong_entry(kind: str, root: Path, originals, record_property):
    change = Change(kind, root, originals)
    total = change.events()
    moments = sorted({1, total // 5, total // 3, total // 2, 3 * total // 4, total - 3, total - 1})
    noticed = sum(change.check(moment) for moment in moments)
    record_property(
        "summary", f"{kind} changed at {len(moments)} of {total} moments: {noticed} noticed, 0 wrong entries"
    )


@pytest.mark.faults
@pytest.mark.parametrize("kind", CHANGES)
def test_a_file_that_changes_at_any_moment_leaves_no_wrong_entry(kind: str, root: Path, originals, record_property):
    change = Change(kind, root, originals)
    total = change.events()
    noticed = sum(change.check(moment) for moment in range(1, total))
    put_back = sum(change.check(moment, moment + 1 + moment % 7) for moment in range(1, total, 2))
    assert noticed
    record_property(
        "summary", f"{kind} changed at each of {total} moments: {noticed + put_back} noticed, 0 wrong entries"
    )
