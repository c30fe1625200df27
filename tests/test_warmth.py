"""First use: what is compiled beside the reading of a test is what a fit then calls."""

from __future__ import annotations

import logging
import os
import re
import subprocess
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from numba import typeof, types

import foamfit as ff
from conftest import EXPERIMENTS
from foamfit import cli
from foamfit.solve import precompile
from foamfit.solve.explicit import series, taylor
from foamfit.springs import kernels

RECONSTRUCTION = EXPERIMENTS / "foam-1" / "model-1-2.0mps-reconstruction.csv"


def is_literal(kind: Any) -> bool:
    return isinstance(kind, types.Literal)


def signature(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(typeof(value) for value in arguments)


def test_a_fit_calls_what_was_compiled_and_nothing_else() -> None:
    """Every loop that a fit calls has one set of argument types, that of the example."""
    ff.fit(ff.read_test(RECONSTRUCTION), starts=2)
    calls = precompile._calls()
    of_python = {
        taylor.integrate, kernels.fill_rows, kernels.stress_along,
        series.equilibrium_tangents, kernels.fault, kernels.total,
    }  # fmt: skip
    examples = {function: signature(arguments) for function, arguments in calls.whole + calls.rest}
    assert of_python <= set(examples)
    for function in of_python:
        assert function.signatures == [examples[function]], function.py_func.__name__


def test_the_pieces_are_those_of_the_integrator() -> None:
    """Where the integrator itself was compiled, it left no piece in other types.

    Other loops may call `first_crossing` too, with an order that is known when they are compiled.
    """
    pieces = [(*call, "own") for call in precompile._calls().own]
    pieces += [(*call, "cached") for call in precompile._calls().pieces]
    for function, arguments, where in pieces:
        made = [kinds for kinds in function.signatures if not any(map(is_literal, kinds))]
        assert made in ([], [signature(arguments)]), function.py_func.__name__
        assert (function.stats.cache_path is not None) == (where == "cached")


def test_the_first_use_says_that_it_compiles(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done = []

    @contextmanager
    def quickly() -> Any:
        yield lambda: done.append("rest")

    monkeypatch.setattr(precompile, "side_by_side", quickly)
    for ready in (False, True):
        monkeypatch.setattr(precompile, "compiled", lambda ready=ready: ready)
        with cli._compiling(quiet=False) as compile_rest:
            compile_rest()
        assert ("compiling the solver" in capsys.readouterr().err) == (not ready)
    assert done == ["rest"]


def test_the_other_process_finds_this_package_and_is_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is asked for with this package in its path, and stopped where the body fails."""
    asked: list[Any] = []

    class Other(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, command: list[str], **options: Any) -> None:
            asked.append(options["env"]["PYTHONPATH"].split(":")[0])
            assert command[1:] == ["-m", "foamfit.solve.precompile"]
            super().__init__(["sleep", "60"], stdout=options["stdout"])

        def terminate(self) -> None:
            asked.append("terminated")
            super().terminate()

    monkeypatch.setattr(subprocess, "Popen", Other)
    with pytest.raises(click.UsageError), precompile.side_by_side():
        raise click.UsageError("no such file")
    assert asked == [str(Path(ff.__file__).parents[1]), "terminated"]


def test_what_was_compiled_of_another_source_is_no_use(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(precompile, "_caches", lambda: {tmp_path})
    assert not precompile.compiled()
    made = [tmp_path / f"taylor.integrate-30.py311.{end}" for end in ("nbi", "1.nbc")]
    for path in made:
        path.touch()
    assert precompile.compiled()
    os.utime(made[1], (0.0, 0.0))
    assert not precompile.compiled()
    assert [path.exists() for path in made] == [True, False]


def test_what_is_compiled_where_it_is_needed_is_announced_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Loop:
        __name__ = "integrate_slowly"
        signatures: tuple[object, ...] = ()

    monkeypatch.setattr(precompile, "_caches", lambda: {tmp_path})
    caplog.set_level(logging.WARNING, logger="foamfit")  # a quiet command may have silenced it
    new, known, kept = Loop(), Loop(), Loop()
    known.signatures = ((),)
    for loop in (new, new, known):
        precompile.announce(loop, "the solver of slow scenes")
    (tmp_path / "implicit.integrate_slowly-30.py311.1.nbc").touch()
    precompile.announce(kept, "the solver of slow scenes")
    assert [record.getMessage() for record in caplog.records] == [
        "foamfit: compiling the solver of slow scenes, once after installation"
    ]


def test_every_module_with_compiled_loops_is_known() -> None:
    written = {
        path.relative_to(precompile.PACKAGE).with_suffix("").as_posix()
        for path in precompile.PACKAGE.rglob("*.py")
        if re.search(r"^@(compiled|inner|inlined|piece|maker|once)$", path.read_text(), re.M)
    }
    assert set(precompile.COMPILED) == written | {"springs/law"}


def test_examples_are_small() -> None:
    for call in precompile._calls().rest:
        assert all(np.size(value) <= 1 for value in call[1])
