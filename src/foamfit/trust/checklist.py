"""What a fit must pass before it is called good: one question each, and the status that follows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, groupby
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.energy import EnergyAudit
from foamfit.data.measurement import ASKED, INTEGRATED
from foamfit.data.zeros import CONTRADICTED
from foamfit.errors import InputError
from foamfit.fitting.branches import covered, visited
from foamfit.fitting.curves import check_time_shift
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import SearchRecord
from foamfit.results import Check, Intervals, ParameterEstimate
from foamfit.springs.parameters import NUISANCE, any_param, split_name
from foamfit.trust import SENTENCES, say
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import AT_LIMIT, WEAK, covariance

# Misfit over the standard deviation of a curve above which the curve was not fitted at all, and
# over its range above which it was fitted poorly.
UNACCEPTABLE, POOR = 0.5, 0.05
# Residuals over noise up to which they count as noise: a stated noise is seldom known better than
# to a tenth, an estimated one to a half.
STATED, ESTIMATED = 1.1, 1.5
# Autocorrelation time, samples, from which on residuals count as correlated.
STRUCTURED = 5.0
# Most reasons in one warning; more of them are easier to read in the table of parameters.
REASONS = 3


Estimates = Mapping[str, ParameterEstimate]


def may_vanish(name: str) -> bool:
    """Whether a parameter may be zero: its interval tells whether there is an effect at all."""
    return name not in NUISANCE and any_param(split_name(name)[1]).has_neutral


def status_of(checklist: Iterable[Check]) -> str:
    """Status of a fit: "failed" after a fatal no, "warnings" after any other, else "ok"."""
    wrong = [check for check in checklist if check.answer is False]
    if any(check.fatal for check in wrong):
        return "failed"
    return "warnings" if wrong else "ok"


def warnings_of(checklist: Iterable[Check]) -> tuple[str, ...]:
    """Warnings of a fit in the order of its checklist, those about the input first."""
    return input_first(warning for check in checklist for warning in check.warnings)


def input_first(warnings: Iterable[str]) -> tuple[str, ...]:
    """Each warning once, those that `foamfit check` gives before all others."""
    return tuple(sorted(dict.fromkeys(warnings), key=lambda text: not text.startswith(ASKED)))


def make_checklist(
    best: BestPoint,
    estimates: Estimates,
    misfit: Mapping[str, float | None],
    record: SearchRecord,
    balance: EnergyAudit,
    intervals: Intervals,
) -> tuple[Check, ...]:
    """Answer all questions, in the order of `sentences.toml`."""
    known = [name for name, item in estimates.items() if item.stderr is not None]
    checks = (
        *_of_search(best, record),
        _followed(best, misfit),
        _at_noise(best),
        _determined(best, estimates),
        _visited(best, estimates),
        *_of_intervals(best, estimates, intervals, known),
        *_of_test(best, balance),
        _time_shift(best, estimates, known),
        _damping(best, known),
    )
    found = {check.key: check for check in checks}
    return tuple(found[key] for key in SENTENCES["check"])


def _check(
    key: str,
    answer: bool | None,
    *,
    warnings: Iterable[str] | None = None,
    fatal: bool = False,
    **facts: object,
) -> Check:
    """Check of `sentences.toml`; `warnings` are those of a "no" there if none are given."""
    table, section = SENTENCES["check"][key], f"check.{key}"
    case = {True: "yes", False: "no", None: "unknown"}[answer]
    said = say(section, case if case in table else "said", **facts)
    if warnings is None:
        told = answer is False and "warning" in table
        warnings = say(section, "warning", **facts).splitlines() if told else ()
    return Check(key, table["question"], answer, said, tuple(warnings), fatal)


def _of_search(best: BestPoint, record: SearchRecord) -> Iterator[Check]:
    by, objective = record.stopped, best.problem.objective
    yield _check("ended", by is None, by=by, count=objective.evaluations)
    total, agreeing = sum(count for _, count in record.costs), 0
    if by is None and total:
        agreeing = record.agreeing
    yield _check("agree", agreeing > 1 if agreeing else None, total=total, agreeing=agreeing)
    failed, tried = objective.failures, max(objective.evaluations, 1)
    yield _check("simulated", failed <= 0.5 * tried, failed=failed, tried=tried)
    vibrates = objective.interior_mass and len(best.problem.model.kinds) > 1
    yield _check("vibration", not vibrates)


def _followed(best: BestPoint, misfit: Mapping[str, float | None]) -> Check:
    objective, curves = best.problem.objective, []
    for name in objective.counted:
        off, measured = misfit[name] or 0.0, objective.measured[name]
        lost = off * float(np.ptp(measured)) > UNACCEPTABLE * float(np.std(measured))
        curves.append({"name": name, "off": off, "lost": lost, "poor": off > POOR or lost})
    fine, fatal = not any(one["poor"] for one in curves), any(one["lost"] for one in curves)
    return _check("followed", fine, fatal=fatal, curves=curves)


def _at_noise(best: BestPoint) -> Check:
    """Whether the residuals are noise: by their size, an error of the law, and their correlation.

    This is the only verdict on the noise; `Fit.at_noise` has its answer.
    """
    objective, known, longest = best.problem.objective, False, 1.0
    errors = best.errors if best.names else (None,) * len(objective.counted)
    rms = objective.rms(best.residual)
    seen, missed = list[dict[str, Any]](), list[dict[str, Any]]()
    for name, size, error in zip(objective.counted, objective.sizes, errors, strict=True):
        noise, tau = objective.noise(name), error.noise.tau if error else 1.0
        known, longest = known or noise.sigma > 0.0, max(longest, tau)
        if error and error.found and (span := objective.span(name)):
            missed.append({"name": name, "missed": error.law / span})
        if noise.sigma > 1e-9 * objective.scale[name]:  # else too small to be seen
            source, most = ("stated", STATED) if noise.given else ("estimated", ESTIMATED)
            ratio = rms[name] / noise.sigma
            # Three standard deviations of the RMS of so many effective samples.
            large = ratio > most + 3.0 * math.sqrt(tau / (2.0 * size))
            seen.append({"name": name, "ratio": ratio, "source": source, "large": large})
    long, large = longest > STRUCTURED, any(one["large"] for one in seen)
    answer = False if missed or long or large else None
    if answer is None and known and (seen or longest >= 1.05):
        answer = True
    return _check("noise", answer, seen=seen, missed=missed, tau=longest, long=long)


def _determined(best: BestPoint, estimates: Estimates) -> Check:
    """Whether the springs' parameters are; a small upper bound of one that may vanish is enough.

    A nuisance parameter that is not determined shows in the intervals of the others.
    """
    own = {name: item for name, item in estimates.items() if name not in NUISANCE}
    vanishing, reasons_of = [name for name in own if _vanishes(best, name, own[name])], {}
    for state in ("not determined", "weak"):
        of = {n: p.why for n, p in own.items() if p.state == state and n not in vanishing}
        groups = groupby(of, key=of.__getitem__)
        reasons_of[state] = [(", ".join(names), why) for why, names in groups]
    states = [item.state for item in own.values() if item.state != "fixed"]
    count, varied = states.count("determined"), len(states)
    answer = not any(reasons_of.values())
    return _check(
        "determined",
        answer,
        reasons_of=reasons_of,
        vanishing=vanishing,
        count=count,
        all=varied,
        most=REASONS,
    )


def _vanishes(best: BestPoint, name: str, item: ParameterEstimate) -> bool:
    """Whether a parameter is consistent with zero and its upper bound is small."""
    if item.state != "weak" or item.ci95 is None or not may_vanish(name):
        return False
    size = float(best.problem.sizes((name,), best.values)[0])
    ends = (*item.ci95, *(item.range or ()))
    return bool(min(ends) <= 0.0 <= max(ends) and max(map(abs, ends)) <= WEAK * size)


def _visited(best: BestPoint, estimates: Estimates) -> Check:
    wanted = [law.needed for law in best.problem.model.laws]
    seen = visited(best.problem, best.simulated)
    absent = {
        spring: [branch for branch in branches if branch not in covered(seen[spring])]
        for spring, branches in zip(seen, wanted, strict=True)
    }
    lost = [f"{branch} of {spring}" for spring, gone in absent.items() for branch in gone]
    # It matters if a parameter that varies depends on it; its own warning says so.
    depend = any(
        item.state == "not determined" and absent.get(f"s{split_name(name)[0] + 1}")
        for name, item in estimates.items()
    )
    answer = True if not lost else False if depend else None
    every = tuple(dict.fromkeys(chain.from_iterable(wanted)))
    return _check("visited", answer, wanted=every, lost=lost)


def _of_intervals(
    best: BestPoint, estimates: Estimates, intervals: Intervals, known: Sequence[str]
) -> Iterator[Check]:
    made = Counter(item.ci95_method for item in estimates.values() if item.ci95_method)
    answer = False if intervals.warnings else True if made else None
    yield _check("intervals", answer, warnings=intervals.warnings, made=made)
    stuck, natural = [], []
    varied = tuple(name for name in known if estimates[name].vary)
    for name, size in zip(varied, best.problem.sizes(varied, best.values), strict=True):
        for bound in best.limits(name):
            if abs(best.values[best.index[name]] - bound) > AT_LIMIT * size:
                continue
            if bound == 0.0 and may_vanish(name):
                natural.append(name)
            else:
                stuck.append((name, bound))
    yield _check("bounds", not stuck, stuck=stuck, natural=natural)


def _of_test(best: BestPoint, balance: EnergyAudit) -> Iterator[Check]:
    test = best.problem.measurement
    wrong = [note for note in test.notes if CONTRADICTED in note]
    asked = [note for note in test.notes if note.startswith(ASKED) and note not in wrong]
    moves = best.problem.objective.drive == "impact" and test.displacement is not None
    yield _check("velocity", not wrong if moves else None, warnings=wrong if moves else ())
    yield _check("input", not asked, warnings=asked)
    taken, warnings = balance.absorbed_over_striker, balance.energy_warnings()
    unknown = not warnings and (taken is None or balance.motion == INTEGRATED)
    answer = None if unknown else not warnings
    yield _check("energy", answer, warnings=warnings, taken=taken)
    ratio, warnings = balance.impulse_ratio, balance.impulse_warnings()
    answer = None if ratio is None else not warnings
    yield _check("impulse", answer, warnings=() if ratio is None else warnings, ratio=ratio)


def _damping(best: BestPoint, known: Sequence[str]) -> Check:
    """Whether a driven single spring plainly lacks the damping (Pa·s) that was left out."""
    problem, name = best.problem, "s1_eta"
    if problem.objective.drive != "displacement" or not best.names:
        return _check("damping", None)
    held, alone, eta = problem.params[name], len(problem.model.kinds) == 1, 0.0
    if alone and problem.measurement.time is not None and not held.vary and held.value == 0.0:
        column = problem.slopes(best.values, (name,))[:, 0]
        size = float(problem.sizes((name,), best.values)[0])
        eta = max(_one_step(best, known, column, size) or 0.0, 0.0)
    return _check("damping", eta == 0.0, eta=eta)


def _time_shift(best: BestPoint, estimates: Estimates, known: Sequence[str]) -> Check:
    test, objective = best.problem.measurement, best.problem.objective
    force = test.outliers.get("stress")
    clipped = force is not None and force.clipped_at is not None
    facts: dict[str, Any] = {"held": False, "clipped": clipped, "shift": None}
    if objective.time_shift:
        shift = estimates.get("time_shift")
        facts |= {"held": shift is None or not shift.vary, "shift": shift and shift.value}
        return _check("time_shift", None if facts["held"] else True, **facts)
    with suppress(InputError):
        check_time_shift(test, objective.drive)
        if not clipped:
            late = _shift_hint(best, known) or 0.0
            return _check("time_shift", late == 0.0, late=late, **facts)
    return _check("time_shift", None, **facts)


def _shift_hint(best: BestPoint, determined: Sequence[str]) -> float | None:
    """Time (s) by which the motion channel is late, where the test plainly shows it, else None.

    Read off the residuals by one linear step, accepted above a quarter of a sample; where a large
    shift has spoilt the fit, off the balance of the striker's motion. The test must have both
    channels in time; see `fitting.curves.check_time_shift`.
    """
    objective, there = best.problem.objective, best.simulated
    gap = float(np.median(np.diff(objective.time)))
    early, late = (
        objective.compare(replace(there, curves=objective.shifted(there, side * gap)), best.values)
        for side in (-0.5, 0.5)
    )
    found = _one_step(best, determined, (late - early) / gap, gap)
    if found is not None and abs(found) > 0.25 * gap:
        return found
    return _shift_of_motion(best.problem)


def _one_step(
    best: BestPoint, determined: Sequence[str], column: Array, size: float
) -> float | None:
    """Value of a parameter that was left out, by one linear step of it and all determined ones.

    `column` is the slope of the residual by it, `size` its scale. None unless it is more than four
    standard errors and the step takes a fifth of χ².
    """
    problem, residual = best.problem, best.residual
    jacobian = np.column_stack([best.jacobian[:, [*map(best.names.index, determined)]], column])
    sizes = np.append(problem.sizes(tuple(determined), best.values), size)
    move = sizes * np.linalg.lstsq(jacobian * sizes, -residual, rcond=1e-10)[0]
    left = residual + jacobian @ move
    if left @ left >= 0.8 * float(residual @ residual):
        return None
    spread = covariance(jacobian, left, problem.objective.sizes, sizes)
    return float(move[-1]) if abs(move[-1]) > 4.0 * spread.stderr[-1] else None


def _shift_of_motion(problem: Problem) -> float | None:
    """Time (s) by which the motion is late, where the striker's balance of motion plainly shows it.

    m w'' = -F: the force, integrated twice, gives the motion but for its scale and its zero.
    Accepted where a shift of a sample or more halves what is left, down to the noise, or takes nine
    tenths.
    """
    test, striker = problem.measurement, problem.measurement.striker
    time, stress, motion = test.time, test.stress, test.displacement
    if problem.objective.drive != "impact" or time is None or stress is None or motion is None:
        return None
    assert striker is not None
    assert striker.velocity is not None
    dt = np.diff(time, prepend=min(time[0], 0.0))
    slowed = np.cumsum(dt * (stress - 0.5 * np.diff(stress, prepend=0.0)))
    braked = np.cumsum(dt * (slowed - 0.5 * np.diff(slowed, prepend=0.0)))
    shifts = np.linspace(-0.1, 0.1, 401) * float(time[-1])
    left = []
    for late in shifts:
        when = time - late
        columns = np.column_stack([np.interp(when, time, braked), np.ones(time.size)])
        fall = 0.5 * (striker.gravity or 0.0) * when
        free = motion - (striker.velocity + fall) * when
        left.append(float(np.linalg.lstsq(columns, free, rcond=None)[1].sum()))
    best, none = int(np.argmin(left)), left[shifts.size // 2]
    floor = 4.0 * problem.objective.noise("displacement_time").sigma ** 2 * time.size
    plain = 0 < best < shifts.size - 1 and left[best] < (0.5 if left[best] < floor else 0.1) * none
    gap = float(np.median(np.diff(time)))
    return float(shifts[best]) if plain and abs(shifts[best]) > gap else None
