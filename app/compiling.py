"""How loops are compiled: by numba, kept on disk between processes, without the interpreter's lock.

Division by zero gives what the hardware gives. A function that is compiled anew takes a second or
so; `python -m app.compile` does those of the service ahead of its first start. Where nothing can be
written, neither beside the sources nor into NUMBA_CACHE_DIR nor into the user's cache directory,
every process compiles for itself.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final, TypeAlias

from llvmlite.binding import parse_bitcode
from numba import njit

Function: TypeAlias = Callable[..., Any]

_LOOPS: Final[list[Any]] = []

# Sums may be taken in any order, so that the compiler can take eight terms at a time. It chooses
# one order, once.
_ANY_ORDER = {"reassoc", "contract"}


def compiled(function: Function) -> Function:
    """Compile a function."""
    return _compile(function, {})


def compiled_in_any_order(function: Function) -> Function:
    """The same, with sums in any order; `elementary` must stay out of such functions.

    The cancellations of exp and log are meant.
    """
    return _compile(function, {"fastmath": _ANY_ORDER})


def inlined(function: Function) -> Function:
    """Part of whichever compiled function calls it, and compiled as that one is."""
    found: Function = njit(inline="always", error_model="numpy")(function)
    return found


def _compile(function: Function, options: dict[str, Any]) -> Function:
    # Nobody calls them from C.
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **options}
    try:
        found: Function = njit(cache=True, **options)(function)
    except RuntimeError:  # no directory for the cache
        found = njit(**options)(function)
    _LOOPS.append(found)
    return found


def pack() -> None:
    """Keep the intermediate code of loops that were loaded from disk as it was there: packed.

    numba unpacks it with every loop, and uses it only where another that calls the loop is compiled
    later; for those of the service it takes 25 MB. There is no public way to say so: where a later
    numba has other names for it nothing happens.
    """
    for loop in _LOOPS:
        for version in loop.overloads.values():
            library = version.library
            unpacked = getattr(library, "_shared_module", None)
            # That of a loop which this process has compiled is its only code.
            if unpacked is not None and unpacked is not library._final_module:
                library._get_module_for_linking = partial(parse_bitcode, unpacked.as_bitcode())
                library._shared_module = None
