"""Exact output of the commands: one file for each case in tests/golden.

    FOAMFIT_RENEW_GOLDEN=1 pytest tests/report/test_golden.py

rewrites the files; check the changes with `git diff tests/golden` before committing them.
The results are fabricated, so that no number depends on a search or on the machine.
"""

import os
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import pytest

import fabricated
from conftest import ROOT, run
from foamfit.data.measurement import Dropped, RowCount
from foamfit.parts import Ladder, Rung
from foamfit.report.comparison import compare, comparison_text
from foamfit.report.summary import summary_text
from foamfit.results import Check, Fit

GOLDEN = Path(__file__).parents[1] / "golden"
RENEW = "FOAMFIT_RENEW_GOLDEN"
TEST = "experiments/foam-1/model-1-1.75mps-reconstruction.csv"


def printed(*args: object) -> str:
    done = run(*args)
    return done.stdout


def with_rows(result: Fit) -> Fit:
    dropped = (
        Dropped(50, 5, 54, "before contact starts"),
        Dropped(49, 556, 604, "after contact ends"),
    )
    count = RowCount(700, 601, dropped)
    return replace(result, measurement=replace(result.measurement, count=count))


def one_spring() -> Fit:
    weak = "Not determined: s1_kh_minus (branch e was never reached)."
    floor = "The residuals of stress-time are 1.6 times the stated noise."
    return with_rows(
        fabricated.result(
            warnings=(floor, weak),
            checklist=(
                Check("followed", "Does the model follow the curves?", True, "1.2 % and 0.4 %."),
                Check(
                    "noise",
                    "Are the residuals at the noise level?",
                    False,
                    "1.60 and 1.02.",
                    (floor,),
                ),
                Check("determined", "Are all parameters determined?", False, "5 of 7.", (weak,)),
            ),
            notes=("Noise of stress 30 kPa, given.",),
        )
    )


def two_bistable() -> Fit:
    """Return a fit with 16 varied law parameters, 14 of them determined, and 2 of the record."""
    one = fabricated.result()
    made = {
        f"s{i}_{name}": fabricated.estimate(f"s{i}_{name}", getattr(fabricated.SPRING, name) or 9.0)
        for i in (1, 2)
        for name in (*fabricated.SPRING.law.own, "eta")
    }
    for name in ("s1_kh_minus", "s2_kc"):
        made[name] = replace(made[name], state="weak", why="its interval is wide")
    made["contact_time"] = fabricated.estimate("contact_time", 3e-6, unit="s")
    made["displacement_zero"] = fabricated.estimate("displacement_zero", 2e-6, unit="m")
    warnings = tuple(f"The residuals of curve {i} are systematic." for i in (1, 2, 3))
    return with_rows(
        replace(one, model="bistable+bistable", parameters=made, warnings=warnings, switches=())
    )


def failed() -> Fit:
    warnings = tuple(
        f"The misfit of {name} is not acceptable: the model goes its own way, and what it gives "
        "for the parameters is no property of the foam."
        for name in ("stress_time", "displacement_time", "stress_strain")
    )
    misfit = {"stress_time": 1.384, "displacement_time": 0.221, "stress_strain": 12.2}
    return with_rows(
        fabricated.result(status="failed", misfit=misfit, warnings=warnings, stopped="Ctrl-C")
    )


def auto() -> Fit:
    def rung(model: str, damping: str, chisqr: float, bic: float, why: str) -> Rung:
        misfit = {"stress_time": 0.012, "displacement_time": 0.004, "stress_strain": 0.02}
        return Rung(
            model=model, damping=damping, misfit=misfit, chisqr=chisqr, n_vary=8, rank=7,
            n_eff=986.4, aicc=bic - 40.0, bic=bic, runs_p=0.43, neighbours_p=2e-9,
            not_determined=("s1_kc",), weak=(), seconds=12.3, stopped=None,
            chosen=why.startswith("its"), why=why,
        )  # fmt: skip

    rungs = (
        rung("bistable", "without", 1738.2, -301.2, "BIC +12.0, AICc +14.0"),
        rung("linear+bistable", "none", 979.9, -313.2, "its residuals are random"),
    )
    ladder = Ladder(
        rungs=rungs, n_eff=986.4, noise_from="linear+bistable", ended="the test is told",
        stopped=None, skipped=("bistable+bistable needs heights",),
        sentences=("linear+bistable was chosen of 2 models.",), cautions=(),
    )  # fmt: skip
    return with_rows(replace(fabricated.chain_result(), ladder=ladder))


CASES: dict[str, Callable[[], str]] = {
    "published": lambda: printed("published"),
    "check": lambda: printed("check", TEST),
    "fit_one_spring": lambda: summary_text(one_spring()),
    "fit_one_spring_verbose": lambda: summary_text(one_spring(), verbose=True),
    "fit_two_springs": lambda: summary_text(with_rows(fabricated.chain_result())),
    "fit_two_bistable": lambda: summary_text(two_bistable()),
    "fit_microscale": lambda: summary_text(with_rows(fabricated.microscale_result())),
    "fit_failed": lambda: summary_text(failed()),
    "fit_auto": lambda: summary_text(auto()),
    "fit_auto_verbose": lambda: summary_text(auto(), verbose=True),
    "compare_published": lambda: comparison_text(compare([one_spring()], "foam-1/model-1")),
    "compare_microscale": lambda: comparison_text(
        compare([fabricated.microscale_result(), fabricated.microscale_result(relaxation=0)])
    ),
    "compare_fits": lambda: comparison_text(compare([one_spring(), failed()])),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_printed_is_the_golden_file(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    text, path = CASES[name]().rstrip("\n") + "\n", GOLDEN / f"{name}.txt"
    if os.environ.get(RENEW):
        path.write_text(text, encoding="utf-8")
    expected = path.read_text(encoding="utf-8").splitlines()
    for i, (was, now) in enumerate(zip_longest(expected, text.splitlines()), start=1):
        assert now == was, f"line {i} of {path.name} differs; {RENEW}=1 writes the files anew"


@pytest.mark.parametrize("name", CASES)
def test_what_is_printed_is_narrow_and_a_fit_is_one_screen(name: str) -> None:
    lines = (GOLDEN / f"{name}.txt").read_text(encoding="utf-8").splitlines()
    screen = name.startswith("fit_") and not name.endswith("_verbose")
    assert max(map(len, lines)) <= (80 if screen else 100)
    assert len(lines) <= 22 or not screen  # the real command adds two lines on the result folder
    assert not re.search(r"\de\+\d", "".join(lines))


def test_a_parameter_that_others_give_is_not_called_fixed() -> None:
    made, tied = fabricated.chain_result(), {"state": "fixed", "why": "tied by 0.0119 - s1_height"}
    made.parameters["s2_height"] = fabricated.estimate("s2_height", 6.86e-3, **tied)
    assert "fixed: s2_eta 0 Pa·s; tied: s2_height 6.860 mm\n" in summary_text(made)
