"""How long an implicit step may be: the error control, and the first event of a step.

A step is as long as its truncation allows. Where the error alone keeps steps short for long,
something vibrates too fast to be worth following: from the follow limit on steps grow up to a step
floor whatever their error, and the vibration is damped out (L-stability).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.solve.implicit.collocation import STAGES, Step, polynomial
from foamfit.solve.implicit.vibration import Vibrations
from foamfit.solve.polynomial import first_crossing
from foamfit.solve.scene import LEAST_BASE
from foamfit.springs.kernels import compiled

# A step is short below this share of the motion; so many in a row are followed.
SHORT, FOLLOW_LIMIT = 5e-4, 600
# Behind heavy dashpots contact ends when no more than 1e-12 of the peak of the base stress is left:
# while the striker presses it is followed with so large an error of what is left, at most.
SMALL_BASE_ERROR = 1e-7
# What to do with a step whose end was compared with the first event in it.
AGAIN, FREELY, ARRIVED, AT_ONCE = range(4)


class Start(NamedTuple):
    """Where a step starts; `pressed` says that the blow has come through to the base."""

    now: float
    base: float
    pressed: bool
    push: float
    push_rate: float


class Event(NamedTuple):
    """When in a step [0, 1], of which spring (-1: none, one past the last: base), on which side."""

    when: float
    which: int
    side: int


@compiled
def first_leaving(
    polynomials: Array, order: int, low: Array, high: Array
) -> tuple[float, int, int]:
    """First time in [0, 1] at which one of several polynomials leaves [low, high]; see `Event`."""
    when, which, side = 1.0, -1, 0
    for i in range(low.size):
        at, where = first_crossing(polynomials[i], order, low[i], high[i], 1.0)
        if where != 0 and (which < 0 or at < when):
            when, which, side = at, i, where
    return when, which, side


def value_at(c: Array, tau: float) -> float:
    """Value of a polynomial of a step."""
    return float(((((c[5] * tau + c[4]) * tau + c[3]) * tau + c[2]) * tau + c[1]) * tau + c[0])


def slope_at_end(c: Array) -> float:
    """Derivative of a polynomial of a step at its end."""
    return float(c[1] + 2.0 * c[2] + 3.0 * c[3] + 4.0 * c[4] + 5.0 * c[5])


class Control:
    """Control of the steps.

    `tol` is the truncation of a step relative to the motion so far, `short` the length (s) under
    which steps are short, `weight` that of the truncation of the base stress relative to what is
    left of it, while the striker presses. `taken` and `proposed` are the lengths of the last step
    and the next; `floor` is the least that the error may ask for; `short_in_row` counts steps that
    the error alone made short; `worst` is the largest error let pass, over tol. `damped` is the
    size of all vibrations that were damped out, `damping` of those in the last steps. `motion` (m),
    `stress` and `base` (Pa) are the largest so far, `step_…` with the step that is tried; `strains`
    and `ending` (the base stress) polynomials over [0, 1] of a step.
    """

    def __init__(
        self, step: Step, vibrations: Vibrations, tol: float, duration: float, weight: float
    ) -> None:
        self.step, self.vibrations, self.tol, self.weight = step, vibrations, tol, weight
        self.short = SHORT * duration * (tol / 3e-8) ** (1.0 / 6.0)
        self.taken = self.floor = self.damped = self.damping = 0.0
        self.motion = self.stress = self.base = self.step_motion = self.step_stress = 0.0
        self.short_in_row, self.worst, self.proposed = 0, 1.0, math.inf
        self.strains, self.ending = np.zeros((step.heights.size, STAGES + 1)), np.zeros(STAGES + 1)

    def error(self, start: Start) -> float:
        """Truncation of a step, relative to motion and stress with what the step itself reaches."""
        step, count = self.step, self.step.heights.size
        present = max(abs(start.base), float(np.abs(step.total[0]).max()))
        reach = max(self.motion, float((step.heights * np.abs(step.eps).max(axis=1)).max()))
        load = max(self.stress, float(np.abs(step.stress).max()), present)
        self.step_motion, self.step_stress = reach, load
        first = np.concatenate((step.eps0, step.stress0, [start.base]))
        found = polynomial(first, np.concatenate((step.eps, step.stress, step.total[:1])))
        self.strains, self.ending = found[:count], found[-1]
        # The sizes of the first Legendre term that the polynomials leave out.
        fifth = np.abs(found[:, 5]) / 252.0
        fourth = np.abs(found[:, 4] + 2.5 * found[:, 5]) / 70.0
        left_out = fifth * np.minimum(np.maximum(fifth / (fourth + 1e-300), 0.02), 1.0)
        error, of_base = 0.0, float(left_out[-1])
        if load > 0.0:
            error = of_base / max(self.base, present, LEAST_BASE * load)
            if self.weight > 0.0 and start.pressed:
                # What is left is known to the rounding of its parts.
                least = SMALL_BASE_ERROR * float(np.abs(step.stress[0]).max())
                error = max(error, self.weight * of_base / max(present, least))
            error = max(error, float(left_out[count:-1].max()) / load)
        if reach > 0.0:
            error = max(error, float((left_out[:count] * step.heights).max()) / reach)
        return error

    def allowed(self, now: float, span: float, error: float, rounded: bool) -> float:
        """Length at which to take a step whose truncation is `error`: its own where that may pass.

        It may also where the error is one of rounding, or the step as short as times can resolve.
        """
        excess = error / self.tol
        if not math.isfinite(excess):
            return 0.3 * span
        factor = 0.9 * max(excess, 1e-12) ** (-1.0 / 6.0)
        floor = max(self.floor, 1e-15 * now)
        if excess > 1.0 and not rounded and span > floor * (1.0 + 1e-9):
            return max(span * min(max(factor, 0.1), 0.9), floor)
        if excess <= 1.0:
            self.damping = 0.0
        elif error > self.damping and self.vibrations.unresolved(span):
            self.damped += error - self.damping
            self.damping = error
        self.proposed = max(span * min(max(factor, 0.2), 5.0), self.floor)
        if excess > 1.0:
            self.proposed = max(self.proposed, 2.0 * span)
        self.worst = max(self.worst, excess)
        return span

    def slack(self) -> tuple[Array, float]:
        """What strains and base stress are known to."""
        strains = np.maximum(1e-12, self.tol * self.step_motion / self.step.heights)
        return strains, min(self.worst * self.tol, 1e-3) * self.step_stress

    def note(self, span: float, last: bool) -> None:
        """Take the scales from a step; let steps grow that only the error kept short for long."""
        step = self.step
        self.motion = max(self.motion, float((step.heights * np.abs(step.eps0)).max()))
        self.base = max(self.base, abs(float(step.total[0, -1])))
        self.stress = max(self.stress, self.base, float(np.abs(step.stress[:, -1]).max()))
        self.taken = span
        if self.proposed >= self.short:
            self.short_in_row, self.floor = 0, 0.0
        elif not last:
            self.short_in_row += 1
            if self.short_in_row > FOLLOW_LIMIT:
                self.floor = min(max(2.0 * self.floor, 2.0 * span), self.short)
                self.proposed = max(self.proposed, self.floor)

    # ---------------------------------------------------------------- where a step ends

    def _first_event(self, start: Start, struck: bool) -> Event:
        """First event of a step.

        A spring that starts within its slack of the end of its branch leaves it by more than that.
        The base stress has to rise by ten times its slack before contact can end.
        """
        step, (slack, least) = self.step, self.slack()
        low = step.low - np.where(np.abs(self.strains[:, 0] - step.low) <= slack, slack, 0.0)
        high = step.high + np.where(np.abs(self.strains[:, 0] - step.high) <= slack, slack, 0.0)
        event = Event(1.0, -1, 0)
        reach = np.abs(self.strains[:, 1:]).sum(axis=1)
        first = self.strains[:, 0]
        if ((first - reach <= low) | (first + reach >= high)).any():
            event = Event(*first_leaving(self.strains, STAGES, low, high))
        if struck:
            ends = np.array([0.0 if start.pressed else -least]), np.array([math.inf])
            at, _, where = first_leaving(self.ending[None], STAGES, *ends)
            risen = start.pressed or value_at(self.ending, 0.5 * at) > 10.0 * least
            if where != 0 and at <= event.when and risen:
                event = Event(at, low.size, where)
        return event

    def aim(
        self, start: Start, struck: bool, span: float, longest: float, last: bool, aimed_at: Event
    ) -> tuple[int, float, Event]:
        """What to do with a step aimed at an event, for what length, and the event from then on."""
        step, found = self.step, self._first_event(start, struck)
        when, which, side = found.when, aimed_at.which, aimed_at.side
        aimed = which >= 0 and (found.which < 0 or found.which == which or when > 1.0 - 1e-9)
        if not aimed:
            which, side = found.which, found.side
        target = Event(when, which, side)
        if which < 0:
            return FREELY, span, target
        level, fine = 0.0, 1e-13 * abs(start.base)
        ending, value, slack = self.ending, float(step.total[0, -1]), self.slack()[1]
        if which < step.heights.size:
            level = float((step.high if side > 0 else step.low)[which])
            fine = 1e-13 * max(1.0, abs(level))
            ending, value = self.strains[which], float(step.eps[which, -1])
            slack = float(self.slack()[0][which])
        near = False
        if aimed:
            if abs(level - value) <= (1e5 * fine if last else fine):
                return ARRIVED, span, target
            if found.which < 0:  # a little further; where it turned back, nothing was crossed
                slope = slope_at_end(ending)
                more = (level - value) / slope if slope != 0.0 else math.inf
                when = 1.0 + more if more > 0.0 else math.inf
            if last or not when * span < longest:
                return FREELY, span, target
        else:
            beyond = value_at(ending, 0.5 * when) - level
            near = abs(ending[0] - level) <= slack and beyond * side >= 0.0
        if near or start.now + when * span <= start.now:
            return AT_ONCE, 0.0, target
        if when >= 1.0 - 1e-15 and not aimed:
            return ARRIVED, span, target
        return AGAIN, when * span, target
