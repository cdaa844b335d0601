"""Specs: typed parameters of a stage, hashed into cache keys. ``Runtime`` says how to compute and is not hashed.

A stage variant is a frozen, type-checked dataclass whose fields are its parameters::

    @spec
    class Cosine(Spec):
        kind: ClassVar[str] = "match.cosine"
        version: ClassVar[int] = 1
        layer: int = 2

``kind`` is ``<stage>.<file name>``. Raise ``version`` whenever a code change alters results for the same fields.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from hashlib import sha256
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, Protocol, TypeVar, dataclass_transform

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass
from pydantic_core import ErrorDetails

from pipeline.errors import BadInput

T = TypeVar("T")

MAX_INT = 2**31 - 1  # counts and seeds reach C code in numpy, torch and OpenCV that takes 32-bit integers
Positive = Annotated[int, Field(ge=1, le=MAX_INT)]
NonNegative = Annotated[int, Field(ge=0, le=MAX_INT)]
NonNegativeFloat = Annotated[float, Field(ge=0, allow_inf_nan=False)]
FaceCount = Annotated[int, Field(ge=4, le=MAX_INT)]
PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]


@dataclass_transform(kw_only_default=True, frozen_default=True)
def spec(cls: type[T]) -> type[T]:
    """Decorator: a frozen, keyword-only dataclass with strict type checks (neither "1" nor True passes for 1)."""
    config = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)
    return checked_dataclass(frozen=True, kw_only=True, config=config)(cls)  # type: ignore[return-value]


class Variant(Protocol):
    """Any stage, as the cache sees it: a name and a recipe."""

    kind: ClassVar[str]

    def recipe(self) -> dict[str, Any]:
        """See ``Spec.recipe``."""
        ...


class Spec:
    """Base class of all specs; see the module docstring."""

    kind: ClassVar[str]
    version: ClassVar[int] = 1
    added: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Fields that came after the version -> the value that means what the version did before they came."""

    def recipe(self) -> dict[str, Any]:
        """Everything except the inputs that the result depends on, as JSON-able values.

        A field in ``added`` is left out at its value there, so that a new switch orphans no cache entry.
        Specs with a path among their fields override this to hash the file's contents instead of its location.
        """
        values = {f.name: _to_jsonable(getattr(self, f.name)) for f in fields(self)}  # type: ignore[arg-type]
        unchanged = {name for name, before in self.added.items() if values[name] == before}
        return {"kind": self.kind, "version": self.version} | {k: v for k, v in values.items() if k not in unchanged}


def _to_jsonable(value: Any) -> Any:
    if isinstance(value, Spec):
        return value.recipe()
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _to_jsonable(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, (tuple, list)):
        return [_to_jsonable(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): _to_jsonable(v) for k, v in value.items()}
    return value


def canonical(value: Any) -> str:
    """Canonical JSON: sorted keys, no spaces. 1, 1.0, True and "1" differ. Raises ValueError for NaN and infinity."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


def digest(value: Any) -> str:
    """sha256 (hex) of a value's canonical JSON."""
    return sha256(canonical(value).encode()).hexdigest()


def build(cls: type[T], values: Mapping[str, Any], *, where: str) -> T:
    """Build the spec ``cls`` from configuration values; lists become tuples.

    Raises BadInput for the first invalid field, which it names ``where.field``, or ``field`` if ``where`` is "".
    """
    try:
        return cls(**lists_to_tuples(values))
    except ValidationError as error:
        first = error.errors()[0]
        explain = _EXPLANATIONS.get(first["type"], _explain_value)
        raise explain(first, where, cls) from None


def lists_to_tuples(value: Any) -> Any:
    """The value with every list in it, however deeply nested, made a tuple."""
    if isinstance(value, (list, tuple)):
        return tuple(lists_to_tuples(v) for v in value)
    if isinstance(value, Mapping):
        return {k: lists_to_tuples(v) for k, v in value.items()}
    return value


# --- pydantic's errors as BadInput ------------------------------------------------------------------------------------


def _explain_value(error: ErrorDetails, where: str, cls: type) -> BadInput:
    """Any error without an entry in ``_EXPLANATIONS``: pydantic's message already names what it needs."""
    needed = error["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    found = getattr(error["input"], "kind", None) or repr(error["input"])  # the repr of a spec would fill the screen
    return BadInput(_field(where, error["loc"]), found=found, needed=needed)


def _explain_unknown(error: ErrorDetails, where: str, cls: type) -> BadInput:
    known = [f.name for f in fields(cls)]
    needed = f"one of: {', '.join(known)}{did_you_mean(str(error['loc'][-1]), known)}"
    return BadInput(_field(where, error["loc"]), found="an unknown field", needed=needed)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``; did you mean X?`` for the known name that is most similar to an unknown one, "" if none is."""
    similar = get_close_matches(name, list(known), n=1)
    return f"; did you mean {similar[0]}?" if similar else ""


def _explain_missing(error: ErrorDetails, where: str, cls: type) -> BadInput:
    """A missing field; or, where the location ends with an index, a tuple with too few values."""
    *parent, last = error["loc"]
    if isinstance(last, int):
        needed = "more values: see its yaml in conf/"
        return BadInput(_field(where, parent), found=list(error["input"]), needed=needed)
    return BadInput(_field(where, error["loc"]), found="nothing", needed="a value")


def _explain_too_long(error: ErrorDetails, where: str, cls: type) -> BadInput:
    needed = f"at most {_count_values(error['ctx']['max_length'])}"
    return BadInput(_field(where, error["loc"]), found=list(error["input"]), needed=needed)


def _explain_too_short(error: ErrorDetails, where: str, cls: type) -> BadInput:
    needed = f"at least {_count_values(error['ctx']['min_length'])}"
    return BadInput(_field(where, error["loc"]), found=list(error["input"]), needed=needed)


_EXPLANATIONS: dict[str, Callable[[ErrorDetails, str, type], BadInput]] = {
    "unexpected_keyword_argument": _explain_unknown,
    "missing": _explain_missing,
    "too_long": _explain_too_long,
    "too_short": _explain_too_short,
}


def _field(where: str, loc: Iterable[int | str]) -> str:
    return ".".join([*filter(None, [where]), *(str(part) for part in loc)])


def _count_values(count: int) -> str:
    return f"{count} value{'' if count == 1 else 's'}"


@spec
class Runtime:
    """How to compute. Never part of a key, because it must not change results.

    On the CPU of one machine with one set of library versions, the bytes of every entry are the same whatever
    ``batch``, threads and number of workers. On a GPU, ``batch`` may change the last digits of features.

    ``device``: "auto", "cpu", "cuda" or "cuda:N". ``batch``: images that a backbone gets at a time, 0 = as many as fit
    in memory; on the CPU rounded up to whole passes, whose size the model decides.
    ``max_vram`` and ``max_memory``: the most GPU memory and main memory the run may use, such as 8GiB, None = all
    that is free.
    """

    device: str = "auto"
    batch: NonNegative = 0
    max_vram: Any = None  # checked by vram_bytes and memory_bytes
    max_memory: Any = None
    progress: bool = True

    @property
    def vram_bytes(self) -> int | None:
        """``max_vram`` in bytes. Raises BadInput if it is not a size."""
        return _parse_size(self.max_vram, "runtime.max_vram")

    @property
    def memory_bytes(self) -> int | None:
        """``max_memory`` in bytes. Raises BadInput if it is not a size."""
        return _parse_size(self.max_memory, "runtime.max_memory")

    def start_workers(self, run: Any, *, threads: int) -> AbstractContextManager[Any]:
        """Worker processes for a run; None means this process computes everything. ``threads`` per process, 0 = all."""
        return nullcontext()

    def torch_device(self) -> str:
        """The torch device name, with "auto" resolved. Raises BadInput if CUDA is requested but not available."""
        import torch

        if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", self.device):
            raise BadInput("runtime.device", found=repr(self.device), needed="auto, cpu, cuda or cuda:N")
        if self.device == "auto":
            return "cuda" if torch.cuda.is_available() else "cpu"
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise BadInput("runtime.device", found=repr(self.device), needed="a CUDA device that torch can use")
        return self.device


_UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12,
          "KIB": 1 << 10, "MIB": 1 << 20, "GIB": 1 << 30, "TIB": 1 << 40}  # fmt: skip


def _parse_size(size: object, field: str) -> int | None:
    if size is None:
        return None
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,6})?) ?([KMGT]i?B|B)", str(size), re.IGNORECASE)
    nbytes = 0 if match is None else int(float(match[1]) * _UNITS[match[2].upper()])
    if nbytes < 1:
        raise BadInput(field, found=repr(size), needed="a size with a unit, such as 8GiB or 500MB, or null")
    return nbytes


Dtype = Literal["float32", "float16", "bfloat16"]
