"""What a fit must pass before it is called good: one question each, and the status that follows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from foamfit.data.energy import EnergyAudit
from foamfit.data.measurement import INTEGRATED
from foamfit.errors import InputError
from foamfit.fitting.branches import visited
from foamfit.fitting.curves import check_time_shift
from foamfit.fitting.objective import Objective
from foamfit.fitting.search import SearchRecord
from foamfit.results import Check, ParameterEstimate
from foamfit.springs.parameters import split_name
from foamfit.text import engineering
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import AT_LIMIT, WEAK
from foamfit.trust.intervals import Intervals
from foamfit.trust.time_shift import shift_hint

# A curve was not fitted if it is off by more than this share of its own standard deviation; it is
# fitted poorly if it is off by more than this share of its range.
UNACCEPTABLE = 0.5
POOR = 0.05
# Residuals over noise up to which the noise floor counts as reached: a stated noise is seldom known
# better than to a tenth, an estimated one to a half.
STATED, ESTIMATED = 1.1, 1.5
# Autocorrelation time, samples, from which on residuals count as structured.
STRUCTURED = 5.0
# Reasons that one warning gives at most; more of them are read better in the table of parameters.
REASONS = 3
BRANCHES = ("a", "d", "c", "e")
# Parameters that may be zero: their interval tells whether there is anything at all.
MAY_VANISH = ("dsigma", "kh_plus", "kh_minus", "eta")


@dataclass(frozen=True, eq=False)
class Findings:
    """What the questions are put to: the best point, how it was found, and what was measured."""

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
    def tau(self) -> tuple[float, ...]:
        """Autocorrelation time of the residual of each curve, samples; none without parameters."""
        return self.best.spread.tau if self.best.names else ()


def status_of(checklist: Iterable[Check]) -> str:
    """Status of a fit: "failed" after a fatal no, "warnings" after any other, else "ok"."""
    wrong = [check for check in checklist if check.answer is False]
    if any(check.fatal for check in wrong):
        return "failed"
    return "warnings" if wrong else "ok"


def warnings_of(checklist: Iterable[Check]) -> tuple[str, ...]:
    """Warnings of a fit, in the order of its checklist."""
    return tuple(warning for check in checklist for warning in check.warnings)


def make_checklist(findings: Findings) -> tuple[Check, ...]:
    """Put all questions, what matters most first."""
    questions: tuple[Callable[[Findings], Check], ...] = (
        _ended, _followed, _floor, _determined, _trusted, _visited, _bounds, _agree, _structure,
        _vibration, _simulated, _energy, _impulse, _time_shift,
    )  # fmt: skip
    return tuple(question(findings) for question in questions)


# ---------------------------------------------------------------- the search


def _ended(e: Findings) -> Check:
    question, stopped = "Did the search end by itself?", e.record.stopped
    if stopped is None:
        return Check("ended", question, True, f"{e.objective.evaluations} simulations.")
    warning = f"The search was stopped by {stopped}; this is the best point until then."
    return Check("ended", question, False, f"It was stopped by {stopped}.", (warning,))


def _agree(e: Findings) -> Check:
    question, record = "Do several starts agree?", e.record
    if record.stopped is not None or not record.costs:
        return Check("agree", question, None, "The search was stopped before it could tell.")
    total = sum(count for _, count in record.costs)
    if record.agreeing > 1:
        found = f"{record.agreeing} of {total} descents reached the best point."
        return Check("agree", question, True, found)
    warning = "Only one of the descents reached the best point; try more starts."
    return Check("agree", question, False, f"One of {total} descents did.", (warning,))


def _simulated(e: Findings) -> Check:
    objective = e.objective
    failed, tried = objective.failures, max(objective.evaluations, 1)
    question = "Could most trials be simulated?"
    if failed <= 0.5 * tried:
        return Check("simulated", question, True, f"{failed} of {tried} could not.")
    warning = f"{failed} of {tried} trials could not be simulated; the bounds may be wrong."
    return Check("simulated", question, False, f"{failed} of {tried} could not.", (warning,))


def _vibration(e: Findings) -> Check:
    question = "Is the cost free of the minima that a vibrating mass makes?"
    if not e.objective.interior_mass or len(e.best.problem.model.kinds) == 1:
        return Check("vibration", question, True, "No interior mass vibrates.")
    warning = (
        "With interior masses the cost has a minimum for every cycle of their vibration: trust no "
        "parameter that other seeds, or the fit without them, do not confirm."
    )
    return Check("vibration", question, False, "The interior masses vibrate.", (warning,))


# ---------------------------------------------------------------- the curves


def missed(objective: Objective, misfit: Mapping[str, float | None], name: str) -> bool:
    """Whether a counted curve was not fitted at all."""
    measured = objective.measured[name]
    assert measured is not None
    return (misfit[name] or 0.0) * float(np.ptp(measured)) > UNACCEPTABLE * float(np.std(measured))


def _followed(e: Findings) -> Check:
    warnings, fatal = [], False
    for name in e.objective.counted:
        off, lost = e.misfit[name] or 0.0, missed(e.objective, e.misfit, name)
        fatal = fatal or lost
        if off > POOR or lost:
            word = "is not acceptable" if lost else "is large"
            warnings.append(f"The misfit of {name} is {off:.1%} of its range, which {word}.")
    told = ", ".join(f"{_spoken(name)} {e.misfit[name] or 0.0:.1%}" for name in e.objective.counted)
    question, found = "Does the model follow the curves?", f"Misfit over range: {told}."
    return Check("followed", question, not warnings, found, tuple(warnings), fatal)


def _floor(e: Findings) -> Check:
    """Residuals against the noise of each curve, with the scatter that a chi-square has itself."""
    objective, question = e.objective, "Is the noise floor reached?"
    told, warnings, sizes = [], [], objective.sizes
    for i, (name, rms) in enumerate(objective.rms(e.best.residual).items()):
        noise, stated = objective.noise(name).sigma, objective.noise(name).given
        if noise <= 1e-9 * objective.scale[name]:  # there is none to be seen
            continue
        tau = e.tau[i] if e.tau else 1.0
        most = (STATED if stated else ESTIMATED) + 3.0 * math.sqrt(tau / (2.0 * sizes[i]))
        source = "stated" if stated else "estimated"
        told.append(f"{_spoken(name)} {rms / noise:.2f} ({source})")
        if rms > most * noise:
            warnings.append(
                f"The residuals of {name} are {rms / noise:.1f} times the {source} noise: the "
                "model does not follow all that was measured."
            )
    if not told:
        return Check("floor", question, None, "The noise is neither stated nor estimated.")
    found = f"Residuals over noise: {', '.join(told)}."
    return Check("floor", question, not warnings, found, tuple(warnings))


def _structure(e: Findings) -> Check:
    question = "Are the residuals free of structure?"
    if not e.tau:
        return Check("structure", question, None, "No parameter varies whose branch was reached.")
    longest = max(e.tau)
    found = f"Noise correlated over {longest:.2g} samples."
    if longest < 1.05:
        found = "Their autocorrelation is that of white noise."
    if longest <= STRUCTURED:
        return Check("structure", question, True, found)
    warning = (
        f"The residuals have structure: noise correlated over {longest:.0f} samples; the intervals "
        "account for it."
    )
    return Check("structure", question, False, found, (warning,))


# ---------------------------------------------------------------- the parameters


def _determined(e: Findings) -> Check:
    """Ask for the states; a parameter with a small upper bound is known well enough."""
    warnings, vanishing = [], [name for name in e.estimates if _vanishes(e, name)]
    for state in ("not determined", "weak"):
        of = [
            (name, item.why)
            for name, item in e.estimates.items()
            if item.state == state and name not in vanishing
        ]
        if of:
            warnings.append(f"{state.capitalize()}: {_by_reason(of)}.")
    varied = [item.state for item in e.estimates.values() if item.state != "fixed"]
    found = f"{varied.count('determined')} of {len(varied)} are"
    if vanishing:
        found += f"; consistent with zero, with a small upper bound: {', '.join(vanishing)}"
    question = "Are all parameters determined?"
    return Check("determined", question, not warnings, f"{found}.", tuple(warnings))


def _trusted(e: Findings) -> Check:
    question, warnings = "Are the intervals those that were asked for?", e.intervals.warnings
    made = Counter(item.ci95_method for item in e.estimates.values() if item.ci95_method)
    found = ", ".join(f"{n} by {method}" for method, n in made.items()) or "There are none"
    if warnings:
        return Check("intervals", question, False, f"{found}; see the warning.", warnings)
    return Check("intervals", question, True if made else None, f"{found}.")


def _vanishes(e: Findings, name: str) -> bool:
    """Whether a parameter is consistent with zero and its upper bound is small."""
    item = e.estimates[name]
    if item.state != "weak" or item.ci95 is None or split_name(name)[1] not in MAY_VANISH:
        return False
    size = float(e.best.problem.sizes((name,), e.best.values)[0])
    return item.ci95[0] <= 0.0 <= item.ci95[1] and max(np.abs(item.ci95)) <= WEAK * size


def _by_reason(of: list[tuple[str, str]]) -> str:
    """Name each with its own reason, neighbours of one reason together; of many, names alone."""
    groups = [
        (why, ", ".join(name for name, _ in members))
        for why, members in groupby(of, key=lambda item: item[1])
    ]
    if len(groups) > REASONS:
        return f"{', '.join(name for name, _ in of)} (see why of each in the report)"
    return "; ".join(f"{names} ({why})" for why, names in groups)


def _visited(e: Findings) -> Check:
    question = "Was every branch of every spring visited?"
    absent = {
        spring: [branch for branch in BRANCHES if branch not in seen]
        for spring, seen in visited(e.best.problem, e.best.simulated).items()
        if "a" in seen
    }
    lost = [f"{branch} of {spring}" for spring, gone in absent.items() for branch in gone]
    if not absent:
        return Check("visited", question, True, "Linear springs have one branch.")
    if not lost:
        return Check("visited", question, True, "a, d, c and e were.")
    # It matters if some parameter that varies depends on it; its own warning says so.
    depend = [
        name
        for name, item in e.estimates.items()
        if item.state == "not determined" and absent.get(f"s{split_name(name)[0] + 1}")
    ]
    found = f"Not visited: {', '.join(lost)}."
    return Check("visited", question, False if depend else None, found)


def _bounds(e: Findings) -> Check:
    question, params = "Are all parameters off their bounds?", e.best.problem.params
    varied = [name for name, item in e.estimates.items() if item.vary]
    sizes = e.best.problem.sizes(tuple(varied), e.best.values)
    stuck, natural = [], []
    for name, size in zip(varied, sizes, strict=True):
        value, edge = e.estimates[name].value, AT_LIMIT * size
        for bound in (params[name].min, params[name].max):
            if abs(value - bound) > edge or e.estimates[name].stderr is None:
                continue
            if bound == 0.0 and split_name(name)[1] in MAY_VANISH:
                natural.append(f"{name} is zero, which it may be")
            else:
                stuck.append(f"{name} lies at {bound:g}")
    found = ", ".join([*stuck, *natural]) or "None lies at one"
    return Check("bounds", question, not stuck, f"{found}.")


# ---------------------------------------------------------------- the test itself


def _energy(e: Findings) -> Check:
    question, taken = "Does the energy balance hold?", e.balance.absorbed_over_striker
    warnings = tuple(e.balance.energy_warnings())
    if taken is None and not warnings:
        return Check("energy", question, None, "The test does not state enough for this.")
    if e.balance.motion == INTEGRATED and not warnings:
        return Check("energy", question, None, "The motion comes from the force.")
    found = "The loop returns more energy than it takes up."
    if taken is not None:
        found = f"The foam absorbs {taken:.2f} of the striker's energy."
    return Check("energy", question, not warnings, found, warnings)


def _impulse(e: Findings) -> Check:
    question, ratio = "Does the momentum balance hold?", e.balance.impulse_ratio
    warnings = tuple(e.balance.impulse_warnings())
    if ratio is None:
        return Check("impulse", question, None, "The test does not state enough for this.")
    found = f"The impulse of the force is {ratio:.2f} of the striker's change of momentum."
    return Check("impulse", question, not warnings, found, warnings)


def _time_shift(e: Findings) -> Check:
    key, question = "time_shift", "Are force and motion free of a time shift?"
    measurement = e.best.problem.measurement
    if e.objective.time_shift:
        late = engineering(e.estimates["time_shift"].value, "s").replace("-", "−")
        return Check(key, question, True, f"The time shift is fitted: {late}.")
    force = measurement.outliers.get("stress")
    if force is not None and force.clipped_at is not None:
        told = "The force is clipped, which looks like a time shift of its peak."
        return Check(key, question, None, told)
    try:
        check_time_shift(measurement, e.objective.drive)
    except InputError:
        return Check(key, question, None, "Not both channels were measured in time.")
    determined = [name for name, item in e.estimates.items() if item.stderr is not None]
    found = shift_hint(e.best, determined)
    if found is None:
        return Check(key, question, True, "A time shift would not lower the residuals.")
    told = f"{'late' if found > 0.0 else 'early'} by {engineering(abs(found), 's')}"
    warning = (
        f"The motion channel seems to be {told} against the force; fit the time shift by "
        "--time-shift (time_shift=True)."
    )
    return Check(key, question, False, f"The motion seems {told}.", (warning,))


def _spoken(name: str) -> str:
    return name.replace("_", "-")
