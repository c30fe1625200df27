"""Which compiled loops numba's cache contains, and an announcement before others are compiled."""

from __future__ import annotations

import functools
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

from foamfit.springs.compiled.contract import drop_stale, nothing

LOG = logging.getLogger(__name__)


def _caches() -> set[Path]:
    """Return numba's cache folders of this package, one for each folder with compiled loops."""
    from foamfit.solve.compiled import loop

    loops: tuple[Any, ...] = (loop.integrate, nothing)
    return {Path(loop.stats.cache_path or ".") for loop in loops}


@functools.cache
def announce(function: Any, what: str) -> None:
    """Log, once in a process, that `function` is about to be compiled, unless it has been."""
    in_process = getattr(function, "signatures", True)  # True: numba is disabled
    if not in_process and not compiled(function.__name__):
        warn(what)


def warn(what: str) -> None:
    """Log the message of `compiling`."""
    LOG.warning("foamfit: %s", compiling(what))


_ONCE = iter([", once after installation"])  # of the first message only


def compiling(what: str) -> str:
    """Return the message that `what` is compiled; the first says that this happens only once."""
    return f"compiling {what}{next(_ONCE, '')}"


def compiled(name: str = "integrate") -> bool:
    """Whether the cache contains a loop compiled from the current source, after `drop_stale`."""
    for folder in (caches := _caches()):
        drop_stale(folder)
    return any(True for folder in caches for _ in folder.glob(f"*.{name}-*.nbc"))


class Spent(threading.local):
    """Seconds that this thread has spent in compiled code."""

    seconds = 0.0


SPENT = Spent()


def timed(function: Callable[..., Any], *given: Any) -> Any:
    """Call a compiled function, and add its time to `SPENT`."""
    began = perf_counter()
    result = function(*given)
    SPENT.seconds += perf_counter() - began
    return result
