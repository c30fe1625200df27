"""Parameters that would leave their interval if a contradiction of the record were settled.

If velocity, mass, force and motion do not agree, one of them is wrong, and it is unknown which. The
best point is therefore moved, to first order, for each way to settle the contradiction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array
from foamfit.data.calibration import Contradiction
from foamfit.data.measurement import is_clipped
from foamfit.data.zeros import CONTRADICTED
from foamfit.fitting import nuisance
from foamfit.springs.parameters import unit_of
from foamfit.text import listed
from foamfit.trust import say
from foamfit.trust.best_point import BestPoint
from foamfit.trust.budget import response
from foamfit.trust.covariance import Ends

# A force whose zero is known no better than this share of its peak is doubtful.
DOUBTFUL = 0.005

Way = Mapping[str, float]  # factor of each quantity that is changed, and the time shift, s


@dataclass(frozen=True, eq=False)
class Settled:
    """Values of all parameters (n,), SI, after a way to settle a contradiction; None if it fails.

    `words` is the way, like "velocity × 0.88 and force × 1.30".
    """

    words: str
    values: Array | None


def unsettled(best: BestPoint, found: Sequence[Contradiction]) -> tuple[Contradiction, ...]:
    """Return the contradictions that the fit does not settle by a parameter or its value.

    Of a time shift, only what the fit leaves of it.
    """
    problem, usual = best.problem, best.problem.objective.usual
    values = usual | dict(zip(problem.names, best.values.tolist(), strict=True))
    free = set(problem.free()) - {prior.name for prior in problem.objective.priors}
    speed, mass, scale = (values[name] / usual[name] for name in nuisance.POSITIVE)
    settling = {"velocity": (speed,), "force_scale": (scale / mass,)}
    # Between masses within the specimen the force is late without a fault of the clocks.
    inert = problem.objective.interior_mass and len(problem.model.kinds) > 1
    out = list[Contradiction]()
    for one in found:
        if one.quantity == nuisance.TIME_SHIFT:
            one = replace(one, ratio=one.ratio - values[nuisance.TIME_SHIFT])
            agrees = inert or abs(one.ratio) <= one.limit
        else:
            ratios = settling.get(one.quantity, (1.0 / speed, mass / scale))
            agrees = all(abs(one.ratio / ratio - 1.0) <= one.limit for ratio in ratios)
        if not (agrees or one.is_settled(free)):
            out.append(one)
    return tuple(out)


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
        fails = not np.all(np.isfinite(moved))
        out.append(Settled(listed(words) if words else "", None if fails else moved))
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
        there = None if one.values is None else float(one.values[at]) + zero
        if there is None or not ends[0] <= there <= ends[1]:
            return "weak", say("why", "contested", settled=one, there=there, unit=unit_of(name))
    # The law errs, and the contradiction, or a doubtful force in an impact, may be the reason.
    impact, test = best.problem.objective.drive == "impact", best.problem.measurement
    if best.problem.kept if impact else settled and best.misfits:
        clipped, zero = is_clipped(test), test.zeros.get("stress", 0.0)
        peak = 0.0 if test.stress is None else float(test.stress.max())
        if settled or clipped or zero > DOUBTFUL * peak:
            return "weak", say("why", "contested_held", settled=settled, clipped=clipped)
    return state
