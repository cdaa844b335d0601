"""A flipped byte, a cut or a lost file in any entry: never a wrong number, and what is broken is made again."""

import random
import shutil
from pathlib import Path

import pytest
from helpers import KINDS, Ended, Ground, Undisturbed, store_of, stored, written

from pipeline.cli.cache import cache_command
from pipeline.errors import DzopError
from pipeline.store import DamagedEntry
from pipeline.store.admin import entries, verify

DOWNSTREAM = ("poses", "runs", "scores")


def flip(path: Path, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def cut(path: Path, rng: random.Random) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: rng.randrange(len(data))])


def lose(path: Path, rng: random.Random) -> None:
    path.unlink()


def blank(path: Path, rng: random.Random) -> None:
    path.write_bytes(bytes(path.stat().st_size))


HARMS = {"flipped byte": flip, "cut": cut, "lost": lose, "blank": blank}


def files_of(cache: Path, kind: str) -> list[Path]:
    """Chunks, arrays' metadata and entries' records."""
    below_a_key = [p for p in sorted((cache / kind).rglob("*")) if p.is_file() and any(len(x) == 64 for x in p.parts)]
    assert below_a_key
    return below_a_key


def harm(cache: Path, kind: str, name: str, rng: random.Random) -> str:
    """Damage one file of an entry of this kind: each sort of file is as likely, however many chunks there are."""
    sorts: dict[bool, list[Path]] = {}
    for path in files_of(cache, kind):
        sorts.setdefault(path.name == "zarr.json", []).append(path)
    path = rng.choice(sorts[rng.choice(sorted(sorts))])
    HARMS[name](path, rng)
    return f"{name}: {path.relative_to(cache)}"


def both(ground: Ground, folder: Path) -> Ended:
    """The two commands that together need every kind of entry."""
    detected = ground.run(folder, "detect")
    return detected if detected.status else ground.run(folder)


def healed(ground: Ground, quiet: Undisturbed, folder: Path, told: str, *, runs: int = 3) -> int:
    """How often the command had to be given until everything is whole; it tells to give it again."""
    whole, results = stored(quiet.after["evaluate"]), written(quiet.after["evaluate"])
    count, ended = 1, both(ground, folder)
    while ended.status != 0 and count < runs:
        assert "run again, and only what is broken is computed again" in ended.err, (told, ended.err)
        assert len(ended.err.splitlines()) == 1, ended.err
        count, ended = count + 1, both(ground, folder)
    assert ended.status == 0, (told, ended.err)
    assert written(folder) == results, told
    verify(store_of(folder))  # what this run had no need to read is found now, and made again where it is asked for
    for kind in ("detections", *DOWNSTREAM):
        shutil.rmtree(folder / "cache" / kind)
    again = both(ground, folder)
    assert again.status == 0, (told, again.err)
    left = stored(folder)
    assert left.items() <= whole.items(), told
    lacking = {row.path for row in entries(store_of(folder)) if row.state != "complete"}
    assert {name for name in whole if not any(name.startswith(path) for path in lacking)} == left.keys(), told
    assert len(lacking) <= 1, told  # crops that nobody needs, for their features are there
    assert written(folder) == results, told
    return count


@pytest.mark.timeout(3000)
@pytest.mark.faults
@pytest.mark.parametrize("kind", KINDS)
def test_damage_to_an_entry_is_found_and_mended(
    ground: Ground, quiet: Undisturbed, folder: Path, kind: str, record_property
):
    rng, runs = random.Random(kind), []
    for name in [*HARMS, *HARMS, *HARMS]:
        quiet.copy(folder, quiet.after["evaluate"])
        if kind not in DOWNSTREAM:
            for path in DOWNSTREAM:  # so that what is damaged is asked for
                shutil.rmtree(folder / "cache" / path)
        runs.append(healed(ground, quiet, folder, harm(folder / "cache", kind, name, rng)))
        shutil.rmtree(folder)
    record_property("told", f"{kind}: {len(runs)} files damaged, {len(runs)} healed, {runs.count(1)} by the first run")


def test_damage_to_an_entry_of_every_kind_at_once_is_found_and_mended(ground, quiet, folder: Path, record_property):
    rng = random.Random(5)
    quiet.copy(folder, quiet.after["evaluate"])
    told = [harm(folder / "cache", kind, "flipped byte", rng) for kind in KINDS]
    runs = healed(ground, quiet, folder, "; ".join(told), runs=len(KINDS) + 1)
    record_property("told", f"{len(told)} bytes flipped, one in an entry of every kind: healed by run {runs}")


def test_the_cache_commands_bear_any_damage(quiet: Undisturbed, folder: Path, capsys):
    rng = random.Random(11)
    quiet.copy(folder, quiet.after["evaluate"])
    for kind in KINDS:
        for path in files_of(folder / "cache", kind):
            if path.name == "zarr.json":
                rng.choice([flip, flip, cut, blank])(path, rng)
    root = ("--root", str(folder / "cache"))
    for command in ("ls", "du"):
        cache_command([command, *root])
    with pytest.raises(DzopError, match="are not whole; they are computed again when they are needed"):
        cache_command(["verify", *root])
    cache_command(["gc", *root])
    assert all(row.state == "complete" for row in entries(store_of(folder)))


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("kind", ["templates", "scores"])
@pytest.mark.parametrize("count", [6, pytest.param(150, marks=pytest.mark.faults)])
def test_a_flipped_byte_in_a_record_never_changes_what_is_read(
    quiet: Undisturbed, folder: Path, kind, count, record_property
):
    quiet.copy(folder, quiet.after["evaluate"])
    whole, rng, read = stored(folder), random.Random(count), 0
    for other in set(KINDS) - {kind}:
        shutil.rmtree(folder / "cache" / other)
    kept = folder.parent / "kept"
    shutil.copytree(folder / "cache", kept)
    for _ in range(count):
        flip(rng.choice([p for p in files_of(folder / "cache", kind) if p.name == "zarr.json"]), rng)
        try:
            left = stored(folder)
        except DamagedEntry:
            left = {}
        assert all(whole[name] == value for name, value in left.items())
        read += len(left) > 0
        shutil.rmtree(folder / "cache")
        shutil.copytree(kept, folder / "cache")
    record_property(
        "told", f"{count} bytes flipped in records of {kind}: none changed a value, {count - read} hid all entries"
    )
