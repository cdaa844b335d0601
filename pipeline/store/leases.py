"""Leases: which entries running processes use, so that ``dzop cache gc`` of another process leaves them alone.

A process writes one empty key for each entry, ``.leases/<process>/<entry's key>``, before it looks whether the entry
is complete; gc withdraws an entry's completion record before it looks for leases. Whatever the order, either gc finds
the lease and restores the record, or the process finds no complete entry. This needs no locks, so it holds on S3 too.

A process that is killed leaves its leases behind. They end at once for a gc on the same machine, which finds that the
process is gone, and elsewhere an hour after the process last used the store.
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
LIFETIME_S = 3600.0  # since the process last used the store
_REFRESH_S = 60.0
_CLOCK_SKEW_S = 86400.0  # a lease from the future is live up to here: clocks of machines differ
_ALIVE = "alive"


class Lease:
    """The leases of one process. Where the store cannot be written there are none. May be used by several threads.

    ``name``: that of the process which started this one, and which keeps and releases the leases of both.
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
        """Lease an entry. Call this before looking whether it is complete."""
        self.refresh()
        with self._lock:
            if key not in self._taken and self._write(key, b""):
                self._taken.add(key)

    def refresh(self) -> None:
        """Say that this process is alive, at most once a minute.

        By the clock on the wall: it goes on while a computer sleeps, after which gc may have removed the leases.
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
        """The process that releases the leases; None if it is another one, which has released them already."""
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
        """Remove this process's leases and take none from now on. If the store does not answer, they expire."""
        with self._lock, suppress(OSError, StoreUnreachable):
            self._writable = False
            sync(self._store.delete_dir(f"{FOLDER}/{self.name}"))


def live_leases(store: ZarrStore) -> dict[str, str]:
    """Keys of entries that a process uses, each with the name of one such process (host, process id, random)."""
    names: dict[str, list[str]] = {}
    for key in list_keys(store, FOLDER):
        _, name, leased = (*key.split("/", 2), "", "")[:3]
        if leased != _ALIVE:
            names.setdefault(name, []).append(leased)
    return {key: name for name, keys in names.items() if _is_live(store, name) for key in keys}


def remove_expired_leases(store: ZarrStore) -> None:
    """Remove the leases of processes that ended without releasing them."""
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
    """What a process last said of itself; empty if there is nothing, or it was cut off by a full disk or power cut."""
    try:
        found = json.loads(read_bytes(store, f"{FOLDER}/{name}/{_ALIVE}") or b"")
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, Mapping) else {}


# --- processes of this machine ----------------------------------------------------------------------------------------


def _describe_process() -> dict[str, Any]:
    """What tells this process from all others; of other systems than Linux, nothing that ``_has_ended`` could use."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        namespace = os.readlink("/proc/self/ns/pid")  # process ids of two containers of one machine may be equal
    except OSError:
        return {"pid": os.getpid()}
    return {"boot": boot, "namespace": namespace, "pid": os.getpid(), "started": _start_of(os.getpid())}


def _has_ended(process: Any) -> bool:
    """Whether a process ran on this machine and runs no more; False where this cannot be known."""
    if not isinstance(process, Mapping) or not isinstance(pid := process.get("pid"), int) or not 0 < pid < 2**31:
        return False
    here = _describe_process()
    if "boot" not in here or any(process.get(name) != here[name] for name in ("boot", "namespace")):
        return False
    try:
        os.kill(pid, 0)  # sends nothing
    except ProcessLookupError:
        return True
    except PermissionError:  # another user's, whose start may be hidden
        pass
    return _start_of(pid) not in (None, process.get("started"))


def _start_of(pid: int) -> int | None:
    """When a process started, in clock ticks since the machine did; -1 if it has ended, None if it cannot be read."""
    try:
        state, *fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (OSError, ValueError):
        return None
    return -1 if state in "ZX" else int(fields[18])
