"""Compilation at first use by two processes in parallel, into numba's cache.

One process would take twice as long. Nothing depends on this module: a loop missing from the cache
is compiled, and announced, where it is first needed.
"""

from __future__ import annotations

import functools
import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from foamfit.solve import cache
from foamfit.solve.cache import PACKAGE

_open: list[subprocess.Popen[bytes]] = []  # other processes that compile


def _scene(drive: str, count: int = 1, eta: float = 0.0) -> Callable[[], object]:
    """Return a run of a small chain over four samples, with a derivative, by explicit steps."""
    from foamfit.solve.plan import Plan, plan
    from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
    from foamfit.springs.laws import BistableSpring

    spring = BistableSpring(5e6, 8e7, -2e5, 0.14, 0.31, 1.4e7, 2.5e6, eta)
    chain, shape = Chain([spring] * count, [1e-3] * count, 2e-5), np.array([0.0, 1.0, 0.5, 0.0])
    drives: dict[str, Drive] = {
        "impact": Impact(7e-3, 2.0),
        "stress": StressDrive(1e6 * shape),
        "displacement": DisplacementDrive(1e-4 * shape),
    }
    scene = plan(chain, drives[drive], np.linspace(0.0, 1e-3, 4))
    assert isinstance(scene, Plan)
    run, directions = scene._replace(implicit=False).run, np.zeros((1, 2), np.int64)
    return functools.partial(run, *chain.arrays[:2], 1e-2, directions=directions)


def _calls() -> dict[Any, tuple[Any, ...]]:
    """Return the explicit integrator and its loops with argument types, from uncompiled runs."""
    from unittest.mock import patch

    from numba import typeof

    from foamfit.solve import plan, polynomial, scene
    from foamfit.solve.explicit import samples, series, tangents, taylor
    from foamfit.springs import equilibrium, kernels, microscale_kernels, sensitivities

    calls: dict[Any, tuple[Any, ...]] = {}

    def plain(loop: Any, direct: bool) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            if direct and loop not in calls:
                calls[loop] = tuple(map(typeof, arguments))
            return loop.py_func(*arguments)

        return call

    small = _scene("impact"), _scene("impact", eta=50.0), _scene("displacement", 2, eta=50.0)
    modules = (kernels, microscale_kernels, equilibrium, sensitivities, polynomial, scene, series)
    with ExitStack() as uncompiled, np.errstate(all="ignore"):
        for module in (*modules, tangents, samples, taylor, plan):
            names = {name: loop for name, loop in vars(module).items() if hasattr(loop, "py_func")}
            called = {}
            for name, loop in names.items():
                own = loop.targetoptions.get("inline") != "always"  # else part of its caller
                called[name] = plain(loop, own and module is taylor)
            uncompiled.enter_context(patch.dict(vars(module), called))
        for run in small:
            run()
    return calls


def _compile(calls: dict[Any, tuple[Any, ...]], cached: bool) -> None:
    """Compile the loops that have their own file in the cache, or those that do not."""
    for loop, types in calls.items():
        if (loop.stats.cache_path is not None) == cached:
            loop.compile(types)


def _memory(relaxed: bool) -> None:
    """Call the loops of a fit of springs with memory: `relaxed_along`, or all others."""
    from foamfit.solve import relaxation
    from foamfit.springs import microscale_kernels as micro
    from foamfit.springs.model import Model

    rows = Model(("microscale",), 1).rows(np.array([5e5, 2e5, 0.1, 1e5, 0.4, 5e4, 0.7, 0, 0.5, 1]))
    assert rows is not None
    row, at = rows[0], np.zeros(2)
    if relaxed:
        relaxation.relaxed_along(row, at, np.arange(2.0), 1e-6, False, np.zeros((2, 2)))
        return
    micro.stress_tangents_along(row, at, *micro.stress_along(row, at))
    micro.strain_along(row, at)


def _rest() -> None:
    """Call the other loops of a fit, last those that an impact on one spring does not need."""
    from foamfit.solve import rates, scene
    from foamfit.springs import kernels
    from foamfit.springs.model import Model

    Model(("linear",)).rows(np.ones(2))
    one, rows = np.ones(1), np.ones((1, kernels.N_COLUMNS))
    groups = np.ones(1, np.int64)
    rates.fastest_rates(rows, one, groups, one, 0.0, scene.FREE, True, 1.0)
    for run in (_scene("displacement"), _scene("displacement", 2), _scene("stress")):
        run()


@contextmanager
def at_first_use(
    model: str, relaxation: int, tell: Callable[[], None] | None = None
) -> Iterator[Callable[[], None]]:
    """Compile missing loops of a model's fit in parallel with the body of the `with` statement.

    The body must call the yielded function before it simulates. `tell` is called if anything has to
    be compiled. Without `tell` a message is logged, and loops already compiled in this process do
    not count as missing.
    """
    from foamfit.solve.explicit.taylor import integrate
    from foamfit.solve.relaxation import relaxed_along
    from foamfit.springs.laws import is_registered

    def is_new(loop: Any) -> bool:
        in_process = tell is None and getattr(loop, "signatures", True)  # True: numba is disabled
        return not (in_process or cache.compiled(loop.__name__))

    memory = model == "auto" or "microscale" in model or relaxation > 0
    integrator = (model == "auto" or not memory) and is_new(integrate)
    memory = memory and is_new(relaxed_along)
    registered = any(is_registered(kind.strip()) for kind in model.split("+"))  # has its own loops
    if _open or registered or not (integrator or memory):
        yield lambda: None
        return
    if tell is None:
        cache.warn("the solver")
    else:
        tell()
    with side_by_side(integrator, memory) as finish:
        yield functools.cache(finish)


@contextmanager
def side_by_side(integrator: bool = True, memory: bool = False) -> Iterator[Callable[[], None]]:
    """Compile in another process, in parallel with the body of the `with` statement.

    The body must call the yielded function before it simulates. At the end the cache contains all
    loops of a fit of springs without memory (`integrator`) or with memory (`memory`). If the body
    fails, the other process is stopped.
    """
    path = f"{PACKAGE.parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}".rstrip(os.pathsep)
    parts = [part for part, wanted in (("integrator", integrator), ("memory", memory)) if wanted]
    with subprocess.Popen(
        [sys.executable, "-m", "foamfit.solve.precompile", *parts],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
        process_group=0,  # Ctrl-C must reach only the process that starts this one
    ) as other:

        def finish() -> None:
            gc.disable()  # compiled objects live until exit
            if integrator:
                loop, *calls = _calls().items()
                _compile(dict(calls), cached=False)
                if other.stdout is not None:
                    other.stdout.readline()  # pieces are ready, or it failed
                _compile(dict([loop]), cached=True)
            else:
                _memory(relaxed=True)
            gc.enable()

        _open.append(other)
        try:
            yield finish
            other.wait()
        except BaseException:
            other.terminate()
            raise
        finally:
            _open.remove(other)


def _main(parts: list[str]) -> None:
    """Compile the loops that the parent process does not."""
    gc.disable()
    if "integrator" in parts:
        _, *pieces = _calls().items()
        _compile(dict(pieces), cached=True)
        print("pieces", flush=True)
        _rest()
    if "memory" in parts:
        _memory(relaxed=False)
        if "integrator" in parts:
            _memory(relaxed=True)


if __name__ == "__main__":
    _main(sys.argv[1:])
