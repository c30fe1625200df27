"""Compilation at first use, into numba's cache, before a fit begins.

Nothing depends on this module: a function missing from the cache is compiled, and announced, where
it is first needed. A second process compiles half of the solver.
"""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

from foamfit.errors import SimulationError
from foamfit.solve import cache

LOOPS = ("follow", "integrate")
SECOND = "from foamfit.solve.precompile import compile_half; compile_half(True)"
LONGEST = 300.0  # s that the second process may take


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


def compile_half(second: bool) -> None:
    """Compile rates of the state and explicit steps; the second: what passes events and writes."""
    from foamfit.solve.compiled import events, explicit, loop, motion, samples

    gc.disable()
    halves = (
        (motion.compute_rates, events.enter_branch, explicit.step),
        (loop.advance, samples.sample_task),
    )
    for one in halves[second]:
        one.compiled  # noqa: B018


@contextmanager
def _second_process() -> Iterator[None]:
    """Compile in a second process meanwhile, if the system allows one, and wait for its end."""
    process, none = None, subprocess.DEVNULL
    with suppress(OSError):
        command = [sys.executable, "-c", SECOND]
        process = subprocess.Popen(command, stdin=none, stdout=none, stderr=none)
    try:
        yield
        if process is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(LONGEST)
    finally:
        if process is not None:
            process.kill()
            process.wait()


def compile_solver(model: str = "bistable", announce: Callable[[], None] | None = None) -> None:
    """Announce and compile what a fit of a model needs, unless it is in the cache."""
    if all(map(cache.compiled, LOOPS)):
        return
    (announce or (lambda: cache.warn("the solver")))()
    model = model if model != "auto" else "bistable+microscale"
    cache.LOG.disabled = True  # it has been said that the solver is compiled
    gc.disable()  # a fifth of the time
    try:
        with _second_process():
            compile_half(False)
            run("follow", model)
        run("integrate", model)  # it needs what the second process has compiled
    finally:
        gc.enable()
        cache.LOG.disabled = False
