"""Compilation at first use by two processes in parallel, into numba's cache.

Nothing depends on this module: a loop missing from the cache is compiled, and announced, where it
is first needed.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

from foamfit.errors import SimulationError
from foamfit.solve import cache

LOOPS = ("integrate", "follow")  # in the order of the processes
CALL = "from foamfit.solve.precompile import run; run({!r})"


def run(loop: str, model: str = "microscale") -> None:
    """Run a small scene, with a derivative, that compiles a loop and the laws of a model."""
    from foamfit.solve.plan import plan
    from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact
    from foamfit.springs.model import Model

    time = np.linspace(0.0, 1e-3, 4)
    drives: dict[str, Drive] = {
        "integrate": Impact(7e-3, 2.0),
        "follow": DisplacementDrive(1e-4 * np.array([0.0, 1.0, 0.5, 0.0])),
    }
    for law in dict.fromkeys(Model.parse(model).laws):
        chain = Chain([law.any_spring()], [1e-3], 2e-5)
        scene = plan(chain, drives[loop], time)
        with suppress(SimulationError):  # the parameters are arbitrary
            scene.run(*chain.arrays[:2], 1e-2, directions=np.zeros((1, 2), np.int64))


@contextmanager
def at_first_use(
    model: str = "bistable", relaxation: int = 0, announce: Callable[[], None] | None = None
) -> Iterator[Callable[[], None]]:
    """Compile at first use, in another process beside the body.

    The body calls the function that it receives before it simulates. `announce` is called first.
    """
    known = model if model != "auto" else "bistable+microscale"
    if all(map(cache.compiled, LOOPS)):
        yield lambda: None
        return
    (announce or (lambda: cache.warn("the solver")))()
    other = None
    if (os.cpu_count() or 1) > 1:
        path = (str(cache.PACKAGE.parent), os.environ.get("PYTHONPATH", ""))
        other = subprocess.Popen(
            [sys.executable, "-c", CALL.format(LOOPS[1])],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, path))},
            process_group=0,  # Ctrl-C must reach only the process that starts this one
        )
    done = False

    def finish() -> None:
        nonlocal done
        if done:
            return
        done = True
        gc.disable()  # a fifth of the time
        try:
            run(LOOPS[0], known)
        finally:
            gc.enable()
        if other is not None:
            other.wait()

    try:
        yield finish
    finally:
        if other is not None and other.poll() is None:
            other.terminate()
            other.wait()
