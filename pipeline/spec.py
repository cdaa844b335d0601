"""Specs say what is computed and enter every key; Runtime says how and enters none.

A variant of a stage is a frozen, type-checked dataclass whose fields are its parameters::

    @spec
    class Cosine(Spec):
        kind: ClassVar[str] = "match.cosine"
        version: ClassVar[int] = 1
        layer: int = 2

``kind`` is ``<stage>.<file name>``; raise ``version`` whenever the same fields give other results.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, is_dataclass
from hashlib import sha256
from typing import Annotated, Any, ClassVar, Literal, Protocol, TypeVar, dataclass_transform

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from pipeline.errors import BadInput

T = TypeVar("T")

MOST = 2**31 - 1  # of a count or a seed: what C code below numpy, torch and OpenCV takes
Positive = Annotated[int, Field(ge=1, le=MOST)]
NonNegative = Annotated[int, Field(ge=0, le=MOST)]
NonNegativeFloat = Annotated[float, Field(ge=0, allow_inf_nan=False)]
PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]


@dataclass_transform(kw_only_default=True, frozen_default=True)
def spec(cls: type[T]) -> type[T]:
    """Frozen, keyword-only dataclass whose fields are checked strictly (no "1" for 1, no True for 1)."""
    config = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)
    return checked_dataclass(frozen=True, kw_only=True, config=config)(cls)  # type: ignore[return-value]


class Variant(Protocol):
    """What the cached graph asks of any stage: a name, and all that its results depend on but its inputs."""

    kind: ClassVar[str]

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe."""
        ...


class Spec:
    """Base of every spec. See the module's text."""

    kind: ClassVar[str]
    version: ClassVar[int] = 1

    def recipe(self) -> dict[str, Any]:
        """Everything the result depends on but the inputs, as JSON-able values.

        A field that is a location on disk is replaced here, by its owner, with the digest of what lies there.
        """
        return {"kind": self.kind, "version": self.version} | {
            f.name: _plain(getattr(self, f.name))
            for f in fields(self)  # type: ignore[arg-type]
        }


def _plain(value: Any) -> Any:
    if isinstance(value, Spec):
        return value.recipe()
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    return value


def canonical(value: Any) -> str:
    """The one text of a JSON-able value: sorted keys, no spaces, no NaN. 1, 1.0, True and "1" differ."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


def digest(value: Any) -> str:
    """sha256 (hex) of the canonical text of a JSON-able value."""
    return sha256(canonical(value).encode()).hexdigest()


def build(cls: type[T], values: Mapping[str, Any], *, where: str) -> T:
    """The spec ``cls`` from configuration values (lists become tuples).

    Raises BadInput naming ``where.field``, what was found and what is needed; several mistakes give the first.
    """
    try:
        return cls(**{k: _tuples(v) for k, v in values.items()})
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join([where, *(str(p) for p in first["loc"])])
        if first["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
            known = ", ".join(f.name for f in fields(cls))  # type: ignore[arg-type]
            raise BadInput(field, found="an unknown field", needed=f"one of: {known}") from None
        if first["type"] in ("too_long", "too_short"):
            least_or_most = "at most" if first["type"] == "too_long" else "at least"
            count = first["ctx"].get("max_length", first["ctx"].get("min_length"))
            needed = f"{least_or_most} {count} value{'' if count == 1 else 's'}"
            raise BadInput(field, found=_shown(first["input"]), needed=needed) from None
        if first["type"] == "missing" and isinstance(first["loc"][-1], int):  # the first value that a tuple lacks
            field = ".".join([where, *(str(p) for p in first["loc"][:-1])])
            raise BadInput(
                field, found=_shown(first["input"]), needed="more values: its yaml in conf/ says which"
            ) from None
        message = first["msg"].removeprefix("Value error, ")
        needed = message[0].lower() + message[1:].removeprefix("nput should be ")
        needed = needed.removeprefix("i") if message.startswith("Input should be ") else needed
        found = getattr(first["input"], "kind", None) or repr(first["input"])  # a whole spec would fill the screen
        raise BadInput(field, found=found, needed=needed) from None


def _shown(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _tuples(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return tuple(_tuples(v) for v in value)
    if isinstance(value, Mapping):
        return {k: _tuples(v) for k, v in value.items()}
    return value


@spec
class Runtime:
    """How to compute: never part of a key, never a reason for other results.

    ``device`` is "auto", "cpu", "cuda" or "cuda:N"; ``batch`` the images per backbone pass, 0 = sized to memory;
    ``max_vram`` and ``max_memory`` what the run may take of the device's memory and of the machine's, such as 8GiB,
    None = whatever is free.
    """

    device: str = "auto"
    batch: NonNegative = 0
    max_vram: Any = None  # what is no size is refused where it is read
    max_memory: Any = None
    progress: bool = True

    @property
    def vram_bytes(self) -> int | None:
        """``max_vram`` in bytes. Raises BadInput for what is no size."""
        return _size_bytes(self.max_vram, "runtime.max_vram")

    @property
    def memory_bytes(self) -> int | None:
        """``max_memory`` in bytes. Raises BadInput for what is no size."""
        return _size_bytes(self.max_memory, "runtime.max_memory")

    def workers(self, run: Any, *, threads: int) -> AbstractContextManager[Any]:
        """Who does a run's work: None for the process that asks. ``threads`` as in the configuration, 0 for all."""
        return nullcontext()

    def torch_device(self) -> str:
        """Torch's name of the device. Raises BadInput when CUDA is asked for and absent."""
        import torch

        if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", self.device):
            raise BadInput("runtime.device", found=repr(self.device), needed="auto, cpu, cuda or cuda:N")
        if self.device == "auto":
            return "cuda" if torch.cuda.is_available() else "cpu"
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise BadInput("runtime.device", found=repr(self.device), needed="a CUDA device, and torch sees none")
        return self.device


_UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12,
          "KIB": 1 << 10, "MIB": 1 << 20, "GIB": 1 << 30, "TIB": 1 << 40}  # fmt: skip


def _size_bytes(size: object, field: str) -> int | None:
    if size is None:
        return None
    found = re.fullmatch(r"(\d{1,15}(?:\.\d{1,6})?) ?([KMGT]i?B|B)", str(size), re.IGNORECASE)
    nbytes = 0 if found is None else int(float(found[1]) * _UNITS[found[2].upper()])
    if nbytes < 1:
        raise BadInput(field, found=repr(size), needed="a size with its unit, such as 8GiB or 500MB, or null")
    return nbytes


Dtype = Literal["float32", "float16", "bfloat16"]
