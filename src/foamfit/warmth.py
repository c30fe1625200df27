"""First use: what is compiled is made by two processes side by side, and kept in the cache.

Compiling in one process takes twice as long. Nothing else depends on it: what is not in the cache
is compiled where it is first needed.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Call = tuple[Any, tuple[Any, ...]]


class _Calls(NamedTuple):
    """Functions to compile, with examples of their arguments.

    `pieces` of the integrator and the `rest` are made by the other process; `own` pieces and the
    integrator itself, `whole`, by this one.
    """

    pieces: list[Call]
    rest: list[Call]
    own: list[Call]
    whole: list[Call]


def _calls() -> _Calls:
    from foamfit import kernels, polynomial, ringing, series, taylor

    one, flat, cube = np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1, 1))
    whole, table = np.zeros(1, np.int64), np.zeros((1, 1), np.int64)
    directions = np.zeros((0, 2), np.int64)
    links = series.Links(flat, one, one, whole, one, 0.0, taylor.FREE)
    s = series.make_series.py_func(1, 1, 6)
    d = series.make_tangents.py_func(1, 1, 6, directions)
    out = taylor.Samples(one, flat, one, cube, flat)
    samples = (out, 0, 0, 0.0, one)
    curves = (flat, one, cube, flat, flat)
    return _Calls(
        pieces=[
            (series.expand_tangents, (links, s, d, 0)),
            (polynomial.first_crossing, (one, 0, 0.0, 0.0, 0.0)),
            (taylor.sample, (links, s, 0, *samples)),
            (taylor.sample_tangents, (links, s, d, 0, *samples)),
            (taylor.depart, (links, s, d, 0, 0, 0.0, 0.0, one, one, one, out, 0)),
        ],
        rest=[
            (kernels.fill_rows, (whole, one, flat)),
            (kernels.equilibrium_along, (flat, one, one, one, flat, table)),
            (series.equilibrium_tangents, (flat, one, flat, table, True, directions)),
            (ringing.parts_faintly, (flat, one, 0.0)),
            (ringing.hurry_of, (flat, one, whole, one, 0.0, 0, 0.0, one)),
            (kernels.strains_along, (flat, one, flat, table)),
            (kernels.total, (one,)),
            (kernels.fault, (one,)),
        ],
        own=[
            (series.expand, (links, s, one, one, 0)),
            (series.make_tangents, (1, 1, 0, directions)),
            (taylor.begin, (flat, flat, 0.0, directions, whole, links, s, d)),
            (taylor.switch, (flat, whole, links, s, d, directions, 0, 0.0, 0.0, 0, 0, flat, 0)),
            (taylor.step_length, (links, s, one, 0, 0.0, 0.0, 0.0, 0.0)),
            (taylor.settle, (links, s)),
        ],
        whole=[
            (
                taylor.integrate,
                (
                    flat,
                    one,
                    whole,
                    one,
                    0.0,
                    0,
                    one,
                    0.0,
                    one,
                    0.0,
                    0,
                    0,
                    directions,
                    flat,
                    *curves,
                ),
            )
        ],
    )


def _compile(calls: list[Call]) -> None:
    from numba import typeof

    for function, arguments in calls:
        function.compile(tuple(typeof(value) for value in arguments))  # type: ignore[no-untyped-call]


def compiled() -> bool:
    """Tell whether an earlier run left the compiled integrator in the cache."""
    from foamfit.taylor import integrate

    return any(Path(integrate.stats.cache_path or ".").glob("taylor.integrate-*.nbc"))


@contextmanager
def side_by_side() -> Iterator[Callable[[], None]]:
    """Let another process compile while the body prepares; then call what is given for the rest.

    At the end all that a fit needs is in the cache. The other process is stopped if the body fails.
    """
    package = str(Path(__file__).parents[1])
    path = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
    with subprocess.Popen(
        [sys.executable, "-m", "foamfit.warmth"],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
    ) as other:

        def finish() -> None:
            calls = _calls()
            _compile(calls.own)
            if other.stdout is not None:
                other.stdout.readline()  # the pieces are there, or the other process has failed
            _compile(calls.whole)

        try:
            yield finish
        except BaseException:
            other.terminate()
            raise


def _other() -> None:
    gc.disable()  # what is made here stays
    calls = _calls()
    _compile(calls.pieces)
    print("pieces", flush=True)
    _compile(calls.rest)


if __name__ == "__main__":
    _other()
