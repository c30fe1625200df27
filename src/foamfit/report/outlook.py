"""What an experiment will tell, before it is fitted or even made: `foamfit check --model`.

At start values of the parameters: the velocity that closes the loop of each spring, the standard
errors to expect, and which channel is worth measuring better. All errors suppose that the model
follows the foam down to the noise; what the model leaves unexplained makes them larger.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.describe import taken_for_exact
from foamfit.data.measurement import Measurement, Noise, NoiseLevel, Striker
from foamfit.data.toml_file import read_settings
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.branches import visited
from foamfit.fitting.problem import Problem, make_problem
from foamfit.fitting.search import Tracker, search
from foamfit.report.comparison import Side, published_side, side_of
from foamfit.report.readable import readable
from foamfit.report.render import words
from foamfit.results import ParameterEstimate, law_in_words, snapping_of
from foamfit.solve.simulation import Response, simulate
from foamfit.springs import kernels
from foamfit.springs.chain import Chain, Impact
from foamfit.springs.laws import law
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name, unit_of
from foamfit.text import aligned, labelled, wrapped
from foamfit.trust import covariance
from foamfit.trust.best_point import BestPoint
from foamfit.trust.budget import response
from foamfit.trust.checklist import ESTIMATED
from foamfit.trust.conclude import state_of
from foamfit.trust.identifiability import Insight, look

# Descents per spring in the quick search for start values.
QUICK_STARTS = 4
# Range of velocities tried for closing a loop, over the planned one, and relative tolerance.
SLOWEST, FASTEST, CLOSE = 1e-2, 30.0, 1e-5
# The faster test exceeds the closing velocity by this factor.
BEYOND = 1.05
# Samples of a planned test, and its noise over the range if none is stated.
SAMPLES, NOISE = 501, 0.01
GUESSED = "the best"  # beginning of the source of start values that are a guess


@dataclass(frozen=True, eq=False)
class Expected:
    """What to expect of an experiment at one velocity of the striker."""

    velocity: float | None  # m/s; None in other drives than the impact
    estimates: dict[str, ParameterEstimate]  # what varies, with expected standard errors
    visited: dict[str, tuple[str, ...]]  # branches of each spring
    insight: Insight | None  # None if no parameter changes the curves
    snapped: dict[str, float]  # largest fraction of micro-springs that snaps, of each spring


@dataclass(frozen=True, eq=False)
class Outlook:
    """What can be said about an experiment before it is fitted."""

    problem: Problem
    values: Array  # SI; everything is evaluated there
    source: str  # where these come from
    planned: Expected
    # Velocity (m/s) from which on the loop of each spring closes, None if none up to 30
    # times the planned one does; empty in other drives than the impact.
    closing: dict[str, float | None]
    faster: Expected | None  # 5 % faster than what closes all loops, where one is left open
    noise: dict[str, NoiseLevel]  # of each counted curve
    # Of each quantity that the TOML gives without a ±: the parameter that 1 % of it moves farthest
    # in standard errors by noise, by how many of these, and by which share of its scale.
    exact: dict[str, tuple[str, float, float]]


def make_outlook(problem: Problem, values: Array, source: str) -> Outlook:
    """Look ahead at an experiment from a point of the parameters (SI), and where it comes from.

    The measured curves of the problem count by their range and noise only.
    """
    noise = {name: problem.objective.noise(name) for name in problem.objective.counted}
    sd = {name: level.sigma * level.time**0.5 for name, level in noise.items()}
    planned = expect(problem, values, sd)
    closing: dict[str, float | None] = {}
    quicker = None
    if problem.objective.drive == "impact":
        chain, impact = chain_of(problem, values), _impact(problem.measurement)
        closing = {
            f"s{i}": closing_velocity(chain, impact, i)
            for i, kind in enumerate(problem.model.kinds, start=1)
            if not law(kind).inner_loops and law(kind).hysteretic
        }
        fast = max((v for v in closing.values() if v is not None), default=0.0)
        if fast > impact.velocity:
            faster, there = _faster(problem, values, BEYOND * fast, sd)
            quicker = expect(faster, there, sd)
    exact = _moved_farthest(BestPoint(problem, values), planned.estimates)
    return Outlook(problem, values, source, planned, closing, quicker, noise, exact)


def _moved_farthest(
    best: BestPoint, expected: Mapping[str, ParameterEstimate]
) -> dict[str, tuple[str, float, float]]:
    """Effect of 1 % of each quantity without a ±, largest first; see `Outlook.exact`."""
    found, sizes = {}, dict(zip(best.names, best.sizes.tolist(), strict=True))
    for quantity in taken_for_exact(best.problem.measurement):
        change = response(best, quantity, 0.01)
        steps = {
            name: abs(float(change[best.index[name]]))
            for name, item in expected.items()
            if item.stderr and name in sizes and name not in NUISANCE
        }
        times = {name: step / (expected[name].stderr or 1.0) for name, step in steps.items()}
        if times and max(times.values()) > 0.0:
            most = max(times, key=times.__getitem__)
            found[quantity] = most, times[most], steps[most] / sizes[most]
    return dict(sorted(found.items(), key=lambda item: -item[1][1]))


# ---------------------------------------------------------------- start values


def start_values(problem: Problem, seed: int = 0) -> tuple[Array, str]:
    """Best point of a few quick descents from the measured loop, and what it is."""
    tracker = Tracker(problem.objective)
    starts = QUICK_STARTS * len(problem.model.kinds)
    rng = np.random.default_rng(seed)
    search(tracker, problem.space(), starts=starts, rng=rng, progress=lambda *_: None)
    if tracker.best_values is None:
        problem.objective.simulate(problem.vector())  # says why, if it cannot be simulated at all
        raise SimulationError(
            f"{problem.measurement.name}: no start value could be simulated; give some by "
            "--published or --params"
        )
    curves = problem.objective.simulate(tracker.best_values, everything=True)
    misfit = problem.objective.misfit(curves)
    worst = max(misfit[name] or 0.0 for name in problem.objective.counted)
    return tracker.best_values, (
        f"{GUESSED} of {starts} quick descents from the measured loop (misfit {worst:.1%} of range)"
    )


def known_values(problem: Problem, side: Side) -> Array:
    """Start values of the springs of an earlier result or of a published set.

    Heights are scaled to the specimen; the damping of a published set is numerical and left out.
    """
    model, known = problem.model, dict(side.estimates)
    if side.source is not None:
        zero = ParameterEstimate(0.0, None, None, "", False, "published", "")
        known |= {name: zero for name in model.names if name.endswith("_eta")}
    families = [[law(kind).hysteretic for kind in kinds] for kinds in (model.kinds, side.kinds)]
    if families[0] != families[1]:
        kinds = side.source.model if side.source else "+".join(side.kinds)
        raise InputError(f"{side.label} is a {kinds}, not a {model.name}; give --model")
    if missing := [name for name in model.names if name not in known]:
        raise InputError(f"{side.label} has no {missing[0]}, which {model.name} needs")
    total = sum(p.value for name, p in known.items() if name.endswith("_height"))
    values = problem.vector()
    for name in model.names:
        scale = problem.measurement.specimen.height / total if name.endswith("_height") else 1.0
        if side.source is None or problem.params[name].vary or name.endswith("_eta"):
            values[model.index[name]] = scale * known[name].value
    return problem.space().complete(values)


# ---------------------------------------------------------------- a test that is not made yet


def planned_test(settings_file: Path) -> Measurement:
    """Make a test from a TOML that plans one; `simulated_test` fills in the curves."""
    settings = read_settings(settings_file, settings_file, channels=())
    striker = settings.striker or Striker()
    for key, value in (("mass", striker.mass), ("velocity", striker.velocity)):
        if not value:
            raise InputError(f"{settings_file}: [striker] {key} is missing; a plan needs it")
    return Measurement(
        name=f"{settings.name} (planned)",
        path=settings_file,
        data_sha256="",
        time=np.linspace(0.0, 1e-3, SAMPLES),
        stress=np.linspace(0.0, 1e6, SAMPLES),
        displacement=np.linspace(0.0, 0.1 * settings.specimen.height, SAMPLES),
        specimen=settings.specimen,
        striker=striker,
        noise=settings.noise,
        motion="measured",
        uncertainties=settings.uncertainties,
        notes=("Nothing is measured yet: the curves are simulated.",),
    )


def simulated_test(like: Measurement, chain: Chain, drive: Impact) -> Measurement:
    """Replace the curves of a test by a simulated impact, over as many samples as it has.

    Noise that is not stated becomes 1 % of the range of its curve.
    """
    count = SAMPLES if like.time is None else like.time.size
    *_, last = _runs(chain, drive)
    if last.contact_end is None:
        raise SimulationError("the striker does not come back; check its mass and the damping")
    time = np.linspace(0.0, last.contact_end, count)
    response = simulate(chain, drive, time)
    stress, motion = response.base_stress, response.displacement[-1]
    noise = Noise(
        like.noise.stress or NOISE * float(np.ptp(stress)),
        like.noise.displacement or NOISE * float(np.ptp(motion)),
    )
    inside = {node: response.displacement[node - 1] for node in like.interior}
    measured = like.acceleration is not None
    slowed = -np.gradient(np.gradient(motion, time), time) if measured else None
    made = replace(like, time=time, stress=stress, displacement=motion, acceleration=slowed)
    made = replace(made, interior=inside, striker=Striker(drive.mass, drive.velocity), noise=noise)
    return replace(made, outliers={}, sampled={}, block=1, contact="file")


def _runs(chain: Chain, drive: Impact) -> Iterator[Response]:
    """Give runs of an impact of growing duration, up to one in which contact ends."""
    end = 4.0 * chain.height / drive.velocity
    for _ in range(20):
        response = simulate(chain, drive, np.linspace(0.0, end, 16))
        yield response
        if response.contact_end is not None:
            return
        end *= 2.0


# ---------------------------------------------------------------- the questions


def chain_of(problem: Problem, values: Array) -> Chain:
    """Chain, massless inside, of a flat vector of parameters."""
    specimen = problem.measurement.specimen
    return problem.model.chain(values, specimen.height, specimen.area)


def closing_velocity(chain: Chain, impact: Impact, spring: int) -> float | None:
    """Velocity (m/s) from which on an impact closes the loop of a spring: it snaps, and snaps back.

    By bisection of forward runs, to 1e-5, from the planned impact; springs count from 1 at the
    base. None if no velocity from a hundredth to thirty times the planned one parts the two.
    """

    def closes(velocity: float) -> bool:
        """Whether the spring comes to branch e."""
        try:
            switches = [one.switches for one in _runs(chain, Impact(impact.mass, velocity))]
        except SimulationError:  # past the end of a branch: nothing is closed there
            return False
        return any(np.any((s[:, 1] == spring - 1) & (s[:, 3] == kernels.E)) for s in switches)

    low = high = impact.velocity
    while closes(low):
        high, low = low, low / 1.25
        if low < SLOWEST * impact.velocity:
            return None
    while not closes(high):
        low, high = high, high * 1.25
        if high > FASTEST * impact.velocity:
            return None
    while high - low > CLOSE * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if closes(middle) else (middle, high)
    return high


def _faster(
    problem: Problem, values: Array, velocity: float, noise: Mapping[str, float]
) -> tuple[Problem, Array]:
    """Return the same problem at another velocity of the striker, and its vector of parameters.

    Its curves are simulated, and its nuisance parameters those of such a record.
    """
    test = problem.measurement
    known = {problem.objective.channel(name): value for name, value in noise.items()}
    moved = next((value for name, value in known.items() if name.startswith("displacement")), None)
    estimated = {name: x for name, x in test.noise.estimated.items() if name == "acceleration"}
    test = replace(test, noise=Noise(known.get("stress"), moved, estimated))
    impact = Impact(_impact(test).mass, velocity)
    test = simulated_test(test, chain_of(problem, values), impact)
    params = problem.params.copy()
    for name in problem.objective.nuisance:
        del params[name]
    model, objective = problem.model, problem.objective
    given = (test, model.name, "impact", params, objective.weights, objective.interior_mass)
    faster = make_problem(*given, relaxation=model.relaxation)
    own = values[: len(model.names)]
    return faster, np.append(own, faster.vector()[own.size :])


def expect(problem: Problem, values: Array, noise: Mapping[str, float]) -> Expected:
    """Standard errors and states to expect at a point, from the Fisher information.

    `noise` is one standard deviation of each counted curve, SI.
    """
    best, params = BestPoint(problem, values), problem.params
    lost, names = best.unreached, best.names
    insight = look(best, noise) if names else None
    expected, origins = {}, problem.measurement.origins
    for name in problem.free():
        value, unit = float(values[problem.index[name]]), unit_of(name)
        if name in lost or insight is None:
            why = f"branch {lost[name]} of spring {split_name(name)[0] + 1} is not reached"
            expected[name] = ParameterEstimate(value, None, None, unit, True, "not determined", why)
            continue
        stderr = float(insight.stderr[names.index(name)])
        half = covariance.half_width(stderr, problem.objective.n_data - len(names))
        limits = (params[name].min, params[name].max)
        state, why = state_of(name, value, (value - half, value + half), insight, limits)
        known = None if state == "not determined" else stderr
        found = ParameterEstimate(value, known, None, unit, True, state, why)
        expected[name] = found.counted_from(-origins.get(name, 0.0))
    impact = problem.objective.drive == "impact"
    velocity = _impact(problem.measurement).velocity if impact else None
    there = _snapped(best)
    return Expected(velocity, expected, visited(problem, best.simulated), insight, there)


def _snapped(best: BestPoint) -> dict[str, float]:
    """Largest fraction of micro-springs that snaps, by spring, where it is known."""
    problem, curves = best.problem, best.simulated.curves
    test, drive = problem.measurement, problem.objective.drive
    moved = curves.get("displacement_time", test.displacement)
    stress = test.stress if drive == "stress" else curves.get("stress_strain")
    strain = None if moved is None else moved / test.specimen.height
    chain = chain_of(problem, best.values[: len(problem.model.names)])
    found = snapping_of(chain, strain, None if drive == "impact" else stress)
    return {name: snapped.most for name, snapped in found.items()}


def worth(insight: Insight) -> dict[str, dict[str, float]]:
    """Standard error of each parameter if a curve's noise were halved, over the present one."""
    out = {}
    for curve in insight.curves:
        pairs = zip(insight.names, insight.stderr_with(curve), insight.stderr, strict=True)
        out[curve] = {name: float(a / b) for name, a, b in pairs if np.isfinite(b)}
    return out


def _impact(test: Measurement) -> Impact:
    striker = test.striker or Striker()
    assert striker.mass  # the drive has them
    assert striker.velocity
    return Impact(striker.mass, striker.velocity)


def outlook_of(
    test: Path,
    specimen: Path | None,
    model: str,
    drive: str | None,
    *,
    published_set: str | None = None,
    result: Path | None = None,
    relaxation: int = 0,
) -> Outlook:
    """Read a test, or a TOML that plans one, and look ahead.

    A TOML needs one of the sources of start values: `published_set`, or `result`, an earlier one.
    InputError names what is missing or wrong.
    """
    from foamfit.data.csv_file import read_test

    model = Model.parse(model).name
    made = test.suffix.lower() != ".toml"
    if not made and published_set is None and result is None:
        raise InputError(
            f"{test} plans a test without data; say by --published or --params what foam it is"
        )

    def problem_of(measurement: Measurement) -> Problem:
        return make_problem(
            measurement, model, drive, None, None, interior_mass=False, relaxation=relaxation
        )

    measurement = read_test(test, specimen) if made else planned_test(test)
    problem = problem_of(measurement)
    if published_set is not None:
        values = known_values(problem, published_side(published_set))
        source = f"published {published_set}, without its numerical damping"
    elif result is not None:
        values, source = known_values(problem, side_of(result)), f"the result in {result}"
    else:
        values, source = start_values(problem)
    if not made:
        chain = chain_of(problem, values)
        problem = problem_of(simulated_test(measurement, chain, _impact(measurement)))
    return make_outlook(problem, values, source)


# ---------------------------------------------------------------- in words


def outlook_text(outlook: Outlook) -> str:
    """Write an outlook for people: at most 100 columns wide, no newline at the end."""
    problem, planned = outlook.problem, outlook.planned
    objective, insight = problem.objective, planned.insight
    rms = objective.rms(objective.differences(outlook.values))
    times = {name: rms[name] / level.sigma for name, level in outlook.noise.items() if name in rms}
    ratios = {} if insight is None else worth(insight)
    gains = {name: 1.0 - float(np.mean([*row.values()])) for name, row in ratios.items() if row}
    told = words(
        "outlook",
        outlook=outlook,
        problem=problem,
        planned=planned,
        law=law_in_words(problem.model.name, problem.model.relaxation),
        larger={name: one for name, one in times.items() if one > ESTIMATED},
        loops=list(_loops(outlook)),
        guessed=outlook.source.startswith(GUESSED),
        gains=gains,
        best=max(gains, key=gains.__getitem__, default=""),
    )
    lines = (line.partition("|") for line in told.splitlines())
    items = groupby(((label, text) for label, _, text in lines), key=lambda item: item[0])
    whys = [
        line
        for name, item in planned.estimates.items()
        if item.state != "determined" and name not in NUISANCE
        for line in wrapped(f"{name}: {item.state}, {item.why}.")
    ]
    shown = labelled((label, [text for _, text in group]) for label, group in items)
    return "\n".join([shown, "", *_table(outlook), "", *whys]).rstrip()


def _loops(outlook: Outlook) -> Iterator[dict[str, Any]]:
    """How far each hysteretic spring goes, and what would close its loop."""
    planned = outlook.planned
    for name, seen in planned.visited.items():
        own = outlook.problem.model.laws[int(name[1:]) - 1]
        if not own.hysteretic:
            continue
        closes = not own.inner_loops
        yield {
            "number": name[1:],
            "seen": seen,
            "closes": closes,
            "snaps": "snap-through" in own.branches,
            "most": planned.snapped.get(name),
            "closing": outlook.closing.get(name),
            "needed": _needed(outlook, int(name[1:])) if closes and not planned.velocity else None,
            "lost": [
                parameter
                for parameter, item in planned.estimates.items()
                if "reached" in item.why and parameter.startswith(f"{name}_")
            ],
        }


def _needed(outlook: Outlook, spring: int) -> tuple[float, float]:
    """Overall strain, and stress (Pa), at which a spring of a slow chain comes to its C1."""
    chain = chain_of(outlook.problem, outlook.values)
    strain, stress = chain.springs[spring - 1].corners["C1"]
    path = np.linspace(0.0, stress, 400)
    strains = [
        strain if i == spring - 1 else float(np.asarray(other.strain(path))[-1])
        for i, other in enumerate(chain.springs)
    ]
    return float(np.dot(chain.heights, strains)) / chain.height, stress


def _table(outlook: Outlook) -> list[str]:
    """Align the expected standard errors, beside those of the faster test where there is one."""
    shown = [readable(*item) for item in outlook.planned.estimates.items()]
    columns = [["parameter", *(p.label for p in shown)], ["unit", *(p.unit for p in shown)]]
    for test in (outlook.planned, outlook.faster):
        if test is not None:
            at = "" if test.velocity is None else f" at {test.velocity:.4g} m/s"
            shown = [readable(name, test.estimates[name]) for name in outlook.planned.estimates]
            columns.append([f"expected{at}", *(p.with_error for p in shown)])
            columns.append(["state", *(p.state for p in shown)])
    return aligned(list(zip(*columns, strict=True)))
