"""How loops are compiled: by numba, kept on disk between processes, without the interpreter's lock.

Division by zero gives what the hardware gives. A function that is compiled anew takes a second or
so; `python -m app.compile` compiles those of the service ahead of its first start. `loop_cache`
chooses the folder; without one, every process compiles for itself.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from time import monotonic
from typing import Any, Final, TypeAlias

from numba import config, njit
from numba.core import event

from app import loop_cache

Function: TypeAlias = Callable[..., Any]

_logger = logging.getLogger("app.compiling")

_LOOPS: Final[list[Any]] = []

# Sums may be taken in any order, so that the compiler can take eight terms at a time. It chooses
# one order, once.
_ANY_ORDER = {"reassoc", "contract"}

_SETTINGS: Any = config

# numba's own setting, NUMBA_CACHE_DIR, chooses the root.
_FOLDER, _PROBLEM = loop_cache.prepare(_SETTINGS.CACHE_DIR)


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
    found: Function = _kept(function, options) or njit(**options)(function)
    _LOOPS.append(found)
    return found


def _kept(function: Function, options: dict[str, Any]) -> Any:
    """The function with a cache on disk, or None where it can have none."""
    if _FOLDER is None:
        return None
    # numba reads the setting when a function is declared. Other libraries keep theirs.
    usual = _SETTINGS.CACHE_DIR
    _SETTINGS.CACHE_DIR = str(_FOLDER)
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # a function without a source file
        return None
    finally:
        _SETTINGS.CACHE_DIR = usual


def check_cache() -> None:
    """Log where loops are kept, unless that is the usual place."""
    if _FOLDER is None:
        _logger.warning("compiled loops are not kept, each start compiles them: %s", _PROBLEM)
    elif _PROBLEM:
        _logger.info("compiled loops are kept in %s: %s", _FOLDER, _PROBLEM)


@contextmanager
def progress() -> Iterator[None]:
    """Log the progress of compiling, if there is any; one process at a time compiles."""
    with ExitStack() as stack:
        stack.enter_context(event.install_listener("numba:compile", _Progress(stack)))
        yield


class _Progress(event.Listener):
    """Logs a line a second while loops are compiled.

    Args:
        stack: holds the folder's lock once something is compiled.
    """

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._begun: set[int] = set()
        self._logged = float("-inf")

    def on_start(self, event: Any) -> None:
        """A function that is not on disk is about to be compiled."""
        loop = event.data["dispatcher"]
        if not any(loop is known for known in _LOOPS):  # one of numba's own
            return
        if not self._begun and _FOLDER is not None:
            self._stack.enter_context(loop_cache.alone(_FOLDER))
        self._begun.add(id(loop))
        if monotonic() - self._logged >= 1:
            done = sum(bool(one.signatures) or id(one) in self._begun for one in _LOOPS)
            _logger.info("compiling loop %d of %d", done, len(_LOOPS))
            self._logged = monotonic()

    def on_end(self, event: Any) -> None:
        """The function is compiled."""
