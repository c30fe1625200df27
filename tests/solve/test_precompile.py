"""First use: a fit calls exactly the loops that are compiled while a test is read."""

import json
import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from numba.core.caching import _CacheLocator

import fabricated
import foamfit as ff
from conftest import RECONSTRUCTION, run, without_pictures
from foamfit import api
from foamfit.solve import cache, precompile
from foamfit.solve.compiled import loop
from foamfit.springs.compiled import bistable, contract

# Reads a test, compiles for a model, fits, and prints what the fit compiled
# or read from the cache besides.
FIT = """
import json
import sys
from dataclasses import replace

import numpy as np
from numba.core.dispatcher import Dispatcher

import foamfit as ff
from conftest import synthetic_loop
from foamfit.solve import precompile
from foamfit.springs.compiled.contract import Pointed


def compiled():
    found = set()
    modules = [module for name, module in sys.modules.items() if name.startswith("foamfit")]
    for value in [value for module in modules for value in vars(module).values()]:
        if isinstance(value, Dispatcher):
            name = f"{value.py_func.__module__}.{value.py_func.__name__}"
            found |= {f"{name} {signature}" for signature in value.signatures}
        elif isinstance(value, Pointed) and "compiled" in vars(value):
            found.add(f"{value.function.__module__}.{value.function.__name__}")
    return found


path, model = sys.argv[1:]
test = ff.read_test(path) if path else synthetic_loop()[1]
for loop in precompile.LOOPS:
    precompile.run(loop, model)
before = compiled()
if path:
    ff.fit(test, model=model, starts=2)
else:
    timed = replace(test, time=np.linspace(0.0, 1.0, test.stress.size))
    for relaxation in (1, 0):
        ff.fit(timed, model=model, relaxation=relaxation, starts=1, intervals="local")
print(json.dumps([len(before), sorted(compiled() - before)]))
"""


def keep_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the loops of this package report `folder` as their numba cache."""
    stored = SimpleNamespace(stats=SimpleNamespace(cache_path=str(folder)))
    monkeypatch.setattr(loop, "integrate", stored)
    monkeypatch.setattr(bistable, "fill", stored)


@pytest.mark.parametrize(("path", "model"), [(str(RECONSTRUCTION), "bistable"), ("", "microscale")])
def test_a_fit_calls_what_was_compiled_and_nothing_else(path: str, model: str) -> None:
    """Neither a function nor a signature of one is new."""
    done = subprocess.run(
        [sys.executable, "-c", FIT, path, model],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    known, new = json.loads(done.stdout.splitlines()[-1])
    assert known > 10
    assert new == []


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return what was run, in order, with an empty cache."""
    done: list[Any] = []
    monkeypatch.setattr(precompile, "run", lambda *given: done.append(given))
    monkeypatch.setattr(cache, "compiled", lambda *_: False)
    return done


def test_the_first_use_says_that_it_compiles(
    asked: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(api, "fit", lambda *_, **__: fabricated.result())
    without_pictures(monkeypatch)
    for ready in (False, True):
        monkeypatch.setattr(cache, "compiled", lambda *_, ready=ready: ready)
        out = str(tmp_path / f"{ready}")
        told = run("fit", RECONSTRUCTION, "--out", out)
        assert ("compiling the solver" in told.stderr) == (not ready)
    assert asked == [("follow", "bistable"), ("integrate", "bistable")]


def test_a_spring_does_not_load_what_was_compiled_of_another_source(tmp_path: Path) -> None:
    """Once, the strain of a spring ran code of an older layout before any check."""
    ff.LinearSpring(1e6).strain([0.0, 1e5])  # compiles what an empty cache lacks
    for module, stored in ((bistable, bistable.fill), (loop, loop.integrate)):
        folder = tmp_path / _CacheLocator.get_suitable_cache_subpath(module.__file__)
        folder.mkdir()
        for path in Path(stored.stats.cache_path).glob("*.nb[ci]"):
            shutil.copy2(path, folder)
    files = [*tmp_path.rglob("bistable.strain-*"), *tmp_path.rglob("samples.sample_task-*")]
    assert len({path.parent for path in files}) == 2
    for path in files:
        path.write_bytes(b"of another source")
        os.utime(path, (0.0, 0.0))
    code = "import foamfit as ff; s = ff.LinearSpring(1e6); print(float(s.strain([0, 1e5])[1]))"
    given = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", code]
    told = subprocess.run(command, env=given, capture_output=True, text=True, check=True)
    assert told.stdout == "0.1\n"
    assert all(path.stat().st_mtime > 0.0 for path in tmp_path.rglob("*.nb[ci]"))
    assert {path.parent for path in tmp_path.rglob("*.nbi")} == {path.parent for path in files}


def test_what_is_compiled_where_it_is_needed_is_announced_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Loop:
        __name__ = "integrate_slowly"
        signatures: tuple[object, ...] = ()

    keep_in(tmp_path, monkeypatch)
    caplog.set_level(logging.WARNING, logger="foamfit")  # an earlier --quiet may have raised it
    new, known, kept, other = Loop(), Loop(), Loop(), Loop()
    known.signatures = ((),)
    monkeypatch.setattr(cache, "_ONCE", iter([", once after installation"]))
    for one in (new, new, known, other):
        cache.announce(one, "the solver of slow scenes")
    (tmp_path / "implicit.integrate_slowly-30.py311.1.nbc").touch()
    cache.announce(kept, "the solver of slow scenes")
    assert [record.getMessage() for record in caplog.records] == [
        "foamfit: compiling the solver of slow scenes, once after installation",
        "foamfit: compiling the solver of slow scenes",
    ]


def test_every_module_with_compiled_loops_is_known() -> None:
    """Modules outside `FOLDERS` do not compile; the folders of all caches are watched."""
    written = {
        path.relative_to(contract.PACKAGE)
        for path in contract.PACKAGE.rglob("*.py")
        if re.search(r"\b(njit|cfunc)\b|^@(inner|inlined|outer|pointed)\b", path.read_text(), re.M)
    }
    assert set(contract.FOLDERS) == {path.parts[0] for path in written}
    stored = {contract.PACKAGE / path.parent / "__pycache__" for path in written}
    if not os.environ.get("NUMBA_CACHE_DIR"):
        assert cache._caches() == stored
