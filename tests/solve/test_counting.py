"""A scene costs no work that it does not need, shown by counting without compilation.

`counted.py` runs the scenes in a separate process, where the compiled loops are plain Python. It
counts reads of each spring and mass, arithmetic with each dashpot, and function calls. It leaves
out `steps`, `control` and `rates` where they only choose the step.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from conftest import synthetic_impact
from foamfit.fitting.problem import make_params
from foamfit.one_model import Options, identify, judge
from foamfit.solve.plan import CLOSED_FORM, SECOND_ORDER, Plan
from foamfit.trust.intervals import Choice

HERE = Path(__file__).parents[1]  # the folder of counted.py
DRIVES = ("impact", "stress", "displacement")
CLOSED = [
    f"{chain}, {drive}"
    for chain in ("linear", "mixed", "bistable")
    for drive in ("stress", "displacement")
]


@pytest.fixture(scope="module")
def counted() -> dict[str, dict[str, dict[str, Any]]]:
    """Return all counts of counted.py."""
    done = subprocess.run(
        [sys.executable, str(HERE / "counted.py")],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def counts(counted: dict[str, dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return the counts of each scene."""
    return counted["scenes"]


def total(
    scene: dict[str, Any], start: str, without: tuple[str, ...] = ("steps", "control", "rates")
) -> int:
    """Return the sum of the counts whose names start with `start`."""
    return sum(
        value
        for name, value in scene.items()
        if name.startswith(start) and not name.endswith(without)
    )


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("chain", ["linear", "mixed"])
def test_a_linear_spring_costs_no_evaluation_of_the_law(
    counts: dict[str, dict[str, Any]], chain: str, drive: str
) -> None:
    scene = counts[f"{chain}, {drive}"]
    assert total(scene, "linear: law columns read") == 0
    assert total(scene, "linear: law evaluated") == 0
    assert total(scene, "linear: other columns read") > 0  # the counter sees the linear spring
    # choosing the method reads every spring once per run, whatever its kind
    assert scene.get("linear: law columns read in rates", 0) <= 4 * scene["ends"][-1]
    law = total(scene, "bistable: law columns read")
    assert law > 0 if chain == "mixed" else law == 0


def test_a_massless_node_has_no_state(counts: dict[str, dict[str, Any]]) -> None:
    scenes = [counts[f"mixed, impact{masses}"] for masses in ("", ", one mass", ", two masses")]
    assert [scene["nodes with a state"] for scene in scenes] == [1, 2, 3]
    assert [scene["ends"] for scene in scenes] == [[3], [1, 3], [1, 2, 3]]
    # per step of the same order, each node that has a state costs the same reads of its mass
    per_step = [scene["masses read"] / scene["steps"] for scene in scenes]
    assert per_step[1] / per_step[0] == pytest.approx(2.0, rel=0.35)
    assert per_step[2] / per_step[0] == pytest.approx(3.0, rel=0.35)


def test_an_undamped_chain_has_no_dashpot_term(counts: dict[str, dict[str, Any]]) -> None:
    for name, scene in counts.items():
        reckoned = total(scene, "dashpot arithmetic") + scene.get("dashpot lines", 0)
        assert reckoned > 0 if "dashpot" in name else reckoned == 0, name


def test_an_undamped_chain_has_no_velocity_term(counts: dict[str, dict[str, Any]]) -> None:
    assert total(counts["bistable, impact, onsite"], "onsite arithmetic") > 0
    for name in ("linear, impact", "bistable, impact", "mixed, impact", "mixed, impact, one mass"):
        assert total(counts[name], "onsite arithmetic") == 0, name


@pytest.mark.parametrize("name", CLOSED)
def test_a_closed_form_scene_takes_no_step(counts: dict[str, dict[str, Any]], name: str) -> None:
    scene = counts[name]
    assert scene["solver"] == "closed form"
    assert scene["steps"] == 0
    used = {key for key in scene if key.startswith("calls in ")}
    assert "calls in plan" in used
    assert used <= {f"calls in {module}" for module in ("plan", "kernels", "equilibrium")}
    assert "masses read" not in scene


def test_inertia_or_damping_takes_steps(counts: dict[str, dict[str, Any]]) -> None:
    assert counts["bistable, impact"]["solver"] == "second order"
    assert counts["bistable, stress, dashpot"]["solver"] == "first order"
    for name in ("bistable, impact", "bistable, stress, dashpot"):
        assert counts[name]["steps"] > 0
        assert counts[name]["calls in taylor"] > 0


# ---------------------------------------------------------------- sensitivities


@pytest.mark.parametrize("way", ["fit", "search"])
def test_a_held_parameter_costs_no_sensitivity(
    counted: dict[str, dict[str, dict[str, Any]]], way: str
) -> None:
    """The work for five varying parameters plus that for the other three is that for all eight."""
    found = [counted["sensitivities"][f"{way}, {held} held"] for held in (0, 3, 5)]
    assert [one["columns"] for one in found] == [8, 5, 3]
    assert [set(one["carried"].values()) for one in found] == [{8}, {5}, {3}]
    every, some, others = (one["tangents expanded"] for one in found)
    assert min(some, others) > 0
    assert some + others == every


@pytest.mark.parametrize("way", ["fit", "search"])
def test_contact_and_zero_cost_no_sensitivity(
    counted: dict[str, dict[str, dict[str, Any]]], way: str
) -> None:
    """The contact time costs two runs without sensitivities, the zero costs no run."""
    known, unknown = (
        counted["sensitivities"][f"{way}, {what}"] for what in ("0 held", "contact unknown")
    )
    assert unknown["columns"] == known["columns"] + 2
    assert unknown["tangents expanded"] == known["tangents expanded"]


def test_a_residual_alone_costs_no_sensitivity(
    counted: dict[str, dict[str, dict[str, Any]]],
) -> None:
    assert counted["sensitivities"]["none, 0 held"]["tangents expanded"] == 0


# ---------------------------------------------------------------- after the search


@pytest.mark.parametrize("known", [False, True])
def test_the_best_point_is_simulated_once(monkeypatch: pytest.MonkeyPatch, known: bool) -> None:
    """One run with all curves (and the stress along the motion), one with sensitivities.

    Where the contact time is unknown, its derivative takes two more runs of the curves.
    """
    _, measurement = synthetic_impact(samples=101)
    params = make_params(measurement)
    params["contact_time"].vary = not known
    found = identify(measurement, "bistable", params, Options(starts=2), lambda *_: None)
    runs: Counter[tuple[str, bool]] = Counter()
    original = Plan.run

    def counted_run(plan: Plan, *args: Any, **options: Any) -> Any:
        runs[plan.solver, len(options["directions"]) > 0] += 1
        return original(plan, *args, **options)

    monkeypatch.setattr(Plan, "run", counted_run)
    before = found.problem.objective.evaluations
    result, _ = judge(found, Choice("local"), lambda _: None)
    assert result.parameters["s1_k0"].state == "determined"
    assert runs == {
        (SECOND_ORDER, False): 1 if known else 3,
        (CLOSED_FORM, False): 1,
        (SECOND_ORDER, True): 1,
    }
    assert found.problem.objective.evaluations == before + 2
