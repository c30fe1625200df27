"""Functions that exist only inside other compiled functions.

By default numba optimises each function and makes machine code of it, and of all that it calls,
before it does so again for the function that calls it. For functions that Python never calls that
is wasted, and with it a third of the time of compilation.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class _Part(JITCodeLibrary):  # type: ignore[misc]
    """Code that waits to be linked into that of its callers: as it was written, without address."""

    @property
    def codegen(self) -> Any:
        """What gives a function its environment, which only Python would need: nothing here."""
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Give no environment."""

    def get_pointer_to_function(self, name: str) -> int:
        """Return no address."""
        self._ensure_finalized()
        return 0

    def _optimize_functions(self, module: object) -> None:
        pass

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class PartCompiler(Compiler):  # type: ignore[misc]
    """Compile functions of which no machine code is made but within others."""

    def define_pipelines(self) -> Any:
        """Return the usual passes, which add to code of the kind above."""
        state = self.state
        state.library = _Part(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()
