"""First use: what is compiled is made by two processes side by side, and kept in the cache.

Compiling in one process takes twice as long. Nothing else depends on it: what is not in the cache
is compiled where it is first needed, and said so.
"""

from __future__ import annotations

import functools
import gc
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_LOG = logging.getLogger(__name__)

Call = tuple[Any, tuple[Any, ...]]

# The modules that compiled loops are written in, and the package that they lie in.
PACKAGE = Path(__file__).parents[1]
COMPILED = (
    "springs/law", "springs/kernels", "solve/polynomial", "solve/many", "solve/explicit/series",
    "solve/explicit/taylor", "solve/implicit/collocation", "solve/implicit/steps",
    "solve/implicit/vibration",
)  # fmt: skip


class _Calls(NamedTuple):
    """Functions to compile, with examples of their arguments.

    `pieces` of the integrator are made by the other process, and then the `rest`, those last that
    an impact on one spring does not need; `own` pieces and the integrator itself, `whole`, by this.
    """

    pieces: list[Call]
    rest: list[Call]
    own: list[Call]
    whole: list[Call]


def _calls() -> _Calls:
    from foamfit.solve import polynomial
    from foamfit.solve.explicit import series, taylor
    from foamfit.solve.implicit import vibration
    from foamfit.springs import kernels

    one, flat, cube = np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1, 1))
    whole, table = np.zeros(1, np.int64), np.zeros((1, 1), np.int64)
    directions = np.zeros((0, 2), np.int64)
    links = series.Links(flat, whole, one, 0.0, taylor.FREE)
    _, d = series.make_series.py_func(1, 6, directions)
    out = taylor.Samples(one, flat, cube)
    scene = (flat, one, whole, one, 0.0, 0, one, 0.0, one, 0.0, 0, directions, flat)
    return _Calls(
        pieces=[
            (series.expand_tangents, (links, cube, d, 0)),
            (polynomial.first_crossing, (one, 0, 0.0, 0.0, 0.0)),
            (taylor.sample, (links, cube, 0, out, 0, 0, 0.0, one)),
            (taylor.sample_tangents, (links, cube, d, 0, out, 0, 0, 0.0, one)),
            (series.make_series, (1, 0, directions)),
            (series.advance_tangents, (d, 0, 0, 0.0)),
            (taylor.depart, (links, cube, d, 0, 0, 0.0, 0.0, out, 0, flat)),
            (taylor.first_switch, (flat, cube, 0, 0.0)),
            (taylor.tangent_length, (one, d, 0, 0.0, 0.0, flat)),
            (taylor.first_lift, (cube, 0, True, True, 0.0)),
        ],
        rest=[
            (kernels.fault, (one,)),
            (kernels.fill_rows, (whole, one, flat)),
            (kernels.total, (one,)),
            (kernels.stress_along, (one, one)),
            (series.equilibrium_tangents, (flat, one, flat, table, True, directions)),
            (vibration.parts_faintly, (flat, one, 0.0)),
            (vibration.hurry_of, (flat, one, whole, one, 0.0, 0, 0.0, one)),
            (kernels.strains_along, (flat, one, one, one, flat, table)),
            (kernels.equilibrium_along, (flat, one, one, one, flat, table)),
        ],
        own=[
            (series.expand, (links, cube, one, one, 0)),
            (taylor.begin, (flat, one, flat, directions, whole, flat, cube, d)),
            (taylor.switch, (flat, whole, flat, cube, d, directions, 0, 0.0, 0.0, 0, 0, flat, 0)),
            (series.expand_bare, (links, cube, one, 0)),
            (series.advance, (cube, 0, 0, 0.0)),
            (taylor.before_contact, (flat, one, 0.0)),
            (taylor.step_length, (links, cube, one, 0, 0.0, 0.0, 0.0, 0.0, 0.0)),
            (taylor.settle, (links, cube)),
        ],
        whole=[(taylor.integrate, (*scene, flat, cube, flat))],
    )


def _compile(calls: list[Call]) -> None:
    from numba import typeof

    gc.disable()  # what compiling makes stays
    try:
        for function, arguments in calls:
            function.compile(tuple(typeof(value) for value in arguments))  # type: ignore[no-untyped-call]
    finally:
        gc.enable()


def _caches() -> set[Path]:
    """Folders in which numba keeps what it compiled of this package: one beside each of its own."""
    from foamfit.solve import polynomial
    from foamfit.solve.explicit import taylor
    from foamfit.solve.implicit import vibration
    from foamfit.springs import kernels

    loops = (kernels.fault, polynomial.first_crossing, taylor.integrate, vibration.hurry_of)
    return {Path(loop.stats.cache_path or ".") for loop in loops}


@functools.cache
def announce(function: Any, what: str) -> None:
    """Log, once in a process, that `function` is about to be compiled, unless it has been."""
    made = getattr(function, "signatures", True)  # where numba is switched off there are none
    if not made and not compiled(function.__name__):
        _LOG.warning("foamfit: compiling %s, once after installation", what)


def compiled(name: str = "integrate") -> bool:
    """Tell whether an earlier run left a loop, compiled of this very source, in the cache.

    What is older than any module that compiled loops are written in is removed: numba itself
    compares it with the module of the outermost loop alone.
    """
    times = [(PACKAGE / f"{name}.py").stat().st_mtime for name in COMPILED]
    written = max((at for at in times if at <= time.time()), default=0.0)  # some clocks are wrong
    fresh = False
    for made in (path for cache in _caches() for path in cache.glob("*.nb[ci]")):
        if made.stat().st_mtime < written:
            with suppress(OSError):  # not ours to remove
                made.unlink(missing_ok=True)
        elif f".{name}-" in made.name:
            fresh = fresh or made.suffix == ".nbc"
    return fresh


@contextmanager
def side_by_side() -> Iterator[Callable[[], None]]:
    """Let another process compile beside the body, which calls what is given before it simulates.

    At the end all that a fit needs is in the cache. The other process is stopped if the body fails.
    """
    path = os.pathsep.join([str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    with subprocess.Popen(
        [sys.executable, "-m", "foamfit.solve.precompile"],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
        process_group=0,  # Ctrl-C is for the process that starts this one
    ) as other:

        def finish() -> None:
            calls = _calls()
            _compile(calls.own)
            if other.stdout is not None:
                other.stdout.readline()  # the pieces are there, or the other process has failed
            _compile(calls.whole)

        try:
            yield finish
            other.wait()
        except BaseException:
            other.terminate()
            raise


def _other() -> None:
    calls = _calls()
    _compile(calls.pieces)
    print("pieces", flush=True)
    _compile(calls.rest)


if __name__ == "__main__":
    _other()
