"""First use: the solver is compiled beside the page, which says so."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import Future, ThreadPoolExecutor

from foamfit.page.worker import end_all, with_package
from foamfit.solve import cache
from foamfit.springs.model import Model

# Compiled one after the other, for springs without memory and with it: a model, its relaxation, and
# the loop that is cached last.
COMPILED = (("bistable", 0, "integrate"), ("microscale", 1, "relaxed_along"))
COMPILE = """from foamfit.solve.precompile import at_first_use
with at_first_use({!r}, {}, lambda: None) as compile_rest:
    compile_rest()"""


class FirstUse:
    """Compiles what curves and fits need, once after installation, in other processes.

    The page answers meanwhile.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        pool = ThreadPoolExecutor(1, thread_name_prefix="foamfit-compiling")
        self.parts = [pool.submit(self._compile, *part) for part in COMPILED]

    def needed(self, model: str, relaxation: int) -> Future[None]:
        """Return what must be done before a model is simulated."""
        memory = (
            model == "auto" or relaxation or any(one.remembers for one in Model.parse(model).laws)
        )
        return self.parts[-1 if memory else 0]

    def _compile(self, model: str, relaxation: int, loop: str) -> None:
        if self._closed or cache.compiled(loop):
            return
        command = [sys.executable, "-c", COMPILE.format(model, relaxation)]
        self._process = subprocess.Popen(command, env=with_package(), start_new_session=True)
        self._process.wait()

    def close(self) -> None:
        """End it."""
        self._closed = True
        if self._process is not None:
            end_all(self._process)
