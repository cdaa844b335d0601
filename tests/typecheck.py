"""Checks of arguments and results, shapes of arrays among them, in every function and dataclass of the package.

jaxtyping's import hook decorates them with ``jaxtyping.jaxtyped``, which binds the arguments and checks them twice in
every call. Here a function is checked once, by beartype; only where annotations name axes, such as "h w", a call gets a
context in which their sizes must agree. Checks are a fifth of the time of tests on small data, so they are kept short.
"""

from __future__ import annotations

import dataclasses
import functools
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
_AXES_CONTEXT = jaxtyping.jaxtyped
_ARRAY_HINT = type(AbstractArray)
_is_instance = _ARRAY_HINT.__instancecheck__
_fitting: set[tuple] = set()


def install(packages: Iterable[str]) -> None:
    """Check whatever is imported from these packages from now on."""
    jaxtyping.jaxtyped = lambda *, typechecker: _check  # the name that decorators of the hook look up
    _ARRAY_HINT.__instancecheck__ = _fits
    install_import_hook(list(packages), None)


def _fits(hint: Any, value: Any) -> bool:
    """``isinstance(value, hint)``. Without named axes it depends on type, dtype and shape alone and is remembered."""
    if _has_named_axis(hint):
        return _is_instance(hint, value)
    key = (hint, type(value), getattr(value, "dtype", None), getattr(value, "shape", None))
    if key in _fitting:
        return True
    if not _is_instance(hint, value):
        return False
    _fitting.add(key)
    return True


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
    return _agree_on_axes(checked) if any(map(_names_axis, hints.values())) else checked


def _agree_on_axes(function: Callable) -> Callable:
    """``function``, in each of whose calls an axis of one name has one size."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        with _AXES_CONTEXT("context"):
            return function(*args, **kwargs)

    return call


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


def _names_axis(hint: Any) -> bool:
    """Whether a hint is, or contains, an array with an axis that is not just a number."""
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return _has_named_axis(hint)
    return any(map(_names_axis, get_args(hint)))


@functools.cache
def _has_named_axis(array: type[AbstractArray]) -> bool:
    return not all(axis.isdigit() for axis in array.dim_str.split())
