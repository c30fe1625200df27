"""First use: what is compiled is made by two processes side by side, and kept in the cache.

Compiling in one process takes twice as long. Nothing else depends on it: what is not in the cache
is compiled where it is first needed, and said so.
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

_open: list[subprocess.Popen[bytes]] = []  # processes that compile beside this one


def _scene(drive: str, count: int = 1, eta: float = 0.0) -> Callable[[], object]:
    """Prepare a few samples of a small chain, and a derivative, by explicit steps."""
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
    """The explicit integrator and its loops with their argument types, seen in uncompiled runs."""
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
                own = loop.targetoptions.get("inline") != "always"  # else a part of another
                called[name] = plain(loop, own and module is taylor)
            uncompiled.enter_context(patch.dict(vars(module), called))
        for run in small:
            run()
    return calls


def _compile(calls: dict[Any, tuple[Any, ...]], cached: bool) -> None:
    """Compile the loops that have, or have not, a file of their own in the cache."""
    for loop, types in calls.items():
        if (loop.stats.cache_path is not None) == cached:
            loop.compile(types)


def _memory(relaxed: bool) -> None:
    """Call what a fit of springs with memory needs: the `relaxed` law, or all but that."""
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
    """Call what else a fit calls; last what an impact on one spring does not need."""
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
    """Compile beside the body what the fit of a model needs and is not in the cache.

    The body calls what is given before it simulates; `tell` is called if there is anything to do.
    Without `tell` the log says so, and loops that this process has compiled count as done.
    """
    from foamfit.solve.explicit.taylor import integrate
    from foamfit.solve.relaxation import relaxed_along
    from foamfit.springs.laws import is_registered

    def is_new(loop: Any) -> bool:
        known = tell is None and getattr(loop, "signatures", True)  # True: numba is switched off
        return not (known or cache.compiled(loop.__name__))

    memory = model == "auto" or "microscale" in model or relaxation > 0
    integrator = (model == "auto" or not memory) and is_new(integrate)
    memory = memory and is_new(relaxed_along)
    registered = any(
        is_registered(kind.strip()) for kind in model.split("+")
    )  # has loops of its own
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
    """Let another process compile beside the body, which calls what is given before it simulates.

    At the end all that a fit needs is in the cache: with `integrator` of springs without memory,
    with `memory` of others. The other process is stopped if the body fails.
    """
    path = f"{PACKAGE.parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}".rstrip(os.pathsep)
    parts = [part for part, asked in (("integrator", integrator), ("memory", memory)) if asked]
    with subprocess.Popen(
        [sys.executable, "-m", "foamfit.solve.precompile", *parts],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
        process_group=0,  # Ctrl-C is for the process that starts this one
    ) as other:

        def finish() -> None:
            gc.disable()  # what compiling makes stays
            if integrator:
                loop, *calls = _calls().items()
                _compile(dict(calls), cached=False)
                if other.stdout is not None:
                    other.stdout.readline()  # the pieces are there, or the other process has failed
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
    """Compile what the process that starts this one does not."""
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
