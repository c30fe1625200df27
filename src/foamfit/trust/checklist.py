"""What a fit must pass before it is called good: one question each, and the status that follows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby

import numpy as np

from foamfit.arrays import Array
from foamfit.data.energy import EnergyAudit
from foamfit.data.measurement import ASKED, INTEGRATED
from foamfit.data.zeros import CONTRADICTED
from foamfit.errors import InputError
from foamfit.fitting.branches import covered, visited
from foamfit.fitting.curves import check_time_shift
from foamfit.fitting.objective import Objective
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import SearchRecord
from foamfit.results import Check, Intervals, ParameterEstimate
from foamfit.springs.parameters import NUISANCE, any_param, split_name
from foamfit.text import engineering, listed, percent
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


@dataclass(frozen=True, eq=False)
class Findings:
    """The best point, how it was found, and what was measured."""

    best: BestPoint
    estimates: Mapping[str, ParameterEstimate]
    misfit: dict[str, float | None]
    record: SearchRecord
    balance: EnergyAudit
    intervals: Intervals

    @property
    def objective(self) -> Objective:
        """What was minimised."""
        return self.best.problem.objective

    @property
    def known(self) -> list[str]:
        """Parameters that have a standard error."""
        return [name for name, item in self.estimates.items() if item.stderr is not None]


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


def make_checklist(findings: Findings) -> tuple[Check, ...]:
    """Answer all questions, in the order of `sentences.toml`."""
    groups = (_of_search, _of_curves, _of_parameters, _of_test, _of_what_is_left_out)
    found = {check.key: check for answers in groups for check in answers(findings)}
    return tuple(found[key] for key in SENTENCES["check"])


def _check(
    key: str,
    answer: bool | None,
    case: str = "",
    *,
    warnings: Iterable[str] | None = None,
    fatal: bool = False,
    **facts: object,
) -> Check:
    """Check of `sentences.toml`; `case` names its sentence if not that of the answer alone."""
    table = SENTENCES["check"][key]
    said = table[case or {True: "yes", False: "no", None: "unknown"}[answer]].format(**facts)
    if warnings is None:
        told = table.get("warning") if answer is False else None
        warnings = [told.format(**facts)] if told else []
    return Check(key, table["question"], answer, said, tuple(warnings), fatal)


def _of_search(e: Findings) -> Iterator[Check]:
    by, objective = e.record.stopped, e.objective
    yield _check("ended", by is None, by=by, count=objective.evaluations)
    total, agreeing = sum(count for _, count in e.record.costs), 0
    if by is None and total:
        agreeing = e.record.agreeing
    yield _check("agree", agreeing > 1 if agreeing else None, total=total, agreeing=agreeing)
    failed, tried = objective.failures, max(objective.evaluations, 1)
    yield _check("simulated", failed <= 0.5 * tried, failed=failed, tried=tried)
    vibrates = objective.interior_mass and len(e.best.problem.model.kinds) > 1
    yield _check("vibration", not vibrates)


def _of_curves(e: Findings) -> Iterator[Check]:
    told, warnings, fatal = [], [], False
    for name in e.objective.counted:
        off, measured = e.misfit[name] or 0.0, e.objective.measured[name]
        lost = off * float(np.ptp(measured)) > UNACCEPTABLE * float(np.std(measured))
        fatal = fatal or lost
        told.append(f"{name.replace('_', '-')} {off:.1%}")
        if off > POOR or lost:
            warnings.append(say("check.followed", "lost" if lost else "large", curve=name, off=off))
    found = ", ".join(told)
    yield _check("followed", not warnings, warnings=warnings, fatal=fatal, misfits=found)
    yield _at_noise(e)


def _at_noise(e: Findings) -> Check:
    """Whether the residuals are noise: by their size, an error of the law, and their correlation.

    This is the only verdict on the noise; `Fit.at_noise` has its answer.
    """
    objective, known, longest = e.objective, False, 1.0
    errors = e.best.errors if e.best.names else (None,) * len(objective.counted)
    rms = objective.rms(e.best.residual)
    ratios, missed, warnings = list[str](), list[str](), list[str]()
    for name, size, error in zip(objective.counted, objective.sizes, errors, strict=True):
        noise, spoken = objective.noise(name), name.replace("_", "-")
        span, tau = float(np.ptp(objective.measured[name])), error.noise.tau if error else 1.0
        known, longest = known or noise.sigma > 0.0, max(longest, tau)
        if error and error.found and span:
            missed.append(f"{spoken} {percent(error.law / objective.factor(name) / span)}")
        if noise.sigma <= 1e-9 * objective.scale[name]:  # too small to be seen
            continue
        source, most = ("stated", STATED) if noise.given else ("estimated", ESTIMATED)
        ratio = rms[name] / noise.sigma
        ratios.append(f"{spoken} {ratio:.2f} ({source})")
        # Three standard deviations of the RMS of so many effective samples.
        if ratio > most + 3.0 * math.sqrt(tau / (2.0 * size)):
            told = say("check.noise", "large", curve=name, ratio=ratio, source=source)
            warnings.append(told)
    found = [say("check.noise", "ratios", ratios=", ".join(ratios))] if ratios else []
    if missed:
        found.append(say("check.noise", "missed", missed=", ".join(missed)))
        warnings = [say("check.noise", "law", missed=" and ".join(missed))]
    elif longest > STRUCTURED:
        warnings = [say("check.noise", "long", tau=longest)]
    if not missed and longest >= 1.05:
        found.append(say("check.noise", "correlated", tau=longest))
    if not warnings and not (found and known):
        return _check("noise", None)
    sentence = "; ".join(found)
    sentence = sentence[0].upper() + sentence[1:]
    return _check("noise", not warnings, warnings=warnings, found=sentence)


def _determined(e: Findings) -> Check:
    """Whether the springs' parameters are; a small upper bound of one that may vanish is enough.

    A nuisance parameter that is not determined shows in the intervals of the others.
    """
    own = {name: item for name, item in e.estimates.items() if name not in NUISANCE}
    vanishing, warnings = [name for name in own if _vanishes(e, name)], list[str]()
    named = [(name, item) for name, item in own.items() if name not in vanishing]
    for state in ("not determined", "weak"):
        of = {name: item.why for name, item in named if item.state == state}
        groups = [(", ".join(names), why) for why, names in groupby(of, key=of.__getitem__)]
        told = "; ".join(f"{names} ({why})" for names, why in groups)
        if len(groups) > REASONS:
            told = say("check.determined", "many", names=", ".join(of))
        if of:
            warnings.append(say("check.determined", "state", state=state.capitalize(), names=told))
    states = [item.state for item in own.values() if item.state != "fixed"]
    zero = say("check.determined", "vanishing", names=", ".join(vanishing)) if vanishing else ""
    count, varied = states.count("determined"), len(states)
    return _check(
        "determined", not warnings, warnings=warnings, count=count, all=varied, vanishing=zero
    )


def _vanishes(e: Findings, name: str) -> bool:
    """Whether a parameter is consistent with zero and its upper bound is small."""
    item = e.estimates[name]
    if item.state != "weak" or item.ci95 is None or not may_vanish(name):
        return False
    size = float(e.best.problem.sizes((name,), e.best.values)[0])
    ends = (*item.ci95, *(item.range or ()))
    return bool(min(ends) <= 0.0 <= max(ends) and max(map(abs, ends)) <= WEAK * size)


def _visited(e: Findings) -> Check:
    problem = e.best.problem
    wanted = [law.needed for law in problem.model.laws]
    if not any(wanted):
        return _check("visited", True, "linear")
    seen = visited(problem, e.best.simulated)
    absent = {
        spring: [branch for branch in branches if branch not in covered(seen[spring])]
        for spring, branches in zip(seen, wanted, strict=True)
    }
    lost = [f"{branch} of {spring}" for spring, gone in absent.items() for branch in gone]
    # It matters if a parameter that varies depends on it; its own warning says so.
    depend = any(
        item.state == "not determined" and absent.get(f"s{split_name(name)[0] + 1}")
        for name, item in e.estimates.items()
    )
    answer = True if not lost else False if depend else None
    every = listed(dict.fromkeys(chain.from_iterable(wanted)))
    return _check("visited", answer, wanted=every, lost=", ".join(lost))


def _of_parameters(e: Findings) -> Iterator[Check]:
    yield _determined(e)
    yield _visited(e)
    counts = Counter(item.ci95_method for item in e.estimates.values() if item.ci95_method)
    made = ", ".join(f"{n} by {method}" for method, n in counts.items()) or "There are none"
    answer = False if e.intervals.warnings else True if counts else None
    yield _check("intervals", answer, warnings=e.intervals.warnings, made=made)
    stuck, natural = [], []
    varied = tuple(name for name in e.known if e.estimates[name].vary)
    for name, size in zip(varied, e.best.problem.sizes(varied, e.best.values), strict=True):
        for bound in e.best.limits(name):
            if abs(e.best.values[e.best.index[name]] - bound) > AT_LIMIT * size:
                continue
            if bound == 0.0 and may_vanish(name):
                natural.append(f"{name} is zero, which it may be")
            else:
                stuck.append(f"{name} lies at {bound:g}")
    yield _check("bounds", not stuck, at=", ".join([*stuck, *natural]) or "None lies at one")


def _of_test(e: Findings) -> Iterator[Check]:
    test, balance = e.best.problem.measurement, e.balance
    wrong = [note for note in test.notes if CONTRADICTED in note]
    asked = [note for note in test.notes if note.startswith(ASKED) and note not in wrong]
    moves = e.objective.drive == "impact" and test.displacement is not None
    yield _check("velocity", not wrong if moves else None, warnings=wrong if moves else ())
    yield _check("input", not asked, warnings=asked)
    taken, warnings = balance.absorbed_over_striker, balance.energy_warnings()
    if not warnings and (taken is None or balance.motion == INTEGRATED):
        yield _check("energy", None, "unknown" if taken is None else "integrated")
    else:
        case = "returns" if taken is None else ""
        yield _check("energy", not warnings, case, warnings=warnings, taken=taken)
    ratio, warnings = balance.impulse_ratio, balance.impulse_warnings()
    answer = None if ratio is None else not warnings
    yield _check("impulse", answer, warnings=() if ratio is None else warnings, ratio=ratio)


def _of_what_is_left_out(e: Findings) -> Iterator[Check]:
    yield _time_shift(e)
    if e.objective.drive != "displacement" or not e.best.names:
        yield _check("damping", None)
        return
    eta = _damping_hint(e.best, e.known) or 0.0
    yield _check("damping", eta == 0.0, size=engineering(eta, "Pa·s"))


def _time_shift(e: Findings) -> Check:
    test = e.best.problem.measurement
    if e.objective.time_shift:
        if (shift := e.estimates.get("time_shift")) is None or not shift.vary:
            return _check("time_shift", None, "held")
        told = engineering(shift.value, "s").replace("-", "−")
        return _check("time_shift", True, "fitted", shift=told)
    force = test.outliers.get("stress")
    if force is not None and force.clipped_at is not None:
        return _check("time_shift", None, "clipped")
    try:
        check_time_shift(test, e.objective.drive)
    except InputError:
        return _check("time_shift", None)
    late = _shift_hint(e.best, e.known) or 0.0
    told = f"{'late' if late > 0.0 else 'early'} by {engineering(abs(late), 's')}"
    return _check("time_shift", late == 0.0, late=told)


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


def _damping_hint(best: BestPoint, determined: Sequence[str]) -> float | None:
    """Damping (Pa·s) that a single spring lacks under a driven motion, where it is plain."""
    problem, name = best.problem, "s1_eta"
    held = problem.params[name]
    alone = problem.objective.drive == "displacement" and len(problem.model.kinds) == 1
    if not alone or problem.measurement.time is None or held.vary or held.value != 0.0:
        return None
    column = problem.linear.slopes(best.values, (name,))[:, 0]
    size = float(problem.sizes((name,), best.values)[0])
    eta = _one_step(best, determined, column, size)
    return eta if eta is not None and eta > 0.0 else None


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
