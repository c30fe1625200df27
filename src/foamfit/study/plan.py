"""Which test next: the expected gain of every test that a rig can make.

The tests at hand leave some parameters open. Values of these are drawn, every candidate is
simulated with each draw, and the expected interval of a parameter is the median over the draws
(Chaloner & Verdinelli 1995, Statist. Sci. 10, 273: Bayesian design by the Fisher information).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import combinations
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize

from foamfit.api import FitResult
from foamfit.arrays import Array, single_threaded
from foamfit.data.measurement import MEASURED, Measurement, Noise, Specimen, Striker
from foamfit.data.rig import Candidate, Rig, beyond, candidates, read_rig
from foamfit.errors import InputError, SimulationError, check_whole
from foamfit.fitting.minimizer import problem_of
from foamfit.fitting.nuisance import VELOCITY
from foamfit.fitting.problem import make_params, make_problem
from foamfit.one_model import Progress
from foamfit.parts import law_in_words
from foamfit.report.plan import Expected, Outcome, Plan, Quantity
from foamfit.solve.simulation import simulate
from foamfit.springs.chain import Chain, Impact
from foamfit.springs.published import published
from foamfit.study import gain
from foamfit.study.draws import known_of, with_others
from foamfit.study.gain import Known, Seen, Test
from foamfit.study.identified import load, with_record
from foamfit.study.joint_result import JointResult
from foamfit.text import counted

DRAWS = 40  # number of drawn foams
FEWER_DRAWS = 16  # those of springs in series with information, as others are fitted to each
NEARLY = 0.1  # tests that determine this many parameters fewer, on average, count as equal
# What a softer test may lose: parameters, on average, but only a PART of those that the best one
# adds, and this share of the width of intervals. A faster one is also more likely to break the rig:
# with 0.1, fewer parameters were determined.
FEWER, PART, WIDER = 0.5, 0.25, 0.05
PAIRED = 20  # number of tests whose pairs are compared
TOLD_APART = 9.0  # rise of χ² at which a test tells two laws apart
# The closing velocity is sought at SPEEDS down to a SLOWEST part of the largest, then by bisection.
SPEEDS, SLOWEST = 18, 40.0


@single_threaded
def plan(
    *results: FitResult | JointResult | str | Path,
    rig: str | Path | None = None,
    quantity: str | None = None,
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> Plan:
    """Find the test of a rig that would determine most of what the results leave open.

    Parameters
    ----------
    results : FitResult, JointResult, str or Path
        Results of `fit` or `joint`, their folders, or the name of a published set. Results of one
        model are tests of one foam; results of other models are rivals, which the test should tell
        apart from the first.
    rig : str or Path, optional
        RIG.toml; what it does not state is taken from the record of the first result.
    quantity : str, optional
        What the foam is needed for, such as "peak_force at 3 m/s"; its expected error decides
        between tests that determine as many parameters.
    seed : int
        The same results, rig and seed give the same numbers.
    progress : callable, optional
        Called with the completed fraction and the name of the current step.

    Returns
    -------
    Plan
        The advice, with a table, a plot and `foamfit.Plan.save`.

    Raises
    ------
    InputError
        If a result or the rig cannot be read, or if the rig can make no test.
    """
    check_whole("seed", seed, 0)
    tests, rivals = _read(results)
    rng, test = np.random.default_rng(seed), tests[0].problem.measurement
    # A hold is worth a try if one of the laws relaxes.
    relaxing = any(one.problem.model.relaxation for one in (tests[0], *rivals.values()))
    limits = read_rig(None if rig is None else Path(rig), test, relaxing=relaxing)
    if not (asked := candidates(limits, test, len(tests[0].problem.model.kinds))):
        raise InputError(
            f"{test.name}: no test to plan; give a rig with a [striker] or a [machine] "
            "(foamfit init --rig RIG.toml writes a draft)"
        )
    progress(0.0, "drawing what the tests leave open")
    informed = FEWER_DRAWS if tests[0].problem.model.has_several else DRAWS
    known = known_of(tests, rng, DRAWS, informed)
    others = {name: known_of([one], rng, 0) for name, one in rivals.items()}
    target = None if quantity is None else gain.Target.of(quantity, known, limits)
    now = _now(known, tests)
    least = sum(one.probability for one in now.values())
    if known.explained:
        progress(0.2, "other springs that would show the same")
        some = known.first(len(known.draws) // 2)
        rough = [_outcome(some, None, one, gain.look(some, one, limits)) for one in asked]
        if likely := _advised([one for one in rough if not one.risky], least):
            known = with_others(known, tests, likely.candidate, limits)
    outcome = partial(_outcome, known, target)
    seen = list[Seen]()
    for i, one in enumerate(asked):
        progress(0.3 + 0.6 * i / len(asked), f"{counted(len(asked), 'candidate')}, {i} done")
        seen.append(gain.look(known, one, limits, others))
    outcomes = list(map(outcome, asked, seen))
    safe = [i for i, one in enumerate(outcomes) if not one.risky]
    # The two safe tests that determine most together, of those that determine most alone
    first = sorted(safe, key=lambda i: -outcomes[i].number)[:PAIRED]
    pairs = [(outcome(asked[i], seen[i], seen[j]), asked[j]) for i, j in combinations(first, 2)]
    progress(0.92, "what no test of this rig determines")
    shown = [now, *(outcomes[i].expected for i in safe)]
    never = _beyond(known, shown, limits)
    progress(0.97, "the velocity that closes the loop")
    return Plan(
        name=tests[0].study or test.name,
        tests=tuple(one.problem.measurement for one in tests),
        model=known.problem.model.name,
        relaxation=known.problem.model.relaxation,
        rig=limits,
        now=now,
        outcomes=tuple(outcomes),
        advice=_advised([outcomes[i] for i in safe], least),
        pair=max(pairs, key=lambda one: one[0].number, default=None),
        never=never,
        closing={mass: _closing(known, mass, limits) for mass in limits.masses},
        quantity=None
        if target is None
        else Quantity(target.text, target.unit, target.middle, target.error(known, [])),
        rivals=tuple(others),
        missed=known.missed > 0.0,
        contradicted=known.missed > 0.0 and any(x.fit and x.fit.contradictions for x in tests),
        **_as_fitted(tests),
        seed=seed,
    )


def _as_fitted(tests: Sequence[Test]) -> dict[str, Any]:
    """Return the drives, and the spring parameters held elsewhere than by default, SI."""
    problem, drives = tests[0].problem, {one.problem.objective.drive for one in tests}
    usual = make_params(problem.measurement, problem.model, problem.objective.drive)
    params = {name: problem.params[name] for name in problem.model.names}
    held = {n: one.value for n, one in params.items() if not one.vary and one.expr is None}
    held = {n: x for n, x in held.items() if usual[n].vary or usual[n].value != x}
    return {"drives": frozenset(drives), "held": held}


def _read(results: Sequence[object]) -> tuple[list[Test], dict[str, Test]]:
    """Return the tests at hand, and one test of each rival model."""
    found = list[Test]()
    for one in results:
        if isinstance(one, str) and one in published and not Path(one).exists():
            found.append(_published(one))
            continue
        read = load(one) if isinstance(one, str | Path) else one
        fits, study = [read], ""
        if isinstance(read, JointResult):
            fits, study = [*read.results.values()], read.name
        for fit in fits:
            if not isinstance(fit, FitResult):
                raise InputError(f"{one} is not a fit or joint fit; name the folder of one")
            fit = with_record(fit, one) if isinstance(one, str | Path) else fit
            problem = problem_of(fit)
            found.append(Test(problem, problem.vector(fit.params) - problem.origins, fit, study))
    if not found:
        raise InputError("name at least one result to plan from")
    first = found[0].problem.model
    same = [one for one in found if one.problem.model == first]
    _check_records([one.problem.measurement for one in same])
    rest = [one for one in found if one.problem.model != first]
    return same, {law_in_words(x.problem.model.name, x.problem.model.relaxation): x for x in rest}


def _check_records(tests: Sequence[Measurement]) -> None:
    """Raise InputError if two results are of one record, whose samples would count twice."""
    for one, other in combinations(tests, 2):
        first = max(one.cycle, other.cycle)
        last = min(each.last_cycle or each.cycle for each in (one, other))
        if one.data_sha256 and one.data_sha256 == other.data_sha256 and first <= last:
            raise InputError(
                f"{one.name}: two results are of this record, which counts once; leave one out"
            )


def _published(name: str) -> Test:
    """Return a simulated test of a published set at its own velocity, with 1 % noise, undamped."""
    one, drive = published[name], published[name].chain
    chain, height = Chain(drive.springs, drive.heights, drive.area), drive.height
    heights = tuple(drive.heights) if len(drive.springs) > 1 else None
    time = np.linspace(0.0, 6.0 * height / one.striker_velocity, 601)
    seen = simulate(chain, Impact(one.striker_mass, one.striker_velocity), time)
    curves = time, np.maximum(seen.base_stress, 0.0), seen.displacement[-1]
    rows = int(np.searchsorted(time, seen.contact_end or time[-1]))  # as a fit uses them
    time, stress, moved = (one[:rows] for one in curves)
    test = Measurement(
        name=f"{name} (simulated)", path=None, data_sha256="", time=time, stress=stress,
        displacement=moved, specimen=Specimen(height, chain.area, one.specimen_mass, heights),
        striker=Striker(one.striker_mass, one.striker_velocity), motion=MEASURED, contact="stress",
        noise=Noise(0.01 * float(np.ptp(stress)), 0.01 * float(np.ptp(moved))),
    )  # fmt: skip
    problem = make_problem(test, one.model, "impact", None, None, False)
    values = problem.vector()
    for i, spring in enumerate(chain.springs):
        own = problem.model.own(i, values)
        own[:] = [*(getattr(spring, key) for key in spring.law.own), 0.0]
    values[problem.index["site_eta"]] = 0.0
    return Test(problem, values)


def _now(known: Known, tests: Sequence[Test]) -> dict[str, Expected]:
    """Return what is known now; of a single test what its result says."""
    out, fit = gain.expected(known, []), tests[0].fit
    if fit is None or len(tests) > 1:
        return out
    sizes = known.problem.sizes(known.names, tests[0].values).tolist()
    for name, size in zip(known.names, sizes, strict=True):
        one = fit.parameters[name]
        width = math.nan if one.ci95 is None else one.ci95[1] - one.ci95[0]
        share, chance = 0.5 * width / size, float(one.state == "determined")
        out[name] = Expected(width, one.state, (width, width), chance, share)
    return out


def _outcome(known: Known, target: gain.Target | None, one: Candidate, *seen: Seen) -> Outcome:
    """Return what a candidate would determine, together with others of which more is seen."""
    risk, found = np.any([each.broken for each in seen], axis=0), gain.expected(known, seen)
    error = None if target is None else target.error(known, seen)
    return Outcome(one, float(np.mean(risk)), found, seen[0].force, error, seen[0].apart)


def _advised(safe: Sequence[Outcome], now: float) -> Outcome | None:
    """Return the advised one of some safe tests; None if there are none."""
    # The softest of those that determine most parameters with the narrowest intervals, or with a
    # quantity asked for the one with its least error; if none determines more than `now`, the one
    # with the narrowest intervals. With rivals it tells them apart, if a test can.

    def least_apart(one: Outcome) -> float:
        return min(one.apart.values(), default=math.inf)

    def effort(one: Outcome) -> tuple[bool, float, int, float]:
        asked = one.candidate
        return asked.interior is not None, asked.hold, asked.cycles, one.force

    most = max((one.number for one in safe), default=0.0)
    good = [one for one in safe if one.number >= most - NEARLY]
    told = [one for one in safe if least_apart(one) >= TOLD_APART]
    if not (best := [one for one in good if one in told]):
        return max(good, key=least_apart, default=None)
    if best[0].error is not None:
        return min(best, key=lambda one: one.error or 0.0)
    if most <= now + NEARLY:
        return min(best, key=attrgetter("narrowness"))
    enough = most - min(FEWER, PART * (most - now))
    near = [one for one in told if one.number >= enough]
    least = min(one.narrowness for one in near)
    return min((one for one in near if one.narrowness <= least + WIDER), key=effort)


def _beyond(known: Known, shown: Sequence[dict[str, Expected]], rig: Rig) -> dict[str, str]:
    """Return, for parameters that are never determined in `shown`, what other rig would."""
    sure = {name for each in shown for name, one in each.items() if one.state == "determined"}
    left = [name for name in known.names if name not in sure]
    problem, out = known.problem, dict.fromkeys(left, "")
    test, springs = problem.measurement, len(problem.model.kinds)
    some = known.first(len(known.draws) // 4)
    for what, other in beyond(rig, springs) if left else ():
        made = [one for one in candidates(other, test, springs) if not one.repeat]
        for one in made[:: max(len(made) // 12, 1)]:
            found = gain.expected(some, [gain.look(some, one, other)])
            new = [name for name in left if found[name].state == "determined" and not out[name]]
            out |= dict.fromkeys(new, what)
    return out


def _closing(known: Known, mass: float, rig: Rig) -> tuple[float, float]:
    """Return the least velocities that reach every branch in half and in 95 % of the draws, m/s."""
    top = 2.0 * rig.velocity[1]
    speeds = np.geomspace(*rig.velocity, 4).tolist()
    made = [gain.as_test(known, Candidate("impact", mass, speed), rig) for speed in speeds]
    test = max(made, key=lambda one: float(one.problem.objective.time[-1]))  # the longest contact
    at, needed = test.problem.index[VELOCITY], list[float]()

    def closed(speed: float, values: Array) -> bool:
        values[at] = speed
        try:
            shown = test.problem.objective.simulate(values, everything=True)
        except SimulationError:
            return True  # beyond the lock-up
        return bool(test.reached(shown, known.names).all())

    # With a dashpot a faster striker may leave before the foam has snapped back: refine the first.
    tried = np.geomspace(top / SLOWEST, top, SPEEDS).tolist()
    for values in (test.with_springs(one.springs) for one in known.drawn):
        first = next((i for i, speed in enumerate(tried) if closed(speed, values)), None)
        if first:
            ends = tried[first - 1], tried[first]
            needed.append(optimize.bisect(lambda *x: closed(*x) - 0.5, *ends, (values,), rtol=1e-3))
        else:  # at no velocity, or at any
            needed.append(math.inf if first is None else 0.0)
    half, sure = np.quantile(needed, (0.5, 0.95), method="higher").tolist()
    return half, sure
