"""The runtime type checker of the tests: beartype. It accepts an int for a float, as Python's typing rules do."""

from collections.abc import Callable

import beartype

_check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
_CHECKED: dict[tuple, Callable] = {}


def check(function: Callable) -> Callable:
    """The function with checks of its arguments.

    jaxtyping gives functions that do nothing but have the annotations of those of the library. A function that is
    defined inside another one comes again at each call of the other: its checks, which take milliseconds, are kept.
    """
    defaults = (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values())
    names = function.__module__, function.__qualname__, *function.__annotations__.items()
    key = function.__code__, *names, *map(id, defaults)
    try:
        if key not in _CHECKED:
            _CHECKED[key] = _check(function)  # holds the defaults, so that their addresses stay theirs
        return _CHECKED[key]
    except TypeError:  # an annotation without a hash
        return _check(function)
