"""Checklist of a fit: questions that a good fit answers with yes, and the resulting status."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from itertools import chain, groupby
from typing import Any

import numpy as np

from foamfit.data.energy import EnergyAudit
from foamfit.data.measurement import INTEGRATED, is_clipped
from foamfit.data.zeros import CONTRADICTED
from foamfit.errors import InputError
from foamfit.fitting.curves import check_time_shift
from foamfit.fitting.levenberg import descend
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.fitting.search import SearchRecord, Tracker, squares
from foamfit.parts import ParameterEstimate, covered
from foamfit.results import Check, Intervals
from foamfit.springs.parameters import NUISANCE, any_param, split_name, unit_of
from foamfit.text import ASKED
from foamfit.trust import SENTENCES, say
from foamfit.trust.best_point import BestPoint, visited
from foamfit.trust.covariance import WEAK, covariance

# A fit is unacceptable if the misfit of a curve exceeds this multiple of its standard deviation.
UNACCEPTABLE = 0.5
POOR = 0.05  # a fit is poor if the misfit of a curve exceeds this share of its range
# Largest ratio of residuals to noise that still counts as noise: a stated noise is seldom accurate
# to better than 10 %, an estimated one to better than 50 %.
STATED, ESTIMATED = 1.1, 1.5
BOUGHT = 0.02  # relative fall of the misfit by free contact and zeros that is not due to noise
# The curves contradict a prior if they differ by more than this many standard deviations of both.
AGAINST = 3.0
ALONE = 60  # iterations of a descent without a prior
# The stress is gone below this share of its peak, and a specimen has recovered below this share of
# the largest strain.
GONE, RECOVERED = 0.02, 0.5
STRUCTURED = 5.0  # residuals are correlated if their autocorrelation time, in samples, exceeds this
# Largest number of reasons in a warning; more are easier to read in the table of parameters.
REASONS = 3

Estimates = Mapping[str, ParameterEstimate]


def may_vanish(name: str) -> bool:
    """Whether zero is a neutral value of a parameter, at which its effect is absent."""
    return name not in NUISANCE and any_param(split_name(name)[1]).neutral == 0.0


def status_of(checklist: Iterable[Check]) -> str:
    """Return the status of a fit: "failed" after a fatal no, "warnings" after any other no."""
    fatal = [check.fatal for check in checklist if check.answer is False]
    return "failed" if any(fatal) else "warnings" if fatal else "ok"


def warnings_of(checklist: Iterable[Check]) -> tuple[str, ...]:
    """Return the warnings of a fit in the order of its checklist, those about the input first."""
    return input_first(warning for check in checklist for warning in check.warnings)


def input_first(warnings: Iterable[str]) -> tuple[str, ...]:
    """Return each warning once, those that `foamfit check` also gives before all others."""
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
    with_error = [name for name in best.names if estimates[name].stderr is not None]
    checks = (
        *_of_search(best, record),
        _followed(best, misfit),
        _at_noise(best, intervals),
        _of_record(best, estimates, record),
        _determined(best, estimates),
        _visited(best, estimates),
        *_of_intervals(best, estimates, intervals, with_error),
        *_of_priors(best, estimates, with_error),
        *([_check("recovery", False, lost=lost)] if (lost := lost_height(best)) else ()),
        *_of_test(best, balance),
        _time_shift(best, estimates),
        _damping(best),
    )
    by_key = {check.key: check for check in checks}
    return tuple(by_key[key] for key in SENTENCES["check"] if key in by_key)


def _check(key: str, answer: bool | None, *, fatal: bool = False, **facts: Any) -> Check:
    """Fill in a check of `sentences.toml`; the fact `warnings` replaces those given there."""
    table, section = SENTENCES["check"][key], f"check.{key}"
    case = {True: "yes", False: "no", None: "unknown"}[answer]
    sentence = say(section, case if case in table else "said", **facts)
    if (warnings := facts.get("warnings")) is None:
        warn = answer is False and "warning" in table
        warnings = say(section, "warning", **facts).splitlines() if warn else ()
    return Check(key, table["question"], answer, sentence, tuple(warnings), fatal)


def _of_search(best: BestPoint, record: SearchRecord) -> Iterator[Check]:
    by, objective = record.stopped, best.problem.objective
    yield _check("ended", by is None, by=by, count=objective.spent.evaluations)
    total = record.descents
    agreeing = record.agreeing if by is None and total else 0
    yield _check("agree", agreeing > 1 if agreeing else None, total=total, agreeing=agreeing)
    failed, tried = objective.spent.failures, max(objective.spent.evaluations, 1)
    yield _check("simulated", failed <= 0.5 * tried, failed=failed, tried=tried)
    vibrates = objective.interior_mass and len(best.problem.model.kinds) > 1
    yield _check("vibration", not vibrates)


def misfits_of(best: BestPoint, misfit: Mapping[str, float | None]) -> list[dict[str, Any]]:
    """Return the misfit of each fitted curve, whether it is large, and whether unacceptable."""
    objective, curves = best.problem.objective, []
    for name in objective.counted:
        share, measured = misfit[name] or 0.0, objective.measured[name]
        lost = share * float(np.ptp(measured)) > UNACCEPTABLE * float(np.std(measured))
        curves.append({"name": name, "off": share, "lost": lost, "poor": share > POOR or lost})
    return curves


def _followed(best: BestPoint, misfit: Mapping[str, float | None]) -> Check:
    curves = misfits_of(best, misfit)
    fine, fatal = not any(one["poor"] for one in curves), any(one["lost"] for one in curves)
    return _check("followed", fine, fatal=fatal, curves=curves)


def _at_noise(best: BestPoint, intervals: Intervals) -> Check:
    """Check by size, correlation and model error whether residuals are noise (`Fit.at_noise`)."""
    objective, has_noise, longest = best.problem.objective, False, 1.0
    errors = best.errors if best.names else (None,) * len(objective.counted)
    rms = objective.rms(best.residual)
    seen, missed = list[dict[str, Any]](), list[dict[str, Any]]()
    for name, size, error in zip(objective.counted, objective.sizes, errors, strict=True):
        noise, tau = objective.noise(name), error.noise.tau if error else 1.0
        has_noise, longest = has_noise or noise.sigma > 0.0, max(longest, tau)
        if error and error.found and (span := objective.span(name)):
            missed.append({"name": name, "missed": error.law / span})
        if noise.sigma > 1e-9 * objective.scale[name]:  # otherwise a ratio to it is meaningless
            source, most = ("stated", STATED) if noise.given else ("estimated", ESTIMATED)
            ratio = rms[name] / noise.sigma
            # Allow three standard deviations of the RMS of size/tau effective samples.
            large = ratio > most + 3.0 * math.sqrt(tau / (2.0 * size))
            seen.append({"name": name, "ratio": ratio, "source": source, "large": large})
    long, large = longest > STRUCTURED, any(one["large"] for one in seen)
    known = has_noise and bool(seen or longest >= 1.05)
    answer = False if missed or long or large else known or None
    facts: dict[str, Any] = {"seen": seen, "missed": missed, "tau": longest, "long": long}
    return _check("noise", answer, ranged=intervals.ranged, **facts)


def _of_record(best: BestPoint, estimates: Estimates, record: SearchRecord) -> Check:
    """Check whether free contact time and zeros would hide an error of the law."""
    freed = record.freed
    if freed is None:
        fitted = any(name in NUISANCE for name in best.names)
        return _check("record", fitted or None, names=())
    moves = dict[str, float]()
    for name, (held, free) in freed.moved.items():
        if name in estimates and (ends := estimates[name].ci95) is not None:
            moves[name] = abs(free - held) / max(ends[1] - ends[0], 1e-300)
    most, change = max(moves, key=moves.__getitem__, default=""), 0.0
    if moves.get(most, 0.0) > 1.0:
        held, free = freed.moved[most]
        change = abs(free - held) / best.size(most)
    answer = not (freed.free < (1.0 - BOUGHT) * freed.held or change)
    moved = most if change else ""
    return _check("record", answer, **asdict(freed) | {"moved": moved, "change": change})


def _determined(best: BestPoint, estimates: Estimates) -> Check:
    """Check whether the springs' parameters are determined, or zero with a small upper bound."""
    own = {name: item for name, item in estimates.items() if name not in NUISANCE}
    vanishing, reasons_of = [name for name in own if _vanishes(best, name, own[name])], {}
    for state in ("not determined", "weak"):
        why_of = {n: p.why for n, p in own.items() if p.state == state and n not in vanishing}
        groups = groupby(why_of, key=why_of.__getitem__)
        reasons_of[state] = [(", ".join(names), why) for why, names in groups]
    states = [item.state for item in own.values() if item.state != "fixed"]
    facts: dict[str, Any] = {"reasons_of": reasons_of, "vanishing": vanishing, "most": REASONS}
    facts |= {"count": states.count("determined"), "all": len(states)}
    return _check("determined", not any(reasons_of.values()), **facts)


def _vanishes(best: BestPoint, name: str, item: ParameterEstimate) -> bool:
    """Whether a parameter is consistent with zero and its upper bound is small."""
    if item.state != "weak" or item.ci95 is None or not may_vanish(name):
        return False
    ends = (*item.ci95, *(item.range or ()))
    return bool(min(ends) <= 0.0 <= max(ends) and max(map(abs, ends)) <= WEAK * best.size(name))


def _visited(best: BestPoint, estimates: Estimates) -> Check:
    needed = [law.needed for law in best.problem.model.laws]
    seen = visited(best.problem, best.simulated)
    pairs = zip(seen, needed, strict=True)
    absent = {s: [one for one in needs if one not in covered(seen[s])] for s, needs in pairs}
    lost = [f"{branch} of {spring}" for spring, gone in absent.items() for branch in gone]
    # An absent branch is a fault only if a varied parameter, which has its own warning, needs it.
    unknown = [name for name, item in estimates.items() if item.state == "not determined"]
    depend = any(absent.get(f"s{split_name(name)[0] + 1}") for name in unknown)
    answer = True if not lost else False if depend else None
    every = tuple(dict.fromkeys(chain.from_iterable(needed)))
    return _check("visited", answer, wanted=every, lost=lost)


def _of_intervals(
    best: BestPoint, estimates: Estimates, intervals: Intervals, with_error: Sequence[str]
) -> Iterator[Check]:
    methods = Counter(item.ci95_method for item in estimates.values() if item.ci95_method)
    answer = False if intervals.warnings else True if methods else None
    yield _check("intervals", answer, warnings=intervals.warnings, made=methods)
    stuck, natural = [], []
    for name in (name for name in with_error if estimates[name].vary):
        for bound in best.at_limits(name):
            if bound == 0.0 and may_vanish(name):
                natural.append(name)
            else:
                stuck.append((name, bound + best.problem.measurement.origins.get(name, 0.0)))
    unknowns = [(name, bound, unit_of(name)) for name, bound in stuck if name in NUISANCE]
    yield _check("bounds", not stuck, stuck=stuck, natural=natural, unknowns=unknowns)


def _of_priors(best: BestPoint, estimates: Estimates, with_error: Sequence[str]) -> Iterator[Check]:
    """Check whether the curves alone agree with each prior of the user and with a stated delay.

    A descent from the best point without a prior gives the value that the curves alone say. A fit
    that ends far from its prior contradicts it, whatever other minimum that descent meets.
    """
    problem, names, against = best.problem, tuple(with_error), list[dict[str, Any]]()
    stated = [prior for prior in problem.objective.priors if prior.name == TIME_SHIFT]
    given = [one for one in (*problem.objective.given, *stated) if one.name in with_error]
    objective, space, sizes = problem.objective, problem.space(), problem.sizes(names, best.values)
    for prior in given:
        others = np.arange(best.residual.size) != objective.n_data + objective.priors.index(prior)
        functions = squares(Tracker(objective), space, others)
        end = descend(*functions, space.encode(best.values), space.box, ALONE, enough=1e-6)
        values = space.decode(end.point)
        slopes = problem.slopes(values, names)[others]
        found = covariance(slopes, end.residual, objective.sizes, sizes, objective.unit**2)
        error, alone = float(found.stderr[names.index(prior.name)]), values[best.index[prior.name]]
        if end.cost > objective.floor:  # the law errs
            low, high = estimates[prior.name].range or (0.0, 0.0)
            error = max(error, 0.25 * (high - low))
        off, far = abs(alone - prior.mean), abs(best.value(prior.name) - prior.mean)
        if off > AGAINST * math.hypot(prior.sigma, error) or far > AGAINST * prior.sigma:
            told = {"prior": prior, "alone": alone, "error": error, "unit": unit_of(prior.name)}
            against.append(told)
    if given:
        yield _check("priors", not against, against=against)


def _of_test(best: BestPoint, balance: EnergyAudit) -> Iterator[Check]:
    test, drive = best.problem.measurement, best.problem.objective.drive
    small = [note for note in test.notes if CONTRADICTED in note]
    doubts = [note for note in test.notes if note.startswith(ASKED) and note not in small]
    told: dict[bool, list[str]] = {True: [], False: []}
    for one in (one for one in best.contradictions if one.quantity != "time_shift"):
        sentence = say("contradiction", "said", one=one, drive=drive)
        told[one.quantity == "force_scale"].append(sentence)
    settled = len(best.contradictions) < len(balance.contradictions)
    ratio, absorbed = balance.impulse_ratio, balance.absorbed_over_striker
    said = any(one.quantity != "time_shift" for one in balance.contradictions)
    wrong = told[False] or (small if drive == "impact" and not said else [])
    known = ratio is not None or test.flight is not None
    yield _check("velocity", False if wrong else True if known else None, warnings=wrong)
    known = ratio is not None and not settled
    answer = False if told[True] else True if known else None
    yield _check("impulse", answer, warnings=told[True], ratio=ratio)
    yield _check("input", not doubts, warnings=doubts)
    warnings, loop = balance.energy_warnings(), balance.loop_warnings()
    unknown = absorbed is None or balance.motion == INTEGRATED
    unknown = settled or (unknown and not warnings)
    answer = None if unknown and not loop else not (warnings or loop)
    # A contradiction explains why the energy is not that of the striker.
    warnings = loop if balance.contradictions else warnings + loop
    yield _check("energy", answer, warnings=warnings, taken=absorbed)


def _damping(best: BestPoint) -> Check:
    """Check whether a driven single spring lacks damping; friction in the rig looks like it."""
    problem, name = best.problem, "s1_eta"
    if problem.objective.drive == "impact" or not best.names:
        return _check("damping", None)
    damper, alone, eta = problem.params[name], len(problem.model.kinds) == 1, 0.0
    if alone and problem.measurement.time is not None and not damper.vary and damper.value == 0.0:
        column = problem.slopes(best.values, (name,))[:, 0]
        found = best.with_effect(column, best.size(name))
        eta = max(found[0], 0.0) if found else 0.0
    rubs = best.friction[0] if best.friction else 0.0
    return _check("damping", eta == rubs == 0.0, eta=eta, friction=rubs)


def lost_height(best: BestPoint) -> float:
    """Return the share of the largest strain at which a slow unloading ends, if it is large.

    0 if the stress lasts below half of the strain, if the model relaxes or is damped, or if the law
    does not err.
    """
    test, model = best.problem.measurement, best.problem.model
    damped = any(best.value(name) for name in model.names if name.endswith("_eta"))
    if best.problem.objective.drive != "displacement" or model.relaxation or damped:
        return 0.0
    if not (best.names and best.misfits):
        return 0.0
    assert test.displacement is not None
    level, peak = test.noise.of("stress"), float(test.stress.max())
    loaded = test.stress > max(GONE * peak, 4.0 * (level.sigma if level else 0.0))
    last = int(np.flatnonzero(loaded)[-1]) + 1 if loaded.any() else loaded.size  # hidden by noise
    if last >= loaded.size or test.last_cycle is not None:
        return 0.0
    # A load that the noise does not hide is no loss, though small against the peak.
    if level and float(np.median(test.stress[last:])) > 2.0 * level.sigma:
        return 0.0
    share = float(test.displacement[last] / test.displacement.max())
    return share if share > RECOVERED else 0.0


def _time_shift(best: BestPoint, estimates: Estimates) -> Check:
    """Check what the equation of motion of the striker says of the clocks (`data.calibration`)."""
    test, drive, found = best.problem.measurement, best.problem.objective.drive, best.contradictions
    fitted, striker = best.problem.objective.time_shift, test.striker
    one = estimates.get("time_shift") if fitted else None
    facts: dict[str, Any] = {"shift": one and one.value, "held": fitted and not (one and one.vary)}
    if clocks := [one for one in found if one.quantity == "time_shift"]:
        warning = say("contradiction", "said", one=clocks[0], drive=drive, stated=fitted)
        return _check("time_shift", False, warnings=[warning], late=clocks[0].ratio, **facts)
    fine = fitted and not facts["held"]
    shown = striker is not None and striker.mass and striker.velocity and not is_clipped(test)
    if shown and not fitted and not (found and drive == "impact"):
        with suppress(InputError):
            check_time_shift(test, drive)
            fine = True
    return _check("time_shift", fine or None, **facts)
