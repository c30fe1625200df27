"""A `map` over the tests of a study, in several processes where there is enough to do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from foamfit.study.processes import PAGES, Processes, check_jobs, cores, prepare

# Modules that every process needs, and by which most of its start is gone: they are imported once.
_NEEDED = ("foamfit.study.joint", "foamfit.report.plots", *PAGES)


def begin(jobs: int | None, count: int, few: int) -> None:
    """Have imported what `workers` with these arguments will need, beside what goes on here."""
    if _wanted(jobs, count, few) > 1:
        prepare(_NEEDED)


def _wanted(jobs: int | None, count: int, few: int) -> int:
    """How many processes; one is this one."""
    check_jobs(jobs)
    return 1 if count <= few else min(cores() if jobs is None else jobs, count)


@contextmanager
def workers(jobs: int | None, count: int, few: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """Give a `map` over up to `count` pieces of work in `jobs` processes (None: one per core).

    With one job, or up to `few` pieces of work, it is the built-in one: to start a process takes
    some seconds.
    """
    wanted = _wanted(jobs, count, few)
    if wanted < 2:
        yield map
        return
    with Processes(wanted, _NEEDED) as pool:
        yield pool.map
