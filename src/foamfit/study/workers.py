"""A `map` over the tests of a study, in several processes where there is enough to do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from foamfit.errors import InputError
from foamfit.study.processes import Processes, cores

# Modules that every process needs.
_NEEDED = ("foamfit.study.joint",)


@contextmanager
def workers(jobs: int | None, count: int, few: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """Give a `map` over up to `count` pieces of work in `jobs` processes (None: one per core).

    With one job, or up to `few` pieces of work, it is the built-in one: to start a process takes
    some seconds.
    """
    if jobs is not None and (type(jobs) is not int or jobs < 1):
        raise InputError(f"jobs = {jobs!r} is not admissible; it must be a whole number from 1 up")
    wanted = min(cores() if jobs is None else jobs, count)
    if wanted < 2 or count <= few:
        yield map
        return
    pool = Processes(wanted, _NEEDED)
    try:
        yield pool.map
    except BaseException:
        pool.stop()
        raise
    pool.shutdown()
