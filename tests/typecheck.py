"""Checks of arguments and results, shapes of arrays among them, in every function and dataclass of the package.

jaxtyping's import hook decorates them with ``jaxtyping.jaxtyped``, which binds the arguments and checks them twice in
every call. Here a function is checked once, by beartype, and arguments are bound only where annotations name shapes.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable
from typing import Any, get_args, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, TypeCheckError, install_import_hook

_BEARTYPE = beartype(
    conf=BeartypeConf(
        is_pep484_tower=True,  # an int is a float, as for mypy
        violation_type=TypeCheckError,  # a TypeError, as code raises that finds another type by itself
    )
)
_WITH_SHAPES = jaxtyping.jaxtyped(typechecker=None)


def install(packages: Iterable[str]) -> None:
    """Check whatever is imported from these packages from now on."""
    jaxtyping.jaxtyped = lambda *, typechecker: _check  # the name that decorators of the hook look up
    install_import_hook(list(packages), None)


def _check(decorated: Any) -> Any:
    """The function or class with checks; of a class that is a dataclass, those of the arguments of its constructor."""
    if not inspect.isclass(decorated):
        return _check_function(decorated)
    init = vars(decorated).get("__init__")
    if dataclasses.is_dataclass(decorated) and init is not None and not hasattr(init, "__wrapped__"):
        decorated.__init__ = _check_function(init)
    return decorated


def _check_function(function: Callable) -> Callable:
    """``function`` with checks of its arguments and its result.

    Hints that cannot be evaluated, or that name a Protocol which is not runtime_checkable, as the contracts of stages
    are, are left to mypy.
    """
    hints = {name: _evaluate(hint, function) for name, hint in function.__annotations__.items()}
    function.__annotations__ = {name: Any if _names_protocol(hint) else hint for name, hint in hints.items()}
    checked = _BEARTYPE(function)
    return _WITH_SHAPES(checked) if any(_names_shape(hint) for hint in hints.values()) else checked


def _evaluate(hint: Any, function: Callable) -> Any:
    def value() -> None: ...

    value.__annotations__ = {"value": hint}
    try:
        return get_type_hints(value, function.__globals__, include_extras=True)["value"]
    except Exception:  # a name that is defined further down, or for mypy alone
        return Any


def _names_protocol(hint: Any) -> bool:
    unchecked = getattr(hint, "_is_protocol", False) and not getattr(hint, "_is_runtime_protocol", False)
    return unchecked or any(_names_protocol(part) for part in get_args(hint))


def _names_shape(hint: Any) -> bool:
    return (inspect.isclass(hint) and issubclass(hint, AbstractArray)) or any(map(_names_shape, get_args(hint)))
