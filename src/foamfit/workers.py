"""Processes that share the work of a study: one thread each, the compiled solver shared."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from foamfit.errors import InputError

# Variables that hold the threads of numerical libraries down.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextmanager
def workers(jobs: int | None, count: int, few: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """Give a `map` over up to `count` pieces of work in `jobs` processes (None: one per core).

    With one job, or up to `few` pieces of work, it is the built-in one: to start a process takes
    some seconds.
    """
    if jobs is not None and (not isinstance(jobs, int) or jobs < 1):
        raise InputError(f"jobs = {jobs!r} is not admissible; it must be a whole number from 1 up")
    wanted = min(jobs or len(_cores()), count)
    if wanted < 2 or count <= few:
        yield map
        return
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ |= dict.fromkeys(_THREADS, "1")  # of the processes, which begin with it
    pool = ProcessPoolExecutor(wanted, multiprocessing.get_context("spawn"))
    try:
        yield pool.map
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _cores() -> set[int]:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return os.sched_getaffinity(0)
    return set(range(os.cpu_count() or 1))
