"""Leases mark the entries that running processes use, so that ``dzop cache gc`` of another process keeps them.

A process writes one empty key per entry, ``.leases/<process>/<entry's key>``, before it checks whether the entry is
complete; gc withdraws an entry's completion record before it looks for leases. In any order, either gc finds the lease
and restores the record, or the process finds no complete entry. This needs no locks, so it works on S3 too.

A killed process leaves its leases behind. A gc on the same machine sees that the process is gone and ignores them;
elsewhere they expire an hour after the process last used the store.
"""

from __future__ import annotations

import errno
import json
import os
import re
import socket
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from secrets import token_hex
from typing import Any

from zarr.abc.store import Store as ZarrStore
from zarr.core.sync import sync

from pipeline.store.arrays import list_keys, read_bytes, write_bytes
from pipeline.store.remote import AccessDenied, StoreUnreachable

FOLDER = ".leases"
LIFETIME_S = 3600.0  # lifetime of a lease after the process last used the store
_REFRESH_S = 60.0
_CLOCK_SKEW_S = 86400.0  # tolerance for leases from the future: clocks of machines differ
_ALIVE = "alive"


class Lease:
    """The leases of one process; none on a read-only store. Thread-safe.

    ``name``: set in a worker to that of the parent process, which renews and releases the leases of both.
    """

    def __init__(self, store: ZarrStore, name: str = "") -> None:
        host = re.sub(r"[^\w.-]", "_", socket.gethostname())
        self.name = name or f"{host}-{os.getpid()}-{token_hex(4)}"
        self._store = store
        self._is_joined = bool(name)
        self._taken: set[str] = set()
        self._refreshed_s = 0.0
        self._writable = True
        self._lock = threading.RLock()

    def take(self, key: str) -> None:
        """Lease an entry. Call this before checking whether it is complete."""
        self.refresh()
        with self._lock:
            if key not in self._taken and self._write(key, b""):
                self._taken.add(key)

    def refresh(self) -> None:
        """Renew the leases, at most once a minute.

        Uses wall-clock time, which goes on while a computer sleeps: gc may have removed the leases by then.
        """
        with self._lock:
            seconds = time.time() - self._refreshed_s
            if 0 <= seconds < _REFRESH_S:
                return
            self._refreshed_s = time.time()
            process = self._process()
            if process is None:
                return
            self._write(_ALIVE, json.dumps({"at": time.time(), "process": process}).encode())
            if seconds > LIFETIME_S:
                for key in self._taken:
                    self._write(key, b"")

    def _process(self) -> Any:
        """Owner of the leases; None if a parent process owned them and has released them."""
        return _alive_record(self._store, self.name).get("process") if self._is_joined else _describe_process()

    def _write(self, name: str, content: bytes) -> bool:
        if not self._writable:
            return False
        try:
            write_bytes(self._store, f"{FOLDER}/{self.name}/{name}", content)
        except (OSError, AccessDenied) as error:
            self._writable = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
            return False
        return True

    def release(self) -> None:
        """Remove this process's leases and take no more. If the store does not answer, they expire."""
        with self._lock, suppress(OSError, StoreUnreachable):
            self._writable = False
            sync(self._store.delete_dir(f"{FOLDER}/{self.name}"))


def live_leases(store: ZarrStore) -> dict[str, str]:
    """Keys of leased entries, each with the name of one process that uses it (host, process id, random)."""
    names: dict[str, list[str]] = {}
    for key in list_keys(store, FOLDER):
        _, name, leased = (*key.split("/", 2), "", "")[:3]
        if leased != _ALIVE:
            names.setdefault(name, []).append(leased)
    return {key: name for name, keys in names.items() if _is_live(store, name) for key in keys}


def remove_expired_leases(store: ZarrStore) -> None:
    """Remove expired leases, of processes that ended without releasing them."""
    for name in {key.split("/")[1] for key in list_keys(store, FOLDER)}:
        if not _is_live(store, name):
            sync(store.delete_dir(f"{FOLDER}/{name}"))


def _is_live(store: ZarrStore, name: str) -> bool:
    alive = _alive_record(store, name)
    try:
        seconds = time.time() - float(alive["at"])
    except (ValueError, KeyError, TypeError, OverflowError):
        return False
    return -_CLOCK_SKEW_S < seconds < LIFETIME_S and not _has_ended(alive.get("process"))


def _alive_record(store: ZarrStore, name: str) -> Mapping[str, Any]:
    """The record that a process last wrote of itself; empty if missing or cut off by a full disk or power failure."""
    try:
        found = json.loads(read_bytes(store, f"{FOLDER}/{name}/{_ALIVE}") or b"")
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, Mapping) else {}


# --- processes of this machine ----------------------------------------------------------------------------------------


def _describe_process() -> dict[str, Any]:
    """Identifies this process among all others; on systems other than Linux without what ``_has_ended`` needs."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        namespace = os.readlink("/proc/self/ns/pid")  # two containers on one machine may have equal process ids
    except OSError:
        return {"pid": os.getpid()}
    return {"boot": boot, "namespace": namespace, "pid": os.getpid(), "started": _start_of(os.getpid())}


def _has_ended(process: Any) -> bool:
    """Whether a process ran on this machine and has ended; False if unknown."""
    if not isinstance(process, Mapping) or not isinstance(pid := process.get("pid"), int) or not 0 < pid < 2**31:
        return False
    here = _describe_process()
    if "boot" not in here or any(process.get(name) != here[name] for name in ("boot", "namespace")):
        return False
    try:
        os.kill(pid, 0)  # only checks that the process exists
    except ProcessLookupError:
        return True
    except PermissionError:  # another user's process, whose start time may be hidden
        pass
    return _start_of(pid) not in (None, process.get("started"))


def _start_of(pid: int) -> int | None:
    """Start time of a process in clock ticks since boot; -1 if it has ended, None if it cannot be read."""
    try:
        state, *fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (OSError, ValueError):
        return None
    return -1 if state in "ZX" else int(fields[18])
