"""First use: a fit calls exactly the loops that are compiled while a test is read."""

from __future__ import annotations

import logging
import os
import re
import subprocess
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner
from numba import types

import fabricated
import foamfit as ff
from conftest import EXPERIMENTS, synthetic_loop, without_pictures
from foamfit import api
from foamfit.cli import main
from foamfit.solve import cache, polynomial, precompile, rates, relaxation
from foamfit.solve.explicit import memory, taylor
from foamfit.springs import kernels, microscale_kernels, sensitivities
from foamfit.springs.laws import followed

RECONSTRUCTION = EXPERIMENTS / "foam-1" / "model-1-2.0mps-reconstruction.csv"


def keep_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the loops of this package report `folder` as their numba cache."""
    loop = SimpleNamespace(stats=SimpleNamespace(cache_path=str(folder)))
    for module, name in (
        (kernels, "fault"), (followed, "_begin"), (polynomial, "first_crossing"),
        (taylor, "integrate"), (rates, "fastest_rates"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, loop)


def is_other(kind: Any) -> bool:
    """Return whether an argument is a literal or belongs to springs with memory, compiled apart."""
    strided = getattr(kind, "layout", "C") == "A"  # a series of the memory
    return (
        strided
        or isinstance(kind, types.Literal)
        or getattr(kind, "instance_class", 0) is memory.Memory
    )


def test_a_fit_calls_what_was_compiled_and_nothing_else() -> None:
    """Every loop that a fit calls has a single signature, that of the small scenes."""
    precompile._rest()
    ff.fit(ff.read_test(RECONSTRUCTION), starts=2)
    assert taylor.integrate.signatures == [precompile._calls()[taylor.integrate]]
    for function in (
        kernels.fill_bistable, kernels.stress_along, kernels.fault, kernels.total,
        sensitivities.equilibrium_tangents, rates.fastest_rates,
    ):  # fmt: skip
        assert len(function.signatures) == 1, function.py_func.__name__


def test_a_fit_of_springs_with_memory_calls_what_was_compiled_and_nothing_else() -> None:
    for relaxed in (True, False):
        precompile._memory(relaxed)
    measurement = synthetic_loop()[1]
    timed = replace(measurement, time=np.linspace(0.0, 1.0, measurement.stress.size))
    ff.fit(timed, model="microscale", relaxation=1, starts=1, intervals="local")
    ff.fit(timed, model="microscale", starts=1, intervals="local")
    for function in (
        relaxation.relaxed_along,
        kernels.fill_microscale,
        microscale_kernels.stress_along,
        microscale_kernels.stress_tangents_along,
    ):
        assert len(function.signatures) == 1, function.py_func.__name__


def test_the_small_scenes_meet_every_loop_of_the_integrator() -> None:
    """Compiling the integrator must not compile a loop with other argument types.

    Other loops may also call `first_crossing` with an order known at compile time.
    """
    calls = precompile._calls()
    text = Path(taylor.__file__).read_text()
    body = text.split("def _integrated(")[1].split("def integrate(")[0]
    read = set(re.findall(r"\w+", body)) & set(vars(taylor))
    loops = {vars(taylor)[name] for name in read if hasattr(vars(taylor)[name], "py_func")}
    without = {loop for loop in loops if loop.__module__ != memory.__name__}
    with_memory = {taylor.settle_together}
    assert without - with_memory <= set(calls)
    for function, arguments in calls.items():
        made = [kinds for kinds in function.signatures if not any(map(is_other, kinds))]
        assert made in ([], [arguments]), function.py_func.__name__


def test_the_first_use_says_that_it_compiles(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    done = []

    @contextmanager
    def quickly(*_: bool) -> Any:
        yield lambda: done.append("rest")

    monkeypatch.setattr(precompile, "side_by_side", quickly)
    monkeypatch.setattr(api, "fit", lambda *_, **__: fabricated.result())
    without_pictures(monkeypatch)
    for ready in (False, True):
        monkeypatch.setattr(cache, "compiled", lambda *_, ready=ready: ready)
        told = CliRunner().invoke(main, ["fit", str(RECONSTRUCTION), "--out", str(tmp_path / "r")])
        assert ("compiling the solver" in told.stderr) == (not ready)
    assert done == ["rest"]


@pytest.mark.parametrize(
    ("model", "there", "asked"),
    [
        (["bistable"], (), [(True, False)]),
        (["microscale"], (), [(False, True)]),
        (["bistable", "--relaxation", "1"], ("integrate",), [(False, True)]),
        (["auto"], (), [(True, True)]),
        (["auto"], ("integrate",), [(False, True)]),
        (["auto"], ("integrate", "relaxed_along"), []),
    ],
)
def test_the_first_use_compiles_what_the_model_needs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: list[str], there: Any, asked: Any
) -> None:
    done = []

    @contextmanager
    def quickly(*parts: bool) -> Any:
        done.append(parts)
        yield lambda: None

    monkeypatch.setattr(precompile, "side_by_side", quickly)
    monkeypatch.setattr(cache, "compiled", lambda name="integrate": name in there)
    monkeypatch.setattr(api, "fit", lambda *_, **__: fabricated.result())
    without_pictures(monkeypatch)
    args = ["fit", str(RECONSTRUCTION), "--out", str(tmp_path / "r"), "--model", *model]
    assert CliRunner().invoke(main, args).exit_code == 0
    assert done == asked


def test_the_other_process_finds_this_package_and_is_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The process starts with this package in its path and is stopped if the body raises."""
    asked: list[Any] = []

    class Other(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, command: list[str], **options: Any) -> None:
            asked.append(options["env"]["PYTHONPATH"].split(":")[0])
            assert command[1:] == ["-m", "foamfit.solve.precompile", "integrator"]
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
    keep_in(tmp_path, monkeypatch)
    assert not cache.compiled()
    made = [tmp_path / f"taylor.integrate-30.py311.{end}" for end in ("nbi", "1.nbc")]
    for path in made:
        path.touch()
    assert cache.compiled()
    os.utime(made[1], (0.0, 0.0))
    assert not cache.compiled()
    assert [path.exists() for path in made] == [True, False]


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
    cache._first.cache_clear()
    for loop in (new, new, known, other):
        cache.announce(loop, "the solver of slow scenes")
    (tmp_path / "implicit.integrate_slowly-30.py311.1.nbc").touch()
    cache.announce(kept, "the solver of slow scenes")
    assert [record.getMessage() for record in caplog.records] == [
        "foamfit: compiling the solver of slow scenes, once after installation",
        "foamfit: compiling the solver of slow scenes",
    ]


def test_every_module_with_compiled_loops_is_known() -> None:
    written = {
        path.relative_to(cache.PACKAGE).parts[0]
        for path in cache.PACKAGE.rglob("*.py")
        if re.search(r"^@(compiled|inner|inlined|piece|maker|once)$", path.read_text(), re.M)
    }
    assert set(cache.FOLDERS) == written
