"""``dzop cache``: inspect, verify and clean up the feature store."""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path

from pipeline.errors import DzopError
from pipeline.machine import machine_text
from pipeline.progress import format_bytes
from pipeline.store import LocalStoreConfig, S3StoreConfig, Store
from pipeline.store.admin import EntryInfo, check_is_store, collect_garbage, find_entry, list_entries, verify


def cache_command(arguments: list[str]) -> None:
    """Parse and run one ``dzop cache`` command; prints to stdout. Raises DzopError for a folder that is no store."""
    options = _parser().parse_args(arguments)
    store = _open(options.root)
    if options.command == "ls":
        _print_entries(list_entries(store), long=options.long)
    elif options.command == "du":
        _print_sizes(list_entries(store))
    elif options.command == "verify":
        _verify(store)
    elif options.command == "gc":
        _collect_garbage(store, options.older_than, dry_run=options.dry_run)
    else:
        entry = find_entry(store, options.key)
        print(f"{store.place}/{entry.path}")
        print(f"made by {machine_text(entry.made_by) if entry.made_by else 'unknown'}")
        print(json.dumps(entry.made_from, indent=2, sort_keys=True))


def _parser() -> argparse.ArgumentParser:
    root = argparse.ArgumentParser(add_help=False)
    root.add_argument("--root", default="cache", help="the store: a folder or s3://bucket/prefix (default: cache)")
    parser = argparse.ArgumentParser(prog="dzop cache", description="Inspect, verify and clean up the feature store.")
    commands = parser.add_subparsers(dest="command", required=True)
    ls = commands.add_parser("ls", parents=[root], help="list entries: state, rows, size, age and path")
    ls.add_argument(
        "--long",
        action="store_true",
        help="also print what each entry was made from and by",
    )
    commands.add_parser("du", parents=[root], help="print the size of each folder")
    commands.add_parser("verify", parents=[root], help="check every byte; damaged entries are marked incomplete")
    gc = commands.add_parser("gc", parents=[root], help="delete incomplete entries, and optionally old ones")
    gc.add_argument("--older-than", type=_days, metavar="DAYS", help="also delete complete entries older than DAYS")
    gc.add_argument("--dry-run", action="store_true", help="only print what would be deleted")
    path = commands.add_parser("path", parents=[root], help="print an entry's path and what it was made from")
    path.add_argument("key", help="the first digits of the entry's key")
    return parser


def _days(text: str) -> float:
    days = float(text)
    if not days >= 0:
        raise argparse.ArgumentTypeError(f"found {text}, needs a number of days >= 0")
    return days


def _open(root: str) -> Store:
    if not root.startswith("s3://") and not Path(root).is_dir():
        raise DzopError(f"{root}: found no such folder, needs a store (--root)")
    config = S3StoreConfig(url=root) if root.startswith("s3://") else LocalStoreConfig(root=root)
    store = Store(config, announce=print)
    check_is_store(store)
    return store


def _print_entries(entries: list[EntryInfo], *, long: bool) -> None:
    print(f"{'state':<11}{'rows':>6}{'size':>10}{'age':>8}  path")
    for entry in entries:
        size, age = format_bytes(entry.stored_bytes), _format_age(entry.age_h)
        print(f"{entry.state:<11}{entry.rows:>6}{size:>10}{age:>8}  {entry.path}")
        if long:
            print(f"{'':37}made from {json.dumps(entry.made_from, sort_keys=True)}")
            print(f"{'':37}made by {machine_text(entry.made_by) if entry.made_by else 'unknown'}")


def _format_age(hours: float | None) -> str:
    if hours is None:
        return "-"
    return f"{hours:.0f} h" if hours < 48 else f"{hours / 24:.0f} d"


def _print_sizes(entries: list[EntryInfo]) -> None:
    counts: defaultdict[str, int] = defaultdict(int)
    sizes: defaultdict[str, int] = defaultdict(int)
    for entry in entries:
        for folder in (entry.folder, "total"):
            counts[folder] += 1
            sizes[folder] += entry.stored_bytes
    for folder in sorted(sizes, key=lambda folder: (folder == "total", folder)):
        print(f"{format_bytes(sizes[folder]):>10}{counts[folder]:>7} entries  {folder}")


def _verify(store: Store) -> None:
    """Print every problem. Raises DzopError if there is one, so that the command exits with 1."""
    problems = verify(store)
    for path, problem in problems.items():
        if problem:
            print(f"{path}: {problem}")
    bad = sum(map(bool, problems.values()))
    print(f"{len(problems) - bad} entries intact, {bad} damaged or incomplete")
    if bad:
        found = f"{bad} of {len(problems)} entries are damaged or incomplete"
        raise DzopError(f"{found}; the next run that needs them recomputes what is missing")


def _collect_garbage(store: Store, older_than_days: float | None, *, dry_run: bool) -> None:
    hours = None if older_than_days is None else older_than_days * 24
    removed = collect_garbage(store, older_than_h=hours, dry_run=dry_run)
    for entry in removed:
        verb = "would remove" if dry_run else "removed"
        print(f"{verb} {entry.path} ({format_bytes(entry.stored_bytes)}, {entry.state})")
    print(f"{len(removed)} entries, {format_bytes(sum(entry.stored_bytes for entry in removed))}")
