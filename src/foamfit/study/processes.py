"""Processes of this machine that work one call at a time each: an executor.

`concurrent.futures.ProcessPoolExecutor` gives up everything when one of its processes ends. Here
each process has a pool of its own: the call it was at is known, and only that one is tried again.
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures import ThreadPoolExecutor as Threads
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from functools import partial
from multiprocessing import connection
from numbers import Integral
from types import ModuleType
from typing import Any

from foamfit.errors import InputError
from foamfit.terminal import without_ctrl_c

# What fits and their pages import.
FITS = ("foamfit.study.batch_work", "foamfit.data.csv_file", "pandas", "pint")
PAGES = ("matplotlib.backends.backend_agg", "matplotlib.backends.backend_pdf", "jinja2")
DRAWING = ("foamfit.report.result_figures", "foamfit.springs.kernels", *PAGES)
# How often a call is tried if its process ends.
ATTEMPTS = 2
# One thread in each process: the processes are as many as the cores.
ONE_THREAD = {
    f"{name}_NUM_THREADS": "1"
    for name in ("OMP", "OPENBLAS", "MKL", "NUMBA", "NUMEXPR", "VECLIB", "BLIS")
}
# What the processes of a joint fit import.
_JOINT = ("foamfit.study.joint", "foamfit.report.plots", *PAGES)
_STARTING, _SCRIPT = threading.Lock(), ModuleType("__main__")


class EndedError(RuntimeError):
    """The process of a call has ended each time that it was tried."""


def cores() -> int:
    """Count the cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def check_jobs(jobs: int | None) -> None:
    """Refuse a number of processes that is none."""
    if jobs is not None and (not isinstance(jobs, Integral) or jobs < 1):
        raise InputError(f"jobs = {jobs!r} is not admissible; it must be a whole number from 1 up")


def prepare(preload: Iterable[str]) -> None:
    """Import modules, while this process goes on, in the one from which others are forked.

    Where the system has no such process, nothing is done.
    """
    if "forkserver" in multiprocessing.get_all_start_methods():
        from multiprocessing import forkserver

        with _starting(), without_ctrl_c():  # which is for this process, while they import too
            forkserver.set_forkserver_preload(list(preload))
            forkserver.ensure_running()


class Processes(Executor):
    """So many processes with one thread each, which end with the one that started them.

    A call whose process ends is tried again in another one, `ATTEMPTS` times in all, and then
    raises `EndedError`; the calls of other processes go on. The functions must be those of modules;
    the script that is running is not imported again, so it needs no guard. For `preload` see
    `prepare`.
    """

    def __init__(self, count: int, preload: tuple[str, ...] = ()) -> None:
        methods = multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context(
            "forkserver" if "forkserver" in methods else "spawn"
        )
        prepare(preload)
        self._threads = Threads(count, thread_name_prefix="foamfit")
        self._pools = dict[int, ProcessPoolExecutor]()  # by the thread that has it
        self._stop, self._stopping = self._context.Pipe(duplex=False)
        self._stopped = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Have a function called in one of the processes."""
        return self._threads.submit(self._call, partial(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the calls end that are under way, and the processes then."""
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        for pool in list(self._pools.values()):
            pool.shutdown(wait)
        self._stopping.close()
        self._stop.close()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the processes; at once if anything went wrong."""
        self.shutdown() if kind is None else self.stop()

    def stop(self) -> None:
        """End the processes at once, whatever they are at."""
        self._stopped = True
        self._stopping.close()
        self.shutdown(cancel_futures=True)

    def _call(self, work: Callable[[], Any]) -> Any:
        """Call in the process of this thread; run by one of the threads."""
        from foamfit.springs import laws

        thread = threading.get_ident()
        for _ in range(ATTEMPTS):
            if self._stopped:
                break
            new = thread not in self._pools
            if new:
                given = self._stop, laws.texts()
                self._pools[thread] = ProcessPoolExecutor(1, self._context, _begin, given)
            try:
                with _starting() if new else nullcontext():
                    begun = self._pools[thread].submit(work)
                return begun.result()
            except BrokenProcessPool:
                self._pools.pop(thread).shutdown()
        if self._stopped:
            raise CancelledError
        raise EndedError(f"its process ended {ATTEMPTS} times before it was done")


def begin(jobs: int | None, count: int, few: int) -> None:
    """Import what `workers` with these arguments will need, while this process goes on."""
    if _wanted(jobs, count, few) > 1:
        prepare(_JOINT)


def _wanted(jobs: int | None, count: int, few: int) -> int:
    check_jobs(jobs)
    return 1 if count <= few else min(cores() if jobs is None else jobs, count)


@contextmanager
def workers(jobs: int | None, count: int, few: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """Give a `map` over up to `count` pieces of work in `jobs` processes (None: one per core).

    With one job, or up to `few` pieces of work, it is the built-in one: to start a process takes
    some seconds.
    """
    if (wanted := _wanted(jobs, count, few)) < 2:
        yield map
        return
    with Processes(wanted, _JOINT) as pool:
        yield pool.map


@contextmanager
def _starting() -> Iterator[None]:
    """Start a process with one thread that does not import the running script again."""
    with _STARTING:
        script, before = sys.modules["__main__"], {n: os.environ.get(n) for n in ONE_THREAD}
        sys.modules["__main__"] = _SCRIPT
        os.environ.update(ONE_THREAD)
        try:
            yield
        finally:
            sys.modules["__main__"] = script
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _begin(stop: connection.Connection, law_files: Mapping[str, str]) -> None:
    """Prepare a process: it ignores Ctrl-C and ends with the process that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # what the imports have made stays
    gc.set_threshold(100_000, 20, 10)
    logging.getLogger("foamfit").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")  # NumPy's would come once for each test
    threading.Thread(target=_end_with, args=(stop,), daemon=True).start()
    if law_files:
        from foamfit.springs import laws

        laws.load_texts(law_files)


def _end_with(stop: connection.Connection) -> None:
    """End this process at once when it is told to, or when the one that started it has ended."""
    parent = multiprocessing.parent_process()
    connection.wait([stop, *([] if parent is None else [parent.sentinel])])
    os._exit(1)
