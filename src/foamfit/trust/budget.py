"""Effect of wrong quantities of a test on the parameters: uncertainty budget and contradictions.

Errors of height, area, masses and calibration are not noise, because they are the same for all
samples of a test. The response of the best point to each is a Gauss-Newton step,
Δθ = −(JᵀJ)⁺ Jᵀ Δr, with the residual computed for a test in which only that quantity differs.
Stress is treated as force over area and strain as displacement over height, whichever the file
contains. If velocity, mass, force and motion do not agree, one of them is wrong, and it is unknown
which; the best point is therefore moved for each way to settle the contradiction.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.data.calibration import Contradiction
from foamfit.data.measurement import Measurement, is_clipped
from foamfit.data.zeros import CONTRADICTED
from foamfit.errors import SimulationError
from foamfit.fitting import nuisance
from foamfit.fitting.curves import later
from foamfit.parts import ParameterEstimate
from foamfit.results import SOURCES, Budget
from foamfit.springs.parameters import NUISANCE, unit_of
from foamfit.text import listed
from foamfit.trust import say
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import Ends

# Largest relative change of a quantity for its derivative; curves have kinks where springs snap.
STEP = 1e-4
# Changes of parameters below this share of the largest one, all over their scales, are rounding.
ROUNDING = 1e-6
DOUBTFUL = 0.005  # a force whose zero is known no better than this share of its peak is doubtful
# Nuisance parameters by the source of uncertainty to which they contribute.
_CONTACT = (nuisance.CONTACT_TIME, *nuisance.ZEROS)
_STRIKER = (*nuisance.POSITIVE, nuisance.TIME_SHIFT)
# Owner of each quantity in a test, and its field, which is also its source of uncertainty.
_QUANTITIES = {
    "height": ("specimen", "height"), "area": ("specimen", "area"),
    "specimen_mass": ("specimen", "mass"),
    "striker_mass": ("striker", "mass"), "velocity": ("striker", "velocity"),
}  # fmt: skip
# Zero of a channel that scales with a quantity, and the power.
_OF_ZEROS = {
    "area": ("stress_zero", -1.0), "stress_scale": ("stress_zero", 1.0),
    "striker_mass": ("stress_zero", 1.0), "displacement_scale": ("displacement_zero", 1.0),
}  # fmt: skip


def responses(best: BestPoint) -> dict[str, Array]:
    """Return the change of all parameters (n_values,), SI, by one standard deviation of each.

    The quantities are those of `Measurement.uncertainties` that are not fitted. NaN if the changed
    test cannot be simulated.
    """
    measurement, free = best.problem.measurement, {"delay", *best.problem.free()}
    free |= {"stress_scale"} if nuisance.FORCE_SCALE in free else set()
    known = {name: sigma for name, sigma in measurement.uncertainties.items() if name not in free}
    return {name: response(best, name, s / _value(measurement, name)) for name, s in known.items()}


def _value(test: Measurement, quantity: str) -> float:
    """Return the value of a quantity of the TOML, SI; 1 for a scale, whose ± is relative."""
    if quantity.startswith("height_"):
        return (test.specimen.heights or ())[int(quantity.removeprefix("height_")) - 1]
    owner, field = _QUANTITIES.get(quantity, ("", ""))
    return float(getattr(getattr(test, owner, None), field, None) or 1.0)


def response(best: BestPoint, quantity: str, share: float) -> Array:
    """Return the change of all parameters (n_values,), SI, by a relative change of a quantity.

    The quantity "time_shift" is the delay of the motion, s; the motion is then moved back by it.
    NaN if the changed test cannot be simulated.
    """
    problem, step = best.problem, math.copysign(min(abs(share), STEP), share)
    try:
        (low, before), (high, after) = (_changed(best, quantity, by) for by in (-step, step))
    except SimulationError:
        return np.full(best.values.size, np.nan)
    steps = best.answer(0.5 * (after - before)[:, None])[:, 0]
    rounding = ROUNDING * np.max(np.abs(steps / best.sizes), initial=0.0)
    steps = np.where(np.abs(steps) > rounding * best.sizes, steps, 0.0)
    moves = problem.moves(best.values, best.names)
    change = (0.5 * (high - low) + moves @ steps) * (share / step)
    zero, power = _OF_ZEROS.get(quantity, ("", 0.0))
    if zero in best.index and (quantity != "striker_mass" or problem.measurement.braked):
        # The zero in the file, to which the fitted one is added, scales with its channel.
        change[best.index[zero]] += power * share * problem.origins[best.index[zero]]
    return np.asarray(change)


def _changed(best: BestPoint, quantity: str, share: float) -> tuple[Array, Array]:
    """Return the parameters, of which those of the quantity itself change, and the residual."""
    problem, values = best.problem, best.values.copy()
    test = changed(problem.measurement, quantity, share)
    if quantity.startswith("height"):  # a spring's own ± has precedence over that of the specimen
        stated = problem.measurement.uncertainties
        for i in range(1, len(problem.model.kinds) + 1):
            name, own = f"s{i}_height", f"height_{i}"
            if name in best.index and quantity == (own if own in stated else "height"):
                values[best.index[name]] *= 1.0 + share
    elif quantity in best.index:
        values[best.index[quantity]] *= 1.0 + share
    before = problem.objective
    same = test.displacement is before.measurement.displacement  # not to be smoothed again
    objective = replace(before, measurement=test, followed=(before.scenes.motion,) if same else ())
    return values, objective.compare(objective.simulate(values), values)


def changed(test: Measurement, quantity: str, share: float) -> Measurement:
    """Return the test with one quantity larger by a share of itself.

    The noise of a channel and the error of its zero scale with the channel.
    """
    by, (name, field) = 1.0 + share, _QUANTITIES.get(quantity, ("", ""))
    owner: Any = getattr(test, name, None)
    if value := getattr(owner, field, None):
        larger: dict[str, Any] = {name: replace(owner, **{field: by * value})}
        test = replace(test, **larger)
        if quantity == "area":
            return _scaled(test, "stress", 1.0 / by)
        return _scaled(test, "stress", by) if quantity == "striker_mass" and test.braked else test
    if quantity == nuisance.TIME_SHIFT:
        assert test.time is not None
        assert test.displacement is not None
        return replace(test, displacement=later(test.time, test.displacement, -share))
    if not quantity.endswith("_scale"):
        return test
    channel = quantity.removesuffix("_scale").replace("velocity", "displacement")
    if channel == "displacement" and "stress" in test.derived:
        test = _scaled(test, "stress", by)
    return _scaled(test, channel, by)


def _scaled(test: Measurement, channel: str, by: float) -> Measurement:
    """Multiply a channel, its noise and the error of its zero."""
    values, noise = getattr(test, channel), test.noise
    if values is None:
        return test
    if (stated := getattr(noise, channel, None)) is not None:
        noise = replace(noise, **{channel: by * stated})
    if (level := noise.estimated.get(channel)) is not None:
        estimated = noise.estimated | {channel: replace(level, sigma=by * level.sigma)}
        noise = replace(noise, estimated=estimated)
    zeros = test.zeros | {name: by * s for name, s in test.zeros.items() if name == channel}
    return replace(test, noise=noise, zeros=zeros, **{channel: by * values})


def make_budget(
    best: BestPoint, estimates: Mapping[str, ParameterEstimate]
) -> tuple[dict[str, ParameterEstimate], Budget | None]:
    """Return the estimates with `systematic` set, and the budget; None if none is determined."""
    moved = responses(best)
    out = dict(estimates)
    for name, item in estimates.items():
        if item.stderr is not None or not item.vary:
            changes = [float(change[best.index[name]]) for change in moved.values()]
            out[name] = replace(item, systematic=math.hypot(*changes))
    rows = dict[str, dict[str, float]]()
    for name, shares in _of_covariance(best):
        item = out[name]
        if item.stderr is None or name in NUISANCE:
            continue
        row = dict.fromkeys(SOURCES, 0.0)
        row |= {source: item.stderr * share for source, share in shares.items()}
        for quantity, change in moved.items():
            kind = "height" if quantity.startswith("height_") else quantity
            *_, source = _QUANTITIES.get(kind, ("calibration",))
            row[source] = math.hypot(row[source], float(change[best.index[name]]))
        if item.range is not None:
            row["law"] = 0.5 * (item.range[1] - item.range[0]) / 1.96
        rows[name] = row
    return out, Budget(rows, {name: best.size(name) for name in rows}) if rows else None


def _of_covariance(best: BestPoint) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield each determined parameter and the parts of its standard error, relative to it.

    The squares of the parts add up to one. The variance without a group of nuisance parameters is
    the conditional one, with these parameters known.
    """
    if not best.names:
        return
    known = np.flatnonzero(np.isfinite(best.spread.stderr) & (best.spread.stderr > 0.0))
    names, matrix = [best.names[i] for i in known], best.spread.correlation[np.ix_(known, known)]

    def conditional(fixed: tuple[str, ...]) -> Array:
        at = [i for i, name in enumerate(names) if name in fixed]
        across = matrix[:, at]
        inner = np.linalg.pinv(matrix[np.ix_(at, at)], hermitian=True) if at else np.zeros((0, 0))
        return np.asarray(np.clip(1.0 - np.sum((across @ inner) * across, axis=1), 0.0, 1.0))

    striker = conditional(_STRIKER)
    noise = np.minimum(conditional((*_CONTACT, *_STRIKER)), striker)
    for i, name in enumerate(names):
        parts = {"noise": noise[i], "contact and zero": striker[i] - noise[i]}
        parts["velocity"] = 1.0 - striker[i]
        yield name, {source: math.sqrt(part) for source, part in parts.items()}


# ---------------------------------------------------------------- contradictions in a record

Way = Mapping[str, float]  # factor of each quantity that is changed, and the time shift, s


class Settled(NamedTuple):
    """Values of all parameters (n,), SI, after a way to settle a contradiction; NaN if it fails.

    `words` is the way, like "velocity × 0.88 and force × 1.30".
    """

    words: str
    values: Array


def of_flight(best: BestPoint) -> tuple[Contradiction, ...]:
    """Return what the flight shows of a velocity that differs by less than a contradiction."""
    test = best.problem.measurement
    if test.flight is None or nuisance.VELOCITY in best.problem.free():
        return ()
    ratio = test.flight[0] / best.problem.objective.usual[nuisance.VELOCITY]
    says = [note for note in test.notes if CONTRADICTED in note]
    return tuple(Contradiction(nuisance.VELOCITY, ratio, 0.0, one, ()) for one in says)


def ways(found: Iterable[Contradiction], *, braked: bool) -> list[Way]:
    """Return the ways to settle all contradictions; `braked` as in `Measurement`."""
    ratios = {one.quantity: one.ratio for one in found}
    out, motion = list[Way](), ratios.get("motion_scale")
    if motion is not None:
        late = {name: by for name, by in ratios.items() if name == nuisance.TIME_SHIFT}
        out.append({"displacement_scale": motion} | late)
        ratios = {"velocity": 1.0 / motion, "force_scale": 1.0 / motion} | late
    speed = {name: ratios[name] for name in ("velocity", nuisance.TIME_SHIFT) if name in ratios}
    if (force := ratios.get("force_scale")) is None:
        return [*out, speed] if speed else out
    out.append(speed | {"stress_scale": force})
    return out if braked else [*out, speed | {"striker_mass": 1.0 / force}]


def settle(best: BestPoint, found: Sequence[Contradiction]) -> tuple[Settled, ...]:
    """Move the best point for each way to settle the contradictions in `found`."""
    if not found or not best.names:
        return ()
    test, impact = best.problem.measurement, best.problem.objective.drive == "impact"
    out = list[Settled]()
    for way in ways(found, braked=test.braked):
        # A given motion needs no striker.
        way = {name: by for name, by in way.items() if impact or name not in nuisance.STRIKER}
        words = [say("contradiction", "way", name=name, by=by) for name, by in way.items()]
        moved = best.values.copy()
        for name, by in way.items():
            moved += response(best, name, by - (name != nuisance.TIME_SHIFT))
        out.append(Settled(listed(words) if words else "", moved))
    return tuple(out)


def judged(
    settled: Sequence[Settled], best: BestPoint, name: str, ends: Ends, state: tuple[str, str]
) -> tuple[str, str]:
    """Return state and reason of a parameter, which is not determined if it would move.

    `ends` is its 95 % interval in the numbers of the file; `state` are its state and reason without
    the contradiction.
    """
    if state[0] != "determined":
        return state
    at, zero = best.index[name], best.problem.measurement.origins.get(name, 0.0)
    for one in settled:
        there = float(one.values[at]) + zero
        if not ends[0] <= there <= ends[1]:
            return "weak", say("why", "contested", settled=one, there=there, unit=unit_of(name))
    # The law errs, and the contradiction, or a doubtful force in an impact, may be the reason.
    impact, test = best.problem.objective.drive == "impact", best.problem.measurement
    if best.problem.kept if impact else settled and best.misfits:
        clipped, zero = is_clipped(test), test.zeros.get("stress", 0.0)
        if settled or clipped or zero > DOUBTFUL * float(test.stress.max()):
            return "weak", say("why", "contested_held", settled=settled, clipped=clipped)
    return state
