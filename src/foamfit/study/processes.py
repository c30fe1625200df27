"""An executor of processes on this machine that survives the end of one of them.

`concurrent.futures.ProcessPoolExecutor` cancels all calls when one of its processes ends. Here each
process has its own pool, so that only the interrupted call is lost.
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
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from functools import partial
from multiprocessing import connection
from types import ModuleType
from typing import Any

from foamfit.terminal import without_ctrl_c

# Modules that are imported by fits and by their pages.
FITS = ("foamfit.study.batch", "foamfit.data.csv_file", "pandas", "pint")
PAGES = ("matplotlib.backends.backend_agg", "matplotlib.backends.backend_pdf", "jinja2")
_STARTING, _SCRIPT = threading.Lock(), ModuleType("__main__")


class EndedError(RuntimeError):
    """The process of a call ended before the call was done."""


def cores() -> int:
    """Return the number of cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def context_of(preload: Iterable[str]) -> Any:
    """Return the context of multiprocessing whose processes start fastest.

    They are forked from a server that imports the modules `preload` and ignores Ctrl-C; where there
    is none, as on Windows, every process imports them itself.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    from multiprocessing import forkserver  # not on Windows

    with _starting(), without_ctrl_c():  # Ctrl-C must not end the server in its imports
        forkserver.set_forkserver_preload(list(preload))
        forkserver.ensure_running()
    return multiprocessing.get_context("forkserver")


class Processes(ThreadPoolExecutor):
    """An executor with `count` processes, which end with their parent process.

    A call whose process ends raises `EndedError`; other calls are not affected. Functions must be
    defined in modules. The running script is not imported again and needs no guard. For `preload`
    see `context_of`.
    """

    def __init__(self, count: int, preload: Iterable[str] = ()) -> None:
        super().__init__(count, thread_name_prefix="foamfit")
        self._context = context_of(preload)
        self._pools = dict[int, ProcessPoolExecutor]()  # by the thread that uses it
        self._stop, self._stopping = self._context.Pipe(duplex=False)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Schedule the call of a function in one of the processes."""
        return super().submit(self._call, partial(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes after their current calls."""
        super().shutdown(wait, cancel_futures=cancel_futures)
        for pool in list(self._pools.values()):
            pool.shutdown(wait)
        self._stopping.close()
        self._stop.close()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the processes, at once after an exception."""
        if kind is not None:
            self._stopping.close()
        self.shutdown(cancel_futures=kind is not None)

    def _call(self, work: Callable[[], Any]) -> Any:
        """Run a call in the process of the current thread."""
        from foamfit.springs import laws

        thread = threading.get_ident()
        new = thread not in self._pools
        if new:
            given = self._stop, laws.texts()
            self._pools[thread] = ProcessPoolExecutor(1, self._context, _begin, given)
        try:
            with _starting() if new else nullcontext():
                future = self._pools[thread].submit(work)
            return future.result()
        except BrokenProcessPool:
            self._pools.pop(thread).shutdown()
            raise EndedError("its process ended before it was done") from None


@contextmanager
def _starting() -> Iterator[None]:
    """Keep processes started in the body from importing the running script."""
    with _STARTING:
        script, sys.modules["__main__"] = sys.modules["__main__"], _SCRIPT
        try:
            yield
        finally:
            sys.modules["__main__"] = script


def _begin(stop: connection.Connection, law_files: Mapping[str, str]) -> None:
    """Prepare a new process: it ignores Ctrl-C and ends with its parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # imported objects live until exit
    gc.set_threshold(100_000, 20, 10)
    logging.getLogger("foamfit").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")  # the same warnings of NumPy would appear for each test
    threading.Thread(target=_end_with, args=(stop,), daemon=True).start()
    if law_files:
        from foamfit.springs import laws

        laws.load_texts(law_files)


def _end_with(stop: connection.Connection) -> None:
    """End this process at once when the pipe is closed or the parent process has ended."""
    parent = multiprocessing.parent_process()
    connection.wait([stop, *([] if parent is None else [parent.sentinel])])
    os._exit(1)
