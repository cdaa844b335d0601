"""A full disk, a read-only store, and wrong clocks."""

import os
import shutil
import subprocess
import time
from datetime import UTC, datetime
from pathlib import Path

import pytest
from helpers import Inputs, Reference, read_entries, read_results, store_of

import pipeline.io.digests
import pipeline.store.completion
from pipeline.io.digests import DigestCache, file_digest, track_files
from pipeline.store.admin import collect_garbage, list_entries


class Disk:
    """A small tmpfs, whose size and mount options tests change."""

    def __init__(self, at: Path) -> None:
        self.at = at
        at.mkdir()
        made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256m", "tmpfs", str(at)], capture_output=True)
        if made.returncode:
            pytest.skip("needs the right to mount a tmpfs (root)")

    def remount(self, options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", str(self.at)], check=True)

    def used(self) -> int:
        stat = os.statvfs(self.at)
        return (stat.f_blocks - stat.f_bfree) * stat.f_frsize

    def unmount(self) -> None:
        subprocess.run(["umount", "-l", str(self.at)], check=True)


@pytest.fixture
def disk(tmp_path: Path):
    made = Disk(tmp_path / "disk")
    yield made
    made.unmount()


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("shares", [(0.4,), pytest.param([n / 25 for n in range(1, 25)], marks=pytest.mark.faults)])
def test_a_full_disk_is_reported_and_the_run_resumes_once_there_is_room(
    inputs: Inputs, reference: Reference, disk: Disk, shares, record_property
):
    expected, results = read_entries(reference.single), read_results(reference.single)
    folder = reference.copy(disk.at / "run", reference.single)
    needed = disk.used()
    for share in shares:
        shutil.rmtree(folder)
        folder.mkdir()
        for stream in ("out", "err"):
            (folder / f"run.{stream}").symlink_to(disk.at.parent / f"run.{stream}")
        disk.remount(f"size={int(share * needed)}")
        ended = inputs.run(folder)
        assert ended.status == 1
        assert len(ended.err.splitlines()) == 1, ended.err
        assert "the disk is full; make room" in ended.err, ended.err
        assert all(expected[name] == value for name, value in read_entries(folder).items())
        disk.remount("size=256m")
        again = inputs.run(folder)
        assert again.status == 0, again.err
        assert read_entries(folder) == expected
        assert read_results(folder) == results
    record_property(
        "summary",
        f"{len(shares)} disks full at {shares[0]:.0%} to {shares[-1]:.0%} of what a run takes: {len(shares)} recovered",
    )


def test_a_read_only_store_is_read_and_the_missing_entry_is_named(
    inputs: Inputs, reference: Reference, disk: Disk, folder: Path
):
    folder.mkdir()
    shutil.copytree(reference.single / "cache", disk.at / "cache")
    disk.remount("ro")
    ended = inputs.run(folder, "evaluate", f"store.root={disk.at / 'cache'}")
    assert ended.status == 0, ended.err
    assert read_results(folder) == read_results(reference.single)
    disk.remount("rw")
    shutil.rmtree(disk.at / "cache" / "features")
    (chunk,) = list((disk.at / "cache" / "crops").rglob("rgb/c.1.0.0.0"))[:1]
    disk.remount("ro")
    ended = inputs.run(folder, "evaluate", "cluster.count=7", f"store.root={disk.at / 'cache'}")
    assert ended.status == 1
    assert "the store is read-only here" in ended.err
    assert len(ended.err.splitlines()) == 1
    disk.remount("rw")
    chunk.write_bytes(b"x" * chunk.stat().st_size)
    disk.remount("ro")
    ended = inputs.run(folder, "evaluate", "cluster.count=7", f"store.root={disk.at / 'cache'}")
    assert ended.status == 1
    assert "read-only" in ended.err


def test_an_unwritable_results_folder_is_reported_before_anything_is_computed(inputs: Inputs, folder: Path, disk: Disk):
    folder.mkdir()
    disk.remount("ro")
    ended = inputs.run(folder, "evaluate", f"out={disk.at / 'results'}")
    assert ended.status == 1
    assert "needs a folder to write to" in ended.err
    assert not read_entries(folder)


@pytest.mark.parametrize("year", [1971, 2106])
def test_a_wrong_clock_changes_nothing(inputs: Inputs, reference: Reference, folder: Path, year: int):
    """Files from another year: complete entries are reused, damaged ones recomputed."""
    reference.copy(folder, reference.single)
    shutil.rmtree(folder / "cache" / "poses")
    shutil.rmtree(folder / "cache" / "runs")
    (chunk, *_) = list((folder / "cache" / "crops").rglob("rgb/c.1.0.0.0"))
    chunk.unlink()
    then = datetime(year, 1, 1, tzinfo=UTC).timestamp()
    for path in folder.rglob("*"):
        os.utime(path, (then, then))
    for _ in range(2):
        ended = inputs.run(folder)
        if ended.status == 0:
            break
        assert "run again" in ended.err
    assert ended.status == 0, ended.err
    assert read_results(folder) == read_results(reference.single)


def test_entries_completed_in_the_future_are_not_old(reference: Reference, folder: Path, monkeypatch):
    class Later(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2106, 1, 1, tzinfo=tz)

    reference.copy(folder, reference.after["onboard"])
    store = store_of(folder)
    old = list_entries(store)[0]
    monkeypatch.setattr(pipeline.store.completion, "datetime", Later)
    ref = pipeline.store.make_ref("later", {"kind": "later"}, {})
    store.put_document(ref, {}, rows=1)
    monkeypatch.undo()
    (later,) = [e for e in list_entries(store) if e.path == ref.path]
    assert later.age_h == 0
    assert old.path in {e.path for e in collect_garbage(store, older_than_h=0.0, dry_run=True)}
    assert ref.path not in {e.path for e in collect_garbage(store, older_than_h=1e-4, dry_run=True)}


def test_a_file_changed_without_a_new_mtime_has_another_digest(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(pipeline.io.digests, "_LARGE_BYTES", 1)
    monkeypatch.setattr(pipeline.io.digests, "_SETTLED_NS", 0)
    path = tmp_path / "weights.safetensors"
    path.write_bytes(b"one")
    with track_files(DigestCache(tmp_path / "memo")):
        first, stat = file_digest(path), path.stat()
        assert list((tmp_path / "memo").iterdir())
        time.sleep(0.02)  # the kernel sets the ctime from its clock; no call can put it back
        path.write_bytes(b"two")
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        assert path.stat().st_mtime_ns == stat.st_mtime_ns
    with track_files(DigestCache(tmp_path / "memo")):
        assert file_digest(path) != first
