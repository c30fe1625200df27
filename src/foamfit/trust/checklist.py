"""What a fit must pass before it is called good: one question each, and the status that follows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import chain, groupby

import numpy as np

from foamfit.data.energy import EnergyAudit
from foamfit.data.measurement import ASKED, INTEGRATED
from foamfit.data.zeros import CONTRADICTED
from foamfit.errors import InputError
from foamfit.fitting.branches import covered, visited
from foamfit.fitting.curves import check_time_shift
from foamfit.fitting.objective import Objective
from foamfit.fitting.search import SearchRecord
from foamfit.results import Check, Intervals, ParameterEstimate
from foamfit.springs.parameters import NUISANCE, split_name
from foamfit.text import engineering, listed, percent
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import AT_LIMIT, WEAK
from foamfit.trust.time_shift import damping_hint, shift_hint

# A curve was not fitted if it is off by more than this share of its own standard deviation; it is
# fitted poorly if it is off by more than this share of its range.
UNACCEPTABLE = 0.5
POOR = 0.05
# Residuals over noise up to which they count as noise: a stated noise is seldom known better than
# to a tenth, an estimated one to a half.
STATED, ESTIMATED = 1.1, 1.5
# Autocorrelation time, samples, from which on residuals count as structured.
STRUCTURED = 5.0
# Reasons that one warning gives at most; more of them are read better in the table of parameters.
REASONS = 3
# Parameters that may be zero: their interval tells whether there is anything at all.
MAY_VANISH = ("dsigma", "kh_plus", "kh_minus", "eta")


# Answer, what it rests on, warnings, and whether a "no" is fatal: the last fields of a `Check`.
_Answer = (
    tuple[bool | None, str]
    | tuple[bool | None, str, tuple[str, ...]]
    | tuple[bool | None, str, tuple[str, ...], bool]
)


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
    """Warnings of a fit, in the order of its checklist but what is wrong with the input first."""
    return input_first(warning for check in checklist for warning in check.warnings)


def input_first(warnings: Iterable[str]) -> tuple[str, ...]:
    """Each warning once, what `foamfit check` finds wrong before all others."""
    return tuple(sorted(dict.fromkeys(warnings), key=lambda text: not text.startswith(ASKED)))


def make_checklist(findings: Findings) -> tuple[Check, ...]:
    """Put all questions, what matters most first."""
    return tuple(
        Check(key, question, *answer(findings)) for key, (question, answer) in QUESTIONS.items()
    )


# ---------------------------------------------------------------- the search


def _ended(e: Findings) -> _Answer:
    if e.record.stopped is None:
        return True, f"{e.objective.evaluations} simulations."
    told = f"stopped by {e.record.stopped}"
    return False, f"It was {told}.", (f"The search was {told}; this is the best point until then.",)


def _agree(e: Findings) -> _Answer:
    if e.record.stopped is not None or not e.record.costs:
        return None, "The search was stopped before it could tell."
    total = sum(count for _, count in e.record.costs)
    if e.record.agreeing > 1:
        return True, f"{e.record.agreeing} of {total} descents reached the best point."
    warning = "Only one of the descents reached the best point; try more starts."
    return False, f"One of {total} descents did.", (warning,)


def _simulated(e: Findings) -> _Answer:
    failed, tried = e.objective.failures, max(e.objective.evaluations, 1)
    found = f"{failed} of {tried} could not."
    if failed <= 0.5 * tried:
        return True, found
    warning = f"{failed} of {tried} trials could not be simulated; the bounds may be wrong."
    return False, found, (warning,)


def _vibration(e: Findings) -> _Answer:
    if not e.objective.interior_mass or len(e.best.problem.model.kinds) == 1:
        return True, "No interior mass vibrates."
    warning = (
        "With interior masses the cost has a minimum for every cycle of their vibration: trust no "
        "parameter that other seeds, or the fit without them, do not confirm."
    )
    return False, "The interior masses vibrate.", (warning,)


# ---------------------------------------------------------------- the curves


def _followed(e: Findings) -> _Answer:
    warnings, fatal = [], False
    for name in e.objective.counted:
        off, measured = e.misfit[name] or 0.0, e.objective.measured[name]
        lost = off * float(np.ptp(measured)) > UNACCEPTABLE * float(np.std(measured))
        fatal = fatal or lost
        if off > POOR or lost:
            word = "is not acceptable" if lost else "is large"
            warnings.append(f"The misfit of {name} is {off:.1%} of its range, which {word}.")
    told = ", ".join(f"{_spoken(name)} {e.misfit[name] or 0.0:.1%}" for name in e.objective.counted)
    return not warnings, f"Misfit over range: {told}.", tuple(warnings), fatal


def _at_noise(e: Findings) -> _Answer:
    """Whether the residuals are noise: their size, an error of the law, and their correlation.

    This is the one verdict about the noise; `Fit.at_noise` has its answer.
    """
    told, warnings = _over_noise(e)
    missed = _missed(e)
    longest = max(e.tau, default=1.0)
    if missed:
        told.append(f"error of the law, RMS over range: {', '.join(missed)}")
        warnings = [
            f"The residuals are systematic: the law misses {' and '.join(missed)} of the range. "
            "The 95 % intervals cover noise only; the range includes this error."
        ]
    elif longest > STRUCTURED:
        warnings.append(
            f"The residuals are correlated over {longest:.0f} samples; the intervals account for "
            "it."
        )
    if not missed and longest >= 1.05:
        told.append(f"correlated over {longest:.2g} samples")
    known = any(e.objective.noise(name).sigma > 0.0 for name in e.objective.counted)
    if not (warnings or (told and known)):
        return None, "The noise is neither stated nor estimated."
    found = "; ".join(told)
    return not warnings, f"{found[0].upper()}{found[1:]}.", tuple(warnings)


def _over_noise(e: Findings) -> tuple[list[str], list[str]]:
    """Residuals over the noise of each curve, and a warning where they are more than noise.

    A chi-square scatters by itself, which counts for them.
    """
    objective, ratios, warnings = e.objective, [], []
    for i, (name, rms) in enumerate(objective.rms(e.best.residual).items()):
        noise, stated = objective.noise(name).sigma, objective.noise(name).given
        if noise <= 1e-9 * objective.scale[name]:  # there is none to be seen
            continue
        tau = e.tau[i] if e.tau else 1.0
        scatter = 3.0 * math.sqrt(tau / (2.0 * objective.sizes[i]))
        source = "stated" if stated else "estimated"
        ratios.append(f"{_spoken(name)} {rms / noise:.2f} ({source})")
        if rms > ((STATED if stated else ESTIMATED) + scatter) * noise:
            warnings.append(
                f"The residuals of {name} are {rms / noise:.1f} times the {source} noise: the "
                "model does not follow all that was measured."
            )
    return ([f"residuals over noise: {', '.join(ratios)}"] if ratios else []), warnings


def _missed(e: Findings) -> list[str]:
    """Curves of which the law misses more than noise, and by how much of their range."""
    if not e.tau:
        return []
    objective = e.objective
    return [
        f"{_spoken(name)} {percent(error.law / objective.factor(name) / spread)}"
        for name, error in zip(objective.counted, e.best.errors, strict=True)
        if error.found and (spread := float(np.ptp(objective.measured[name])))
    ]


# ---------------------------------------------------------------- the parameters


def _determined(e: Findings) -> _Answer:
    """Ask for the states of the springs; a small upper bound of a parameter is enough.

    A nuisance parameter that is not determined shows in the intervals of those that are wanted.
    """
    own = {name: item for name, item in e.estimates.items() if name not in NUISANCE}
    warnings, vanishing = [], [name for name in own if _vanishes(e, name)]
    for state in ("not determined", "weak"):
        of = [
            (name, item.why)
            for name, item in own.items()
            if item.state == state and name not in vanishing
        ]
        if of:
            warnings.append(f"{state.capitalize()}: {_by_reason(of)}.")
    varied = [item.state for item in own.values() if item.state != "fixed"]
    found = f"{varied.count('determined')} of {len(varied)} are"
    if vanishing:
        found += f"; consistent with zero, with a small upper bound: {', '.join(vanishing)}"
    return not warnings, f"{found}.", tuple(warnings)


def _trusted(e: Findings) -> _Answer:
    made = Counter(item.ci95_method for item in e.estimates.values() if item.ci95_method)
    found = ", ".join(f"{n} by {method}" for method, n in made.items()) or "There are none"
    if e.intervals.warnings:
        return False, f"{found}; see the warning.", e.intervals.warnings
    return True if made else None, f"{found}."


def _vanishes(e: Findings, name: str) -> bool:
    """Whether a parameter is consistent with zero and its upper bound is small."""
    item = e.estimates[name]
    if item.state != "weak" or item.ci95 is None or split_name(name)[1] not in MAY_VANISH:
        return False
    size = float(e.best.problem.sizes((name,), e.best.values)[0])
    ends = (*item.ci95, *(item.range or ()))
    return min(ends) <= 0.0 <= max(ends) and float(np.max(np.abs(ends))) <= WEAK * size


def _by_reason(of: list[tuple[str, str]]) -> str:
    """Name each with its own reason, neighbours of one reason together; of many, names alone."""
    groups = [
        (why, ", ".join(name for name, _ in members))
        for why, members in groupby(of, key=lambda item: item[1])
    ]
    if len(groups) > REASONS:
        return f"{', '.join(name for name, _ in of)} (see why of each in the report)"
    return "; ".join(f"{names} ({why})" for why, names in groups)


def _visited(e: Findings) -> _Answer:
    wanted = [law.needed for law in e.best.problem.model.laws]
    absent = {
        spring: [branch for branch in branches if branch not in covered(seen)]
        for branches, (spring, seen) in zip(
            wanted, visited(e.best.problem, e.best.simulated).items(), strict=True
        )
        if branches
    }
    lost = [f"{branch} of {spring}" for spring, gone in absent.items() for branch in gone]
    if not absent:
        return True, "Linear springs have one branch."
    if not lost:
        return True, f"{listed(dict.fromkeys(chain.from_iterable(wanted)))} were."
    # It matters if some parameter that varies depends on it; its own warning says so.
    depend = any(
        item.state == "not determined" and absent.get(f"s{split_name(name)[0] + 1}")
        for name, item in e.estimates.items()
    )
    return False if depend else None, f"Not visited: {', '.join(lost)}."


def _bounds(e: Findings) -> _Answer:
    params, varied = e.best.problem.params, [n for n, item in e.estimates.items() if item.vary]
    sizes = e.best.problem.sizes(tuple(varied), e.best.values)
    stuck, natural = [], []
    for name, size in zip(varied, sizes, strict=True):
        for bound in (params[name].min, params[name].max):
            off = abs(e.best.values[e.best.index[name]] - bound)
            if off > AT_LIMIT * size or e.estimates[name].stderr is None:
                continue
            if bound == 0.0 and split_name(name)[1] in MAY_VANISH:
                natural.append(f"{name} is zero, which it may be")
            else:
                stuck.append(f"{name} lies at {bound:g}")
    return not stuck, f"{', '.join([*stuck, *natural]) or 'None lies at one'}."


# ---------------------------------------------------------------- the test itself


def _flight(e: Findings) -> _Answer:
    measurement = e.best.problem.measurement
    if e.objective.drive != "impact" or measurement.displacement is None:
        return None, "The test has no motion that could tell."
    wrong = tuple(note for note in measurement.notes if CONTRADICTED in note)
    if wrong:
        return False, "See the warning.", wrong
    return True, "Nothing recorded contradicts it."


def _input(e: Findings) -> _Answer:
    notes = e.best.problem.measurement.notes
    asked = tuple(n for n in notes if n.startswith(ASKED) and CONTRADICTED not in n)
    return not asked, "See the warnings." if asked else "Nothing stands out.", asked


def _energy(e: Findings) -> _Answer:
    taken, warnings = e.balance.absorbed_over_striker, tuple(e.balance.energy_warnings())
    if taken is None and not warnings:
        return None, "The test does not state enough for this."
    if e.balance.motion == INTEGRATED and not warnings:
        return None, "The motion comes from the force."
    found = "The loop returns more energy than it takes up."
    if taken is not None:
        found = f"The foam absorbs {taken:.2f} of the striker's energy."
    return not warnings, found, warnings


def _impulse(e: Findings) -> _Answer:
    ratio, warnings = e.balance.impulse_ratio, tuple(e.balance.impulse_warnings())
    if ratio is None:
        return None, "The test does not state enough for this."
    found = f"The impulse of the force is {ratio:.2f} of the striker's change of momentum."
    return not warnings, found, warnings


def _time_shift(e: Findings) -> _Answer:
    measurement = e.best.problem.measurement
    if e.objective.time_shift:
        if (shift := e.estimates.get("time_shift")) is None or not shift.vary:
            return None, "The time shift is held."
        late = engineering(shift.value, "s").replace("-", "−")
        return True, f"The time shift is fitted: {late}."
    force = measurement.outliers.get("stress")
    if force is not None and force.clipped_at is not None:
        return None, "The force is clipped, which looks like a time shift of its peak."
    try:
        check_time_shift(measurement, e.objective.drive)
    except InputError:
        return None, "Not both channels were measured in time."
    found = shift_hint(e.best, [n for n, item in e.estimates.items() if item.stderr is not None])
    if found is None:
        return True, "A time shift would not lower the residuals."
    told = f"{'late' if found > 0.0 else 'early'} by {engineering(abs(found), 's')}"
    warning = (
        f"The motion channel seems to be {told} against the force; fit the time shift by "
        "--time-shift (time_shift=True)."
    )
    return False, f"The motion seems {told}.", (warning,)


def _damping(e: Findings) -> _Answer:
    if e.objective.drive != "displacement" or not e.best.names:
        return None, "Only under a driven motion is it left out."
    found = damping_hint(e.best, [n for n, item in e.estimates.items() if item.stderr is not None])
    if found is None:
        return True, "A dashpot would not lower the residuals much."
    size = engineering(found, "Pa s").replace("Pa s", "Pa·s")
    warning = (
        f"A dashpot of about {size}, which was left out, would lower the residuals; fit it by "
        "--vary s1_eta, else it distorts the other parameters."
    )
    return False, f"A dashpot of about {size} would lower the residuals.", (warning,)


def _spoken(name: str) -> str:
    return name.replace("_", "-")


QUESTIONS: dict[str, tuple[str, Callable[[Findings], _Answer]]] = {
    "ended": ("Did the search end by itself?", _ended),
    "followed": ("Does the model follow the curves?", _followed),
    "input": ("Is the input as it should be?", _input),
    "velocity": ("Is the striker's velocity that of its motion?", _flight),
    "noise": ("Are the residuals at the estimated noise?", _at_noise),
    "determined": ("Are all parameters determined?", _determined),
    "intervals": ("Are the intervals those that were asked for?", _trusted),
    "visited": ("Was every branch of every spring visited?", _visited),
    "bounds": ("Are all parameters off their bounds?", _bounds),
    "agree": ("Do several starts agree?", _agree),
    "vibration": ("Is the cost free of the minima that a vibrating mass makes?", _vibration),
    "simulated": ("Could most trials be simulated?", _simulated),
    "energy": ("Does the energy balance hold?", _energy),
    "impulse": ("Does the momentum balance hold?", _impulse),
    "time_shift": ("Are force and motion free of a time shift?", _time_shift),
    "damping": ("Is the dashpot rightly left out?", _damping),
}
