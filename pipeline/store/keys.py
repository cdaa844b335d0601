"""Cache keys: sha256 of the canonical JSON of (recipe, input keys), a Merkle tree from mesh files to poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.spec import canonical, digest


@dataclass(frozen=True)
class Ref:
    """Path of an entry, and the hashed text of its recipe and inputs, which is stored in the entry."""

    folder: str
    key: str
    made_from: str

    @property
    def path(self) -> str:
        """``<folder>/<key>``, relative to the store's root."""
        return f"{self.folder}/{self.key}"


def make_ref(folder: str, recipe: Mapping[str, Any], inputs: Mapping[str, str]) -> Ref:
    """The entry below ``folder`` for ``recipe`` applied to ``inputs`` (name -> key or file digest)."""
    made_from = {"recipe": dict(recipe), "inputs": dict(inputs)}
    return Ref(folder, digest(made_from), canonical(made_from))
