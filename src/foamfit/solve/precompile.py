"""Compilation at first use, into numba's cache, before a fit begins.

Nothing depends on this module: a function missing from the cache is compiled, and announced, where
it is first needed.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from foamfit.errors import SimulationError
from foamfit.solve import cache

LOOPS = ("follow", "integrate")


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


def compile_solver(model: str = "bistable", announce: Callable[[], None] | None = None) -> None:
    """Announce and compile what a fit of a model needs, unless it is in the cache."""
    if all(map(cache.compiled, LOOPS)):
        return
    (announce or (lambda: cache.warn("the solver")))()
    model = model if model != "auto" else "bistable+microscale"
    cache.LOG.disabled = True  # it has been said that the solver is compiled
    gc.disable()  # a fifth of the time
    try:
        for loop in LOOPS:
            run(loop, model)
    finally:
        gc.enable()
        cache.LOG.disabled = False
