"""A flipped byte, a cut or a lost file in any entry: never a wrong number, and what is broken is made again."""

import random
import shutil
from pathlib import Path

import pytest
from ground import KINDS, Ground, Undisturbed, store_of, stored, written

from pipeline.cache_cli import cache_command
from pipeline.errors import DzopError
from pipeline.store.admin import collect, entries, verify

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


def healed(ground: Ground, quiet: Undisturbed, folder: Path, told: str, *, runs: int = 3) -> int:
    """How often the command had to be given until everything is whole; it tells to give it again."""
    whole, results = stored(quiet.after["evaluate"]), written(quiet.after["evaluate"])
    for count in range(1, runs + 1):
        ended = ground.run(folder)
        if ended.status == 0:
            break
        assert "run again, and only what is broken is computed again" in ended.err, (told, ended.err)
        assert len(ended.err.splitlines()) == 1, ended.err
    assert ended.status == 0, (told, ended.err)
    assert written(folder) == results, told
    verify(store_of(folder))  # what this run had no need to read is found now
    again = ground.run(folder)
    assert again.status == 0, (told, again.err)
    assert stored(folder) == whole, told
    assert all(not verdict for _, verdict in verify(store_of(folder))), told
    return count


@pytest.mark.timeout(3000)
@pytest.mark.faults
@pytest.mark.parametrize("kind", KINDS)
def test_damage_to_an_entry_is_found_and_mended(ground: Ground, quiet: Undisturbed, folder: Path, kind: str, record_property):
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


def test_every_byte_of_an_entrys_records_may_flip(quiet: Undisturbed, folder: Path):
    """No byte of what describes an entry can change without the entry counting as incomplete or reading the same."""
    quiet.copy(folder, quiet.after["evaluate"])
    whole, store = stored(folder), store_of(folder)
    rng = random.Random(3)
    for kind in ("templates", "scores"):
        records = [p for p in files_of(folder / "cache", kind) if p.name == "zarr.json"]
        for _ in range(60):
            path = rng.choice(records)
            kept = path.read_bytes()
            flip(path, rng)
            try:
                left = {row.path for row in entries(store) if row.state == "complete"}
                for row in left:
                    assert row in whole
                assert all(whole[name] == value for name, value in _readable(folder, kind).items())
            finally:
                path.write_bytes(kept)
    assert collect(store, older_than_h=None, dry_run=True) == []


def _readable(folder: Path, kind: str) -> dict[str, bytes]:
    from ground import canonical, make_ref, without_seconds

    from pipeline.store import DamagedEntry

    store, found = store_of(folder), {}
    for row in entries(store):
        if row.state != "complete" or not row.path.startswith(kind):
            continue
        ref = make_ref(row.path.rsplit("/", 1)[0], row.made_from["recipe"], row.made_from["inputs"])
        record = store.attributes(row.path)["complete"]
        try:
            entry = store.read(ref)
            found |= {f"{row.path}/{name}": entry.array(name).tobytes() for name in entry.record["arrays"]}
            found[row.path] = canonical(without_seconds(entry.document)).encode()
        except DamagedEntry:
            store._group(row.path).attrs.update({"complete": record})  # it was marked; the next flip is another
    return found
