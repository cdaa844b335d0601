"""``dzop cache``: the store from the command line."""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path

from pipeline.errors import DzopError
from pipeline.progress import format_bytes
from pipeline.store import LocalStoreConfig, S3StoreConfig, Store
from pipeline.store.admin import Row, collect, entries, find, verify


def cache_command(arguments: list[str]) -> None:
    """Parse and run one ``dzop cache`` command; output on stdout."""
    place = argparse.ArgumentParser(add_help=False)
    place.add_argument("--root", default="cache", help="the store: a folder or s3://bucket/prefix (default: cache)")
    parser = argparse.ArgumentParser(prog="dzop cache", description="Look after the feature store.")
    commands = parser.add_subparsers(dest="command", required=True)
    ls = commands.add_parser("ls", parents=[place], help="every entry: state, rows, size, age, what it is")
    ls.add_argument("--long", action="store_true", help="also what each entry was made from")
    commands.add_parser("du", parents=[place], help="bytes by folder")
    commands.add_parser("verify", parents=[place], help="read and check every byte; damaged entries become incomplete")
    gc = commands.add_parser("gc", parents=[place], help="remove incomplete entries, and old ones if asked")
    gc.add_argument("--older-than", type=_days, metavar="DAYS", help="also complete entries older than this")
    gc.add_argument("--dry-run", action="store_true", help="only say what would go")
    path = commands.add_parser("path", parents=[place], help="where an entry lies and what it was made from")
    path.add_argument("key", help="the first digits of its key")
    asked = parser.parse_args(arguments)
    store = _open(asked.root)
    if asked.command == "ls":
        _ls(entries(store), long=asked.long)
    elif asked.command == "du":
        _du(entries(store))
    elif asked.command == "verify":
        _verify(store)
    elif asked.command == "gc":
        _gc(store, asked.older_than, dry_run=asked.dry_run)
    else:
        row = find(store, asked.key)
        print(f"{store.place}/{row.path}")
        print(json.dumps(row.made_from, indent=2, sort_keys=True))


def _days(text: str) -> float:
    days = float(text)
    if not days >= 0:
        raise argparse.ArgumentTypeError(f"found {text}, needs a number of days >= 0")
    return days


def _open(root: str) -> Store:
    if root.startswith("s3://"):
        return Store(S3StoreConfig(url=root), announce=print)
    if not Path(root).is_dir():
        raise DzopError(f"{root}: found no such folder, needs a store (--root)")
    if not (Path(root) / ".locks").is_dir() and any(p.name != ".gitkeep" for p in Path(root).iterdir()):
        raise DzopError(f"{root}: found a folder that is no store, needs one that a run has written (--root)")
    return Store(LocalStoreConfig(root=root), announce=print)


def _ls(rows: list[Row], *, long: bool) -> None:
    print(f"{'state':<11}{'rows':>6}{'size':>10}{'age':>8}  path")
    for row in rows:
        age = "-" if row.age_h is None else f"{row.age_h:.0f} h" if row.age_h < 48 else f"{row.age_h / 24:.0f} d"
        print(f"{row.state:<11}{row.rows:>6}{format_bytes(row.stored_bytes):>10}{age:>8}  {row.path}")
        if long:
            print(f"{'':37}made from {json.dumps(row.made_from, sort_keys=True)}")


def _du(rows: list[Row]) -> None:
    sums: defaultdict[str, list[int]] = defaultdict(lambda: [0, 0])
    for row in rows:
        for folder in (row.path.rsplit("/", 1)[0], "total"):
            sums[folder][0] += 1
            sums[folder][1] += row.stored_bytes
    for folder, (count, size) in sorted(sums.items(), key=lambda item: (item[0] == "total", item[0])):
        print(f"{format_bytes(size):>10}{count:>7} entries  {folder}")


def _verify(store: Store) -> None:
    verdicts = verify(store)
    for path, verdict in verdicts:
        if verdict:
            print(f"{path}: {verdict}")
    bad = sum(bool(verdict) for _, verdict in verdicts)
    print(f"{len(verdicts) - bad} entries whole, {bad} not")
    if bad:
        raise DzopError(f"{bad} of {len(verdicts)} entries are not whole; they are computed again when they are needed")


def _gc(store: Store, older_than_days: float | None, *, dry_run: bool) -> None:
    hours = None if older_than_days is None else older_than_days * 24
    doomed = collect(store, older_than_h=hours, dry_run=dry_run)
    for row in doomed:
        print(f"{'would remove' if dry_run else 'removed'} {row.path} ({format_bytes(row.stored_bytes)}, {row.state})")
    print(f"{len(doomed)} entries, {format_bytes(sum(row.stored_bytes for row in doomed))}")
