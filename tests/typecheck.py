"""The type checker of the import hook in conftest.py: beartype, but for hints that cannot be checked at run time."""

from collections.abc import Callable
from typing import Any, get_args

from beartype import BeartypeConf, beartype

_BEARTYPE = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float, as for mypy


def check_types(function: Callable) -> Callable:
    """``function`` with checks of its arguments and its result, shapes of arrays among them.

    Hints that name a Protocol which is not runtime_checkable, as the contracts of stages are, are left to mypy.
    """
    hints = function.__annotations__
    function.__annotations__ = {name: Any if _names_protocol(hint) else hint for name, hint in hints.items()}
    return _BEARTYPE(function)


def _names_protocol(hint: Any) -> bool:
    unchecked = getattr(hint, "_is_protocol", False) and not getattr(hint, "_is_runtime_protocol", False)
    return unchecked or any(_names_protocol(part) for part in get_args(hint))
