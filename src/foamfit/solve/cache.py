"""What an earlier run left compiled, and an announcement of what has to be compiled yet."""

from __future__ import annotations

import functools
import logging
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

_LOG = logging.getLogger(__name__)
# The package, and its folders in which compiled loops are written.
PACKAGE = Path(__file__).parents[1]
FOLDERS = ("springs", "solve")


def _caches() -> set[Path]:
    """Folders in which numba keeps what it compiled of this package: one beside each of its own."""
    from foamfit.solve import polynomial, rates
    from foamfit.solve.explicit import taylor
    from foamfit.springs import kernels
    from foamfit.springs.laws import followed

    law: Any = followed.functions_of("linear").begin
    loops: tuple[Any, ...] = (
        kernels.fault,
        law,
        polynomial.first_crossing,
        taylor.integrate,
        rates.fastest_rates,
    )
    return {Path(loop.stats.cache_path or ".") for loop in loops}


@functools.cache
def announce(function: Any, what: str) -> None:
    """Log, once in a process, that `function` is about to be compiled, unless it has been."""
    made = getattr(function, "signatures", True)  # where numba is switched off there are none
    if not made and not compiled(function.__name__):
        warn(what)


def warn(what: str) -> None:
    """Log that something is compiled."""
    _LOG.warning("foamfit: %s", compiling(what))


@functools.cache
def _first() -> str:
    return ", once after installation"


def compiling(what: str) -> str:
    """Say that something is compiled, and to the first who asks that it is only done once."""
    once = "" if _first.cache_info().currsize else _first()
    return f"compiling {what}{once}"


def compiled(name: str = "integrate") -> bool:
    """Whether an earlier run left a loop, compiled of this very source, in the cache.

    What is older than any module in these folders is removed: numba itself compares it with the
    module of the outermost loop alone.
    """
    times = [path.stat().st_mtime for name in FOLDERS for path in (PACKAGE / name).rglob("*.py")]
    written = max((at for at in times if at <= time.time()), default=0.0)  # some clocks are wrong
    fresh = False
    for made in (path for cache in _caches() for path in cache.glob("*.nb[ci]")):
        if made.stat().st_mtime < written:
            with suppress(OSError):  # not ours to remove
                made.unlink(missing_ok=True)
        elif f".{name}-" in made.name:
            fresh = fresh or made.suffix == ".nbc"
    return fresh
