"""Compiled code of another source is removed before it is loaded.

Numba checks only the module of the outermost function, but the records and the inlined functions of
other modules are compiled into it: with an old layout it would write past the end of an array.
"""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

PACKAGE = Path(__file__).parents[2]
FOLDERS = ("springs", "solve")  # subfolders with compiled functions
SOLVER = PACKAGE / "solve" / "compiled"


def drop_stale(own: Path) -> None:
    """Remove files older than the source from the cache `own` of the laws and from the solver's."""
    times = [path.stat().st_mtime for name in FOLDERS for path in (PACKAGE / name).rglob("*.py")]
    written = max((at for at in times if at <= time.time()), default=0.0)  # a clock may be wrong
    solver = [SOLVER / own.name]
    if own.name != "__pycache__":  # the user has named a folder for all caches
        modules = {path.stem for path in SOLVER.glob("*.py")}
        known = own.parent.glob("compiled_*/*.nbi")
        solver = list({path.parent for path in known if path.name.partition(".")[0] in modules})
    for file in (path for cache in (own, *solver) for path in cache.glob("*.nb[ci]")):
        with suppress(OSError):  # no permission, or another process was faster
            if file.stat().st_mtime < written:
                file.unlink()
