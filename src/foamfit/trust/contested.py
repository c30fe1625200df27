"""Parameters that would leave their interval if a contradiction of the record were settled.

If velocity, mass, force and motion do not agree, one of them is wrong, and it is unknown which. The
fit is therefore repeated from its best point for each way to settle the contradiction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from foamfit.arrays import Array
from foamfit.data.calibration import Contradiction
from foamfit.data.measurement import Measurement, is_clipped
from foamfit.fitting import nuisance
from foamfit.fitting.curves import later
from foamfit.fitting.search import Tracker, descend, search
from foamfit.springs.parameters import unit_of
from foamfit.text import listed
from foamfit.trust import say
from foamfit.trust.best_point import BestPoint
from foamfit.trust.budget import changed, on_test
from foamfit.trust.covariance import Ends

STEPS, STARTS = 40, 4  # steps of a descent from the best point, start points of a search
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
    """Return the contradictions that the fit does not settle by a parameter or its value."""
    problem, values = best.problem, dict(zip(best.problem.names, best.values.tolist(), strict=True))
    known = {prior.name for prior in problem.objective.priors}
    free, usual = set(problem.free()) - known, problem.objective.usual
    ratios = {name: values.get(name, usual[name]) / usual[name] for name in nuisance.POSITIVE}
    speed = ratios[nuisance.VELOCITY]
    force = ratios[nuisance.FORCE_SCALE] / ratios[nuisance.STRIKER_MASS]

    def agrees(one: Contradiction) -> bool:
        if one.quantity == nuisance.TIME_SHIFT:
            return bool(abs(one.ratio - values.get(nuisance.TIME_SHIFT, 0.0)) <= one.limit)
        off = {"velocity": (speed,), "force_scale": (force,)}
        wanted = off.get(one.quantity, (1.0 / speed, 1.0 / force))
        return all(abs(one.ratio / ratio - 1.0) <= one.limit for ratio in wanted)

    return tuple(one for one in found if not (one.is_settled(free) or agrees(one)))


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


def settle(
    best: BestPoint, found: Sequence[Contradiction], *, stopped: bool = False
) -> tuple[Settled, ...]:
    """Repeat the fit for each way to settle the contradictions in `found`.

    With a wrong striker an impact may be fitted best far from the right springs, so these are
    searched for, unless the search of the fit was `stopped`, or the law errs and nothing is
    determined anyway.
    """
    if not found or not best.names:
        return ()
    test, impact = best.problem.measurement, best.problem.objective.drive == "impact"
    far = impact and not stopped and not best.problem.kept
    plain, out = _refitted(best, {}), list[Settled]()  # a joint fit is not the best of one test
    for way in ways(found, braked=test.braked):
        # A given motion needs no striker.
        way = {name: by for name, by in way.items() if impact or name not in nuisance.STRIKER}
        again = _refitted(best, way, starts=STARTS * far) if way else plain
        moved = None if again is None or plain is None else best.values + again - plain
        words = [say("contradiction", "way", name=name, by=by) for name, by in way.items()]
        if way or moved is not None:
            out.append(Settled(listed(words) if words else "", moved))
    return tuple(out)


def judged(
    settled: Sequence[Settled], best: BestPoint, name: str, ends: Ends, state: tuple[str, str]
) -> tuple[str, str]:
    """Return state and reason of a parameter, which is not determined if it would move.

    `ends` is its 95 % interval in the numbers of the file; `state` are its state and reason without
    the contradiction.
    """
    for one in settled if state[0] == "determined" else ():
        there = None
        if one.values is not None:
            there = float((one.values + best.problem.origins)[best.index[name]])
        if there is None or not ends[0] <= there <= ends[1]:
            return "weak", say("why", "contested", settled=one, there=there, unit=unit_of(name))
    # The law errs, and the contradiction, or a doubtful force in an impact, may be the reason.
    impact, test = best.problem.objective.drive == "impact", best.problem.measurement
    if state[0] == "determined" and (best.problem.kept if impact else settled and best.misfits):
        clipped, zero = is_clipped(test), test.zeros.get("stress", 0.0)
        peak = 0.0 if test.stress is None else float(test.stress.max())
        if settled or clipped or zero > DOUBTFUL * peak:
            return "weak", say("why", "contested_held", settled=settled, clipped=clipped)
    return state


def _earlier(test: Measurement, late: float) -> tuple[Measurement, float]:
    """Return the test with its motion earlier by `late` s, and the change of its zero, m."""
    assert test.time is not None
    assert test.displacement is not None
    moved = later(test.time, test.displacement, -late)
    contact = 0.0 if test.rise is None else test.rise[0]
    more = np.interp(contact, test.time, moved - test.displacement)
    return replace(test, displacement=moved), float(more)


def _refitted(best: BestPoint, way: Way, starts: int = 0) -> Array | None:
    """Return the best point with changed quantities, found nearby or by a search of `starts`."""
    problem, values, test = best.problem, best.values.copy(), best.problem.measurement
    params, stresses = problem.params.copy(), way.get("stress_scale", 1.0)
    for name in problem.kept if way else ():  # held for an error that may be the contradiction's
        params[name].set(vary=True)
    of_stress = [unit_of(name).startswith("Pa") for name in problem.names]
    values[of_stress] *= stresses  # a good start, exact along a given motion
    for name, by in way.items():
        if name == nuisance.TIME_SHIFT:
            test, more = _earlier(test, by)
            if (zero := params.get("displacement_zero")) is not None:
                zero.set(value=zero.value + more, min=zero.min + more, max=zero.max + more)
                values[problem.index["displacement_zero"]] += more
            continue
        test = changed(test, name, by - 1.0)
        if name in params:
            one, place = params[name], best.index[name]
            one.set(value=by * one.value, min=by * one.min, max=by * one.max)
            values[place] *= by
    objective = on_test(problem.objective, test)
    space = replace(problem, measurement=test, objective=objective, params=params).space()
    tracker = Tracker(objective)
    descend(tracker, space, space.encode(values), STEPS)
    if starts:
        rng = np.random.default_rng(0)
        search(tracker, space, starts=starts, rng=rng, progress=lambda *_: None)
    return tracker.best_values
