"""What the ± of the TOML does to the parameters, and what their uncertainty is made of.

Height, area, masses and the scales of the channels are not noise: every sample of a test has the
same error of them. The response of the best point to each is that of Gauss and Newton,
Δθ = −(JᵀJ)⁺ Jᵀ Δr, with the residual computed for a test in which that quantity alone differs.
A stress counts as a force over the area, and a strain as a motion over the height, whichever of
them the file has.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.errors import SimulationError
from foamfit.fitting import nuisance
from foamfit.results import SOURCES, Budget, ParameterEstimate
from foamfit.springs.parameters import NUISANCE
from foamfit.trust.best_point import BestPoint
from foamfit.trust.covariance import AT_LIMIT, SINGULAR

# Largest relative change of a quantity for its derivative: curves have kinks where springs snap.
STEP = 1e-4
# Change of a parameter over the largest one, both over their scales, that counts as none.
ROUNDING = 1e-6
# Nuisance parameters by the source of uncertainty to which they contribute.
_CONTACT = (nuisance.CONTACT_TIME, *nuisance.ZEROS)
_STRIKER = (*nuisance.STRIKER, nuisance.TIME_SHIFT)
# Quantities of a test: where they stand, and the source of uncertainty that they are.
_QUANTITIES = {
    "height": ("specimen", "height", "height"),
    "area": ("specimen", "area", "area"),
    "specimen_mass": ("specimen", "mass", "mass"),
    "striker_mass": ("striker", "mass", "mass"),
    "velocity": ("striker", "velocity", "velocity"),
}


def responses(best: BestPoint) -> dict[str, Array]:
    """Change of all parameters (n_values,), SI, by one standard deviation of each quantity.

    The quantities are those of `Measurement.uncertainties` that are not fitted. NaN where the
    changed test cannot be simulated.
    """
    measurement, free = best.problem.measurement, best.problem.free()
    return {
        quantity: response(best, quantity, sigma / _value(measurement, quantity))
        for quantity, sigma in measurement.uncertainties.items()
        if quantity != "delay" and quantity not in free
    }


def _value(test: Measurement, quantity: str) -> float:
    """Value of a quantity of the TOML, SI; 1 of a scale, whose ± is a share."""
    if quantity.startswith("height_"):
        return (test.specimen.heights or ())[int(quantity.removeprefix("height_")) - 1]
    owner, field, _ = _QUANTITIES.get(quantity, ("", "", ""))
    return float(getattr(getattr(test, owner, None), field, None) or 1.0)


def response(best: BestPoint, quantity: str, share: float) -> Array:
    """Change of all parameters (n_values,), SI, where a quantity is larger by a share of itself."""
    problem, step = best.problem, min(share, STEP)
    try:
        (low, before), (high, after) = (_changed(best, quantity, by) for by in (-step, step))
    except SimulationError:
        return np.full(best.values.size, np.nan)
    moved = 0.5 * (after - before)
    scaled = best.scaled.copy()
    # What lies at a limit stays there.
    off = np.abs(best.box - best.values[best.places]).min(axis=0, initial=np.inf)
    scaled[:, off <= AT_LIMIT * best.sizes] = 0.0
    steps = -np.linalg.pinv(scaled, rcond=SINGULAR) @ moved
    rounding = ROUNDING * np.max(np.abs(steps), initial=0.0)
    steps = np.where(np.abs(steps) > rounding, steps, 0.0) * best.sizes
    moves = problem.moves(best.values, best.names)
    return np.asarray((0.5 * (high - low) + moves @ steps) * (share / step))


def _changed(best: BestPoint, quantity: str, share: float) -> tuple[Array, Array]:
    """Parameters that are the quantity itself, and the residual, where that is larger by a share.

    Raises SimulationError if the test cannot be simulated so.
    """
    problem, values = best.problem, best.values.copy()
    test = changed(problem.measurement, quantity, share)
    if quantity.startswith("height"):  # a spring's own ± goes before that of the whole
        stated = problem.measurement.uncertainties
        for i in range(1, len(problem.model.kinds) + 1):
            name, own = f"s{i}_height", f"height_{i}"
            if name in best.index and quantity == (own if own in stated else "height"):
                values[best.index[name]] *= 1.0 + share
    elif quantity in best.index:
        values[best.index[quantity]] *= 1.0 + share
    same = test.displacement is problem.measurement.displacement
    followed = (problem.objective.motion,) if same else ()
    objective = replace(problem.objective, measurement=test, followed=followed)
    return values, objective.compare(objective.simulate(values), values)


def changed(test: Measurement, quantity: str, share: float) -> Measurement:
    """The same test with one quantity larger by a share of itself, and nothing else changed.

    The noise of a channel, and the error of its zero, change as the channel does.
    """
    by, (name, field, _) = 1.0 + share, _QUANTITIES.get(quantity, ("", "", ""))
    owner: Any = getattr(test, name, None)
    if value := getattr(owner, field, None):
        larger: dict[str, Any] = {name: replace(owner, **{field: by * value})}
        test = replace(test, **larger)
        if quantity == "area":
            return _scaled(test, "stress", 1.0 / by)
        return _scaled(test, "stress", by) if quantity == "striker_mass" and test.braked else test
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
    if (given := getattr(noise, channel, None)) is not None:
        noise = replace(noise, **{channel: by * given})
    if (level := noise.estimated.get(channel)) is not None:
        estimated = noise.estimated | {channel: replace(level, sigma=by * level.sigma)}
        noise = replace(noise, estimated=estimated)
    zeros = test.zeros | {name: by * s for name, s in test.zeros.items() if name == channel}
    return replace(test, noise=noise, zeros=zeros, **{channel: by * values})


def make_budget(
    best: BestPoint, estimates: Mapping[str, ParameterEstimate]
) -> tuple[dict[str, ParameterEstimate], Budget | None]:
    """Give the estimates their `systematic`, and make the budget; None if nothing is determined."""
    moved = responses(best)
    out = dict(estimates)
    for name, one in estimates.items():
        if one.stderr is not None or not one.vary:
            changes = [float(change[best.index[name]]) for change in moved.values()]
            out[name] = replace(one, systematic=math.hypot(*changes))
    rows = dict[str, dict[str, float]]()
    for name, shares in _of_covariance(best):
        one = out[name]
        if one.stderr is None or name in NUISANCE:
            continue
        row = dict.fromkeys(SOURCES, 0.0)
        row |= {source: one.stderr * share for source, share in shares.items()}
        for quantity, change in moved.items():
            kind = "height" if quantity.startswith("height_") else quantity
            *_, source = _QUANTITIES.get(kind, ("calibration",))
            row[source] = math.hypot(row[source], float(change[best.index[name]]))
        if one.range is not None:
            row["law"] = 0.5 * (one.range[1] - one.range[0]) / 1.96
        rows[name] = row
    scales = dict(zip(best.names, best.sizes.tolist(), strict=True))
    return out, Budget(rows, {name: scales[name] for name in rows}) if rows else None


def _of_covariance(best: BestPoint) -> Iterator[tuple[str, dict[str, float]]]:
    """Give each determined parameter and the parts of its standard error as shares of it.

    Their squares add up to one. The variance without a group of nuisance parameters is the
    conditional one, in which they are known.
    """
    if not best.names:
        return
    known = np.isfinite(best.spread.stderr) & (best.spread.stderr > 0.0)
    names = [name for name, there in zip(best.names, known, strict=True) if there]
    matrix = best.spread.correlation[np.ix_(known, known)]

    def left(held: tuple[str, ...]) -> Array:
        at = [i for i, name in enumerate(names) if name in held]
        across = matrix[:, at]
        told = np.linalg.pinv(matrix[np.ix_(at, at)], hermitian=True) if at else np.zeros((0, 0))
        return np.asarray(np.clip(1.0 - np.sum((across @ told) * across, axis=1), 0.0, 1.0))

    striker = left(_STRIKER)
    noise = np.minimum(left((*_CONTACT, *_STRIKER)), striker)
    for i, name in enumerate(names):
        parts = {"noise": noise[i], "contact and zero": striker[i] - noise[i]}
        parts["velocity"] = 1.0 - striker[i]
        yield name, {source: math.sqrt(part) for source, part in parts.items()}
