"""Leases: which entries running processes use, so that ``dzop cache gc`` of another process leaves them alone.

A process writes one empty key for each entry, ``.leases/<process>/<entry's key>``, before it looks whether the entry
is complete; gc withdraws an entry's completion record before it looks for leases. Whatever the order, either gc finds
the lease and restores the record, or the process finds no complete entry. This needs no locks, so it holds on S3 too.
"""

from __future__ import annotations

import json
import os
import re
import socket
import time
from secrets import token_hex

from zarr.abc.store import Store as ZarrStore
from zarr.core.sync import sync

from pipeline.store.arrays import list_keys, read_bytes, write_bytes
from pipeline.store.remote import AccessDenied

FOLDER = ".leases"
LIFETIME_S = 3600.0  # since the process last used the store; a killed process leaves its leases behind
_REFRESH_S = 60.0
_CLOCK_SKEW_S = 86400.0  # a lease from the future is live up to here: clocks of machines differ
_ALIVE = "alive"


class Lease:
    """The leases of one process. Where the store cannot be written there are none.

    ``name``: that of the process which started this one, so that its release removes the leases of both.
    """

    def __init__(self, store: ZarrStore, name: str = "") -> None:
        host = re.sub(r"[^\w.-]", "_", socket.gethostname())
        self.name = name or f"{host}-{os.getpid()}-{token_hex(4)}"
        self._store = store
        self._taken: set[str] = set()
        self._refreshed_s: float | None = None
        self._writable = True

    def take(self, key: str) -> None:
        """Lease an entry. Call this before looking whether it is complete."""
        self.refresh()
        if key not in self._taken:
            self._write(key, b"")
            self._taken.add(key)

    def refresh(self) -> None:
        """Say that this process is alive, at most once a minute."""
        now_s = time.monotonic()
        if self._refreshed_s is None or now_s - self._refreshed_s > _REFRESH_S:
            self._write(_ALIVE, json.dumps({"at": time.time()}).encode())
            self._refreshed_s = now_s

    def _write(self, name: str, content: bytes) -> None:
        if not self._writable:
            return
        try:
            write_bytes(self._store, f"{FOLDER}/{self.name}/{name}", content)
        except (OSError, AccessDenied):
            self._writable = False

    def release(self) -> None:
        """Remove this process's leases."""
        if self._writable:
            try:
                sync(self._store.delete_dir(f"{FOLDER}/{self.name}"))
            except (OSError, AccessDenied):
                return


def live_leases(store: ZarrStore) -> dict[str, str]:
    """Keys of entries that a process uses, each with the name of one such process (host, process id, random)."""
    names: dict[str, list[str]] = {}
    for key in list_keys(store, FOLDER):
        _, name, leased = (*key.split("/", 2), "", "")[:3]
        names.setdefault(name, []).append(leased)
    return {key: name for name, keys in names.items() if _is_live(store, name) for key in keys}


def remove_expired_leases(store: ZarrStore) -> None:
    """Remove the leases of processes that ended without releasing them."""
    for name in {key.split("/")[1] for key in list_keys(store, FOLDER)}:
        if not _is_live(store, name):
            sync(store.delete_dir(f"{FOLDER}/{name}"))


def _is_live(store: ZarrStore, name: str) -> bool:
    try:
        seconds = time.time() - float(json.loads(read_bytes(store, f"{FOLDER}/{name}/{_ALIVE}") or b"")["at"])
    except (ValueError, KeyError, TypeError, OverflowError):  # cut off by a full disk or a power cut
        return False
    return -_CLOCK_SKEW_S < seconds < LIFETIME_S
