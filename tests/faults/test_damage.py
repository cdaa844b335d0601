"""A flipped byte, a truncated or a deleted file in any entry never gives a wrong number, and is repaired."""

import random
import shutil
from pathlib import Path

import pytest
from helpers import KINDS, Ended, Inputs, Reference, read_entries, read_results, store_of

from pipeline.cli.cache import cache_command
from pipeline.errors import DzopError
from pipeline.store import DamagedEntry
from pipeline.store.admin import list_entries, verify

DOWNSTREAM = ("poses", "runs", "scores")


def flip(path: Path, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def truncate(path: Path, rng: random.Random) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: rng.randrange(len(data))])


def delete(path: Path, rng: random.Random) -> None:
    path.unlink()


def zero(path: Path, rng: random.Random) -> None:
    path.write_bytes(bytes(path.stat().st_size))


DAMAGES = {"flipped byte": flip, "truncated": truncate, "deleted": delete, "zeroed": zero}


def files_of(cache: Path, kind: str) -> list[Path]:
    """Files of entries: chunks, metadata of arrays, attributes of entries."""
    below_a_key = [p for p in sorted((cache / kind).rglob("*")) if p.is_file() and any(len(x) == 64 for x in p.parts)]
    assert below_a_key
    return below_a_key


def damage(cache: Path, kind: str, name: str, rng: random.Random) -> str:
    """Damage one file of an entry of this kind; metadata and chunks are equally likely, whatever their numbers."""
    sorts: dict[bool, list[Path]] = {}
    for path in files_of(cache, kind):
        sorts.setdefault(path.name == "zarr.json", []).append(path)
    path = rng.choice(sorts[rng.choice(sorted(sorts))])
    DAMAGES[name](path, rng)
    return f"{name}: {path.relative_to(cache)}"


def run_both(inputs: Inputs, folder: Path) -> Ended:
    """Run the two commands that together need every kind of entry."""
    detected = inputs.run(folder, "detect")
    return detected if detected.status else inputs.run(folder)


def repair(inputs: Inputs, reference: Reference, folder: Path, harm: str, *, runs: int = 3) -> int:
    """Repeat the commands, as their message advises, until everything is repaired. Returns the number of runs."""
    expected, results = read_entries(reference.after["evaluate"]), read_results(reference.after["evaluate"])
    count, ended = 1, run_both(inputs, folder)
    while ended.status != 0 and count < runs:
        assert "run again to recompute only what is damaged" in ended.err, (harm, ended.err)
        assert len(ended.err.splitlines()) == 1, ended.err
        count, ended = count + 1, run_both(inputs, folder)
    assert ended.status == 0, (harm, ended.err)
    assert read_results(folder) == results, harm
    verify(store_of(folder))  # marks damage in entries that this run did not read; the next run repairs it
    for kind in ("detections", *DOWNSTREAM):
        shutil.rmtree(folder / "cache" / kind)
    again = run_both(inputs, folder)
    assert again.status == 0, (harm, again.err)
    left = read_entries(folder)
    assert left.items() <= expected.items(), harm
    incomplete = {entry.path for entry in list_entries(store_of(folder)) if not entry.complete}
    assert {name for name in expected if not any(name.startswith(path) for path in incomplete)} == left.keys(), harm
    assert len(incomplete) <= 1, harm  # crops that no step reads, since their features are stored
    assert read_results(folder) == results, harm
    return count


@pytest.mark.timeout(3000)
@pytest.mark.faults
@pytest.mark.parametrize("kind", KINDS)
def test_damage_to_an_entry_is_detected_and_repaired(
    inputs: Inputs, reference: Reference, folder: Path, kind: str, record_property
):
    rng, runs = random.Random(kind), []
    for name in [*DAMAGES, *DAMAGES, *DAMAGES]:
        reference.copy(folder, reference.after["evaluate"])
        if kind not in DOWNSTREAM:
            for path in DOWNSTREAM:  # so that the damaged entry is read
                shutil.rmtree(folder / "cache" / path)
        runs.append(repair(inputs, reference, folder, damage(folder / "cache", kind, name, rng)))
        shutil.rmtree(folder)
    record_property(
        "summary", f"{kind}: {len(runs)} files damaged, {len(runs)} repaired, {runs.count(1)} by the first run"
    )


def test_damage_to_every_kind_of_entry_at_once_is_detected_and_repaired(
    inputs, reference, folder: Path, record_property
):
    rng = random.Random(5)
    reference.copy(folder, reference.after["evaluate"])
    harms = [damage(folder / "cache", kind, "flipped byte", rng) for kind in KINDS]
    runs = repair(inputs, reference, folder, "; ".join(harms), runs=len(KINDS) + 1)
    record_property("summary", f"{len(harms)} bytes flipped, one in an entry of every kind: repaired by run {runs}")


def test_the_cache_commands_survive_any_damage(reference: Reference, folder: Path, capsys):
    rng = random.Random(11)
    reference.copy(folder, reference.after["evaluate"])
    for kind in KINDS:
        for path in files_of(folder / "cache", kind):
            if path.name == "zarr.json":
                rng.choice([flip, flip, truncate, zero])(path, rng)
    root = ("--root", str(folder / "cache"))
    for command in ("ls", "du"):
        cache_command([command, *root])
    with pytest.raises(DzopError, match="are damaged or incomplete; the next run that needs them"):
        cache_command(["verify", *root])
    cache_command(["gc", *root])
    assert all(entry.complete for entry in list_entries(store_of(folder)))


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("kind", ["templates", "scores"])
@pytest.mark.parametrize("count", [6, pytest.param(150, marks=pytest.mark.faults)])
def test_a_flipped_byte_in_metadata_never_changes_what_is_read(
    reference: Reference, folder: Path, kind, count, record_property
):
    reference.copy(folder, reference.after["evaluate"])
    expected, rng, read = read_entries(folder), random.Random(count), 0
    for other in set(KINDS) - {kind}:
        shutil.rmtree(folder / "cache" / other)
    intact = folder.parent / "intact"
    shutil.copytree(folder / "cache", intact)
    for _ in range(count):
        flip(rng.choice([p for p in files_of(folder / "cache", kind) if p.name == "zarr.json"]), rng)
        try:
            left = read_entries(folder)
        except DamagedEntry:
            left = {}
        assert all(expected[name] == value for name, value in left.items())
        read += len(left) > 0
        shutil.rmtree(folder / "cache")
        shutil.copytree(intact, folder / "cache")
    record_property(
        "summary", f"{count} bytes flipped in metadata of {kind}: none changed a value, {count - read} hid all entries"
    )
