"""A full disk, a store that cannot be written, and clocks that are wrong."""

import os
import shutil
import subprocess
import time
from datetime import UTC, datetime
from pathlib import Path

import pytest
from helpers import Ground, Undisturbed, store_of, stored, written

import pipeline.io.digests
import pipeline.store.completion
from pipeline.io.digests import DigestCache, file_digest, use_digest_cache
from pipeline.store.admin import collect, entries


class Disk:
    """A small file system in memory."""

    def __init__(self, at: Path) -> None:
        self.at = at
        at.mkdir()
        made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256m", "tmpfs", str(at)], capture_output=True)
        if made.returncode:
            pytest.skip("needs the right to mount a tmpfs (root)")

    def set(self, options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", str(self.at)], check=True)

    def used(self) -> int:
        stat = os.statvfs(self.at)
        return (stat.f_blocks - stat.f_bfree) * stat.f_frsize

    def gone(self) -> None:
        subprocess.run(["umount", "-l", str(self.at)], check=True)


@pytest.fixture
def disk(tmp_path: Path):
    made = Disk(tmp_path / "disk")
    yield made
    made.gone()


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("shares", [(0.4,), pytest.param([n / 25 for n in range(1, 25)], marks=pytest.mark.faults)])
def test_a_full_disk_is_told_and_with_more_room_the_run_goes_on(
    ground: Ground, quiet: Undisturbed, disk: Disk, shares, record_property
):
    whole, results = stored(quiet.alone), written(quiet.alone)
    folder = quiet.copy(disk.at / "run", quiet.alone)
    needed = disk.used()
    for share in shares:
        shutil.rmtree(folder)
        folder.mkdir()
        for stream in ("out", "err"):
            (folder / f"run.{stream}").symlink_to(disk.at.parent / f"run.{stream}")
        disk.set(f"size={int(share * needed)}")
        ended = ground.run(folder)
        assert ended.status == 1
        assert len(ended.err.splitlines()) == 1, ended.err
        assert "the disk is full; make room" in ended.err, ended.err
        assert all(whole[name] == value for name, value in stored(folder).items())
        disk.set("size=256m")
        again = ground.run(folder)
        assert again.status == 0, again.err
        assert stored(folder) == whole
        assert written(folder) == results
    record_property(
        "told",
        f"{len(shares)} disks full at {shares[0]:.0%} to {shares[-1]:.0%} of what a run takes: {len(shares)} healed",
    )


def test_a_read_only_store_serves_what_it_has_and_names_what_it_lacks(
    ground: Ground, quiet: Undisturbed, disk: Disk, folder: Path
):
    folder.mkdir()
    shutil.copytree(quiet.alone / "cache", disk.at / "cache")
    disk.set("ro")
    ended = ground.run(folder, "evaluate", f"store.root={disk.at / 'cache'}")
    assert ended.status == 0, ended.err
    assert written(folder) == written(quiet.alone)
    disk.set("rw")
    shutil.rmtree(disk.at / "cache" / "features")
    (chunk,) = list((disk.at / "cache" / "crops").rglob("rgb/c/1/0/0/0"))[:1]
    disk.set("ro")
    ended = ground.run(folder, "evaluate", "cluster.count=7", f"store.root={disk.at / 'cache'}")
    assert ended.status == 1
    assert "the store is read-only here" in ended.err
    assert len(ended.err.splitlines()) == 1
    disk.set("rw")
    chunk.write_bytes(b"x" * chunk.stat().st_size)
    disk.set("ro")
    ended = ground.run(folder, "evaluate", "cluster.count=7", f"store.root={disk.at / 'cache'}")
    assert ended.status == 1
    assert "read-only" in ended.err


def test_results_that_cannot_be_written_are_told_before_anything_is_computed(ground: Ground, folder: Path, disk: Disk):
    folder.mkdir()
    disk.set("ro")
    ended = ground.run(folder, "evaluate", f"out={disk.at / 'results'}")
    assert ended.status == 1
    assert "needs a folder to write to" in ended.err
    assert not stored(folder)


@pytest.mark.parametrize("year", [1971, 2106])
def test_a_clock_that_was_wrong_changes_nothing(ground: Ground, quiet: Undisturbed, folder: Path, year: int):
    """Files, locks and records of another year: what is whole counts, what is not is made again."""
    quiet.copy(folder, quiet.alone)
    shutil.rmtree(folder / "cache" / "poses")
    shutil.rmtree(folder / "cache" / "runs")
    (chunk, *_) = list((folder / "cache" / "crops").rglob("rgb/c/1/0/0/0"))
    chunk.unlink()
    then = datetime(year, 1, 1, tzinfo=UTC).timestamp()
    for path in folder.rglob("*"):
        os.utime(path, (then, then))
    for _ in range(2):
        ended = ground.run(folder)
        if ended.status == 0:
            break
        assert "run again" in ended.err
    assert ended.status == 0, ended.err
    assert written(folder) == written(quiet.alone)


def test_entries_completed_in_the_future_are_not_old(quiet: Undisturbed, folder: Path, monkeypatch):
    class Later(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2106, 1, 1, tzinfo=tz)

    quiet.copy(folder, quiet.after["onboard"])
    store = store_of(folder)
    row = entries(store)[0]
    monkeypatch.setattr(pipeline.store.completion, "datetime", Later)
    ref = pipeline.store.make_ref("later", {"kind": "later"}, {})
    store.put_document(ref, {}, rows=1)
    monkeypatch.undo()
    (later,) = [e for e in entries(store) if e.path == ref.path]
    assert later.age_h == 0
    assert row.path in {e.path for e in collect(store, older_than_h=0.0, dry_run=True)}
    assert ref.path not in {e.path for e in collect(store, older_than_h=0.0, dry_run=True)}


def test_a_file_that_was_changed_while_the_clock_stood_still_has_another_digest(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(pipeline.io.digests, "_LARGE_BYTES", 1)
    path = tmp_path / "weights.safetensors"
    path.write_bytes(b"one")
    with use_digest_cache(DigestCache(tmp_path / "memo")):
        first, stat = file_digest(path), path.stat()
        assert list((tmp_path / "memo").iterdir())
        time.sleep(0.02)  # the kernel sets the ctime from its clock; no call can put it back
        path.write_bytes(b"two")
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        assert path.stat().st_mtime_ns == stat.st_mtime_ns
        assert file_digest(path) != first
