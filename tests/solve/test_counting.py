"""A scene costs no work that it does not need, shown by counting the calls of the compiled loops.

Counted are calls of the functions of each law, of the rates of the state, of steps and of samples;
see `counted`.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import numpy as np
import pytest

import foamfit as ff
from conftest import synthetic_impact
from counted import Counts, counted_run, during
from foamfit.data.measurement import Measurement, Noise, Specimen, Striker
from foamfit.fitting.problem import Problem, make_params, make_problem
from foamfit.fitting.search import Tracker
from foamfit.one_model import Options, identify, judge
from foamfit.solve.plan import CLOSED_FORM, EXPLICIT_STEPS, SECOND_ORDER, Motion, Plan, plan
from foamfit.springs.chain import Drive
from foamfit.springs.compiled import bistable
from foamfit.trust.intervals import Choice

DRIVES = ("impact", "stress", "displacement")
CLOSED = [
    f"{chain}, {drive}"
    for chain in ("linear", "mixed", "bistable")
    for drive in ("stress", "displacement")
]
LAW = ("begin", "evaluate", "switch", "settle", "strain")


class Scene(NamedTuple):
    """A scene that has been run, and what it called."""

    counts: Counts
    motion: Motion
    plan: Plan


def run(chain: ff.Chain, drive: Drive, t: np.ndarray) -> Scene:
    scene = plan(chain, drive, t)
    return Scene(*counted_run(scene, chain), scene)


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    """Run every scene once."""
    t = np.linspace(0.0, 0.8e-3, 41)
    spring, area = ff.published["foam-1/model-2"].bistable, 1.9635e-5
    damped = ff.BistableSpring(*spring.seven, eta=50.0)
    line, pulse = ff.LinearSpring(60e6), np.sin(np.pi * t / t[-1]) ** 2
    drives: dict[str, Drive] = {
        "impact": ff.Impact(7e-3, 2.0),
        "stress": ff.StressDrive(4e6 * pulse),
        "displacement": ff.DisplacementDrive(4e-4 * pulse),
    }
    three, h3 = [line, spring, line], [4e-4, 6e-4, 2e-4]
    some = [line, damped, line]
    chains = {
        "linear": ff.Chain([line], [1e-3], area),
        "mixed": ff.Chain(three, h3, area),
        "bistable": ff.Chain([spring], [1.19e-3], area),
    }
    made = {f"{name}, {by}": (chain, by) for name, chain in chains.items() for by in DRIVES} | {
        "mixed, impact, one mass": (ff.Chain(three, h3, area, [3e-3, 0.0, 0.0]), "impact"),
        "mixed, impact, two masses": (ff.Chain(three, h3, area, [3e-3, 3e-3, 0.0]), "impact"),
        "mixed, impact, dashpot": (ff.Chain(some, h3, area), "impact"),
        "bistable, impact, dashpot": (ff.Chain([damped], [1.19e-3], area), "impact"),
        "bistable, stress, dashpot": (ff.Chain([damped], [1.19e-3], area), "stress"),
    }
    return {name: run(chain, drives[by], t) for name, (chain, by) in made.items()}


def calls(scene: Scene, law: str) -> int:
    """Return how often the functions of a law were called."""
    return sum(scene.counts[f"{law}: {name}"] for name in LAW)


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("chain", ["linear", "mixed"])
def test_a_linear_spring_costs_no_evaluation_of_the_law(
    scenes: dict[str, Scene], chain: str, drive: str
) -> None:
    """A linear spring has two numbers and its own functions; only the others use their law."""
    scene = scenes[f"{chain}, {drive}"]
    assert bistable.LINEAR.columns == 2
    one, other = bistable.LINEAR.addresses, bistable.COMPILED.addresses
    assert not {*one} & {*other[: LAW.index("settle")], other[-1]}  # to settle is the same
    assert calls(scene, "linear") > 0
    law, line = (scene.counts[f"{kind}: evaluated points"] for kind in ("bistable", "linear"))
    if chain == "mixed":
        assert 0 < 2 * law <= line if drive == "impact" else calls(scene, "bistable") > 0
    else:
        assert calls(scene, "bistable") == law == 0


def test_a_massless_node_has_no_state(scenes: dict[str, Scene]) -> None:
    found = [scenes[f"mixed, impact{masses}"] for masses in ("", ", one mass", ", two masses")]
    assert [one.counts.sizes["nodes"] for one in found] == [1, 2, 3]
    assert [one.plan.ends for one in found] == [(3,), (1, 3), (1, 2, 3)]
    # displacement and velocity of each node that has a state, and nothing else, have derivatives
    assert [one.counts.sizes["carries"] for one in found] == [2, 4, 6]
    # of springs with a massless node between them the strains are integrated too
    assert [one.counts.sizes["base"] for one in found] == [5, 6, 6]


def test_an_undamped_chain_has_no_dashpot_in_its_state(scenes: dict[str, Scene]) -> None:
    """Of springs between the same nodes, those with a dashpot have a strain of their own."""
    for name, scene in scenes.items():
        nodes, carries = scene.counts.sizes["nodes"], scene.counts.sizes["carries"]
        lone = name == "bistable, impact, dashpot"  # its strain follows from its node
        assert carries == 2 * nodes + ("dashpot" in name and not lone), name


@pytest.mark.parametrize("name", CLOSED)
def test_a_closed_form_scene_takes_no_step(scenes: dict[str, Scene], name: str) -> None:
    """It calls nothing but laws, and the change of branch; there is no state."""
    counts, motion, scene = scenes[name]
    assert scene.solver == motion.method == CLOSED_FORM
    assert motion.steps == 0
    assert counts.sizes["nodes"] == counts.sizes["base"] == 0
    used = {key for key in counts if ":" not in key}
    assert used <= {"change"}


def test_inertia_or_damping_takes_steps(scenes: dict[str, Scene]) -> None:
    assert scenes["bistable, impact"].plan.solver == "second order"
    assert scenes["bistable, stress, dashpot"].plan.solver == "first order"
    for name in ("bistable, impact", "bistable, stress, dashpot"):
        counts, motion, _ = scenes[name]
        assert motion.method == EXPLICIT_STEPS
        assert motion.steps >= counts["step"] > 0
        assert counts["rates"] > 11 * motion.steps
        assert counts["tangents"] == 0


def test_a_step_without_samples_and_switches_computes_no_dense_output() -> None:
    """A step costs 12 rates; where it has samples, three more and those of its samples."""
    line, more = ff.LinearSpring(60e6), []
    chain = ff.Chain([line, line], [5e-4, 5e-4], 2e-5, [1e-6, 0.0])
    for t in (np.array([0.0, 1e-4]), np.linspace(0.0, 1e-4, 2001)):
        counts, motion, _ = run(chain, ff.Impact(7e-3, 2.0), t)
        assert motion.steps > 400
        more.append(counts["rates"] - 12 * motion.steps - 2 * t.size)  # two springs per sample
    assert 0 <= more[0] < 20
    assert 3 * motion.steps <= more[1] + 20 <= 5 * motion.steps


# ---------------------------------------------------------------- sensitivities

SOME = ("s1_eta", "s1_kc", "s1_eps_c")
OTHERS = ("s1_k0", "s1_dsigma", "s1_eps_a", "s1_kh_plus", "s1_kh_minus")
KNOWN = ("contact_time", "displacement_zero")


class Slopes(NamedTuple):
    """The cost of one derivative of the residual."""

    counts: Counts
    columns: int
    carried: set[int]  #: directions that the runs with sensitivities carry


def problem_of(held: tuple[str, ...]) -> Problem:
    """Return the problem of a simulated impact with some parameters fixed."""
    spring, height, area = ff.published["foam-1/model-1"].bistable, 1.19e-3, 1.9635e-5
    time = np.linspace(0.0, 0.75e-3, 21)
    response = ff.simulate(ff.Chain([spring], [height], area), ff.Impact(7e-3, 2.0), time)
    test = Measurement(
        name="synthetic", path=None, data_sha256="", time=time, stress=response.base_stress,
        displacement=response.displacement[-1], specimen=Specimen(height, area),
        striker=Striker(7e-3, 2.0), noise=Noise(1e4, 1e-6), motion="measured",
    )  # fmt: skip
    params = make_params(test)
    for name, value in zip(params, [*spring.seven, 20.0, 0.0], strict=False):
        params[name].value = value
    for one in params.values():
        one.vary = one.vary and one.name not in held
    return make_problem(test, "bistable", "impact", params, None, False)


def slopes(held: tuple[str, ...], way: str) -> Slopes:
    """Return the cost of one derivative.

    `way` selects the derivative of the refinement ("fit") or of the search ("search"), or only the
    residual ("none").
    """
    problem = problem_of(held)
    values = problem.vector()
    tracker, space = Tracker(problem.objective), problem.space()

    def work() -> np.ndarray:
        if way == "fit":
            return problem.slopes(values, problem.free())
        if way == "none":
            return tracker.residual(values)[:, None][:, :0]
        point = space.encode(values)
        there = space.decode(point)
        return problem.objective.jacobian_along(there, space.slopes(point, there))

    counts, columns = during(work)
    places = np.array([problem.index[name] for name in problem.free()])
    carried = problem.objective.simulate(values, places=places).slopes or {}
    return Slopes(counts, columns.shape[1], {len(rows) for rows in carried.values()})


@pytest.mark.parametrize("way", ["fit", "search"])
def test_a_held_parameter_costs_no_sensitivity(way: str) -> None:
    """The work for five varying parameters plus that for the other three is that for all eight."""
    found = [slopes(held + KNOWN, way) for held in ((), SOME, OTHERS)]
    assert [one.columns for one in found] == [8, 5, 3]
    assert [one.carried for one in found] == [{8}, {5}, {3}]
    every, some, others = (one.counts["tangents"] for one in found)
    assert min(some, others) > 0
    assert some + others == every


@pytest.mark.parametrize("way", ["fit", "search"])
def test_contact_and_zero_cost_no_sensitivity(way: str) -> None:
    """The contact time costs two runs without sensitivities, the zero costs no run."""
    known, unknown = slopes(KNOWN, way), slopes((), way)
    assert unknown.columns == known.columns + 2
    assert unknown.counts["tangents"] == known.counts["tangents"] > 0


def test_a_residual_alone_costs_no_sensitivity() -> None:
    alone = slopes(KNOWN, "none").counts
    assert alone["rates"] > 0
    assert alone["tangents"] == alone["bistable: evaluated slopes"] == 0


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
