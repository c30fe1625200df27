"""Length of implicit steps: error control, and the first event in a step.

A step is as long as its truncation error allows. If the error keeps many steps in a row short,
something vibrates too fast to be worth resolving: after the follow limit, steps grow up to a floor
regardless of their error, and the vibration is damped out (L-stability).
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

SHORT = 5e-4  # length of a short step, as a share of the duration, for a truncation of 3e-8
FOLLOW_LIMIT = 600  # number of short steps in a row that are taken
# Behind heavy dashpots contact ends when the base stress has fallen to 1e-12 of its peak. Until
# then its error, relative to the remaining stress, is at most:
SMALL_BASE_ERROR = 1e-7
# Decision on a step after a search for events: repeat it with another length, accept it without an
# event, accept it ending at an event, or switch at its start.
AGAIN, FREELY, ARRIVED, AT_ONCE = range(4)


class Start(NamedTuple):
    """State at the start of a step; `pressed` once the impact has reached the base."""

    now: float
    base: float
    pressed: bool
    push: float
    push_rate: float


class Event(NamedTuple):
    """Time in a step [0, 1], spring (-1: none; one past the last: base), and side of an event."""

    when: float
    which: int
    side: int


@compiled
def first_leaving(
    polynomials: Array, order: int, low: Array, high: Array
) -> tuple[float, int, int]:
    """Return when, in [0, 1], the first of several polynomials leaves [low, high]; see `Event`."""
    when, which, side = 1.0, -1, 0
    for i in range(low.size):
        at, where = first_crossing(polynomials[i], order, low[i], high[i], 1.0)
        if where != 0 and (which < 0 or at < when):
            when, which, side = at, i, where
    return when, which, side


def value_at(c: Array, tau: float) -> float:
    """Return the value of a polynomial of a step."""
    return float(((((c[5] * tau + c[4]) * tau + c[3]) * tau + c[2]) * tau + c[1]) * tau + c[0])


def slope_at_end(c: Array) -> float:
    """Return the derivative of a polynomial of a step at its end."""
    return float(c[1] + 2.0 * c[2] + 3.0 * c[3] + 4.0 * c[4] + 5.0 * c[5])


class Control:
    """Control of the step length.

    `tol` is the truncation of a step relative to the motion so far, `short` the length (s) of a
    short step, and `weight` that of the error of the base stress relative to the remaining stress,
    during contact. `taken` and `proposed` are the lengths of the last and the next step, and
    `floor` is the least length that the error can enforce. `short_in_row` counts the steps that
    the error made short, and `worst` is the largest accepted error over tol. `damped` is the size
    of all damped-out vibrations, `damping` of those in the last steps. `motion` (m), `stress` and
    `base` (Pa) are the largest values so far, `step_…` those including the trial step. `strains`
    and `ending` (the base stress) are polynomials over [0, 1] of a step.
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
        """Return the truncation error of a step over the largest motion and stress so far."""
        step, count = self.step, self.step.heights.size
        present = max(abs(start.base), float(np.abs(step.total[0]).max()))
        reach = max(self.motion, float((step.heights * np.abs(step.eps).max(axis=1)).max()))
        load = max(self.stress, float(np.abs(step.stress).max()), present)
        self.step_motion, self.step_stress = reach, load
        first = np.concatenate((step.eps0, step.stress0, [start.base]))
        curves = polynomial(first, np.concatenate((step.eps, step.stress, step.total[:1])))
        self.strains, self.ending = curves[:count], curves[-1]
        # Estimate the first Legendre term that the polynomials neglect from the last two.
        fifth = np.abs(curves[:, 5]) / 252.0
        fourth = np.abs(curves[:, 4] + 2.5 * curves[:, 5]) / 70.0
        left_out = fifth * np.minimum(np.maximum(fifth / (fourth + 1e-300), 0.02), 1.0)
        error, of_base = 0.0, float(left_out[-1])
        if load > 0.0:
            error = of_base / max(self.base, present, LEAST_BASE * load)
            if self.weight > 0.0 and start.pressed:
                # The remaining stress is subject to the rounding errors of its parts.
                least = SMALL_BASE_ERROR * float(np.abs(step.stress[0]).max())
                error = max(error, self.weight * of_base / max(present, least))
            error = max(error, float(left_out[count:-1].max()) / load)
        if reach > 0.0:
            error = max(error, float((left_out[:count] * step.heights).max()) / reach)
        return error

    def allowed(self, now: float, span: float, error: float, rounded: bool) -> float:
        """Return the length to use for a step with this truncation error: `span` to accept it.

        An excessive error is accepted if rounding dominates it or if no shorter step is resolved.
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
        """Return the uncertainty of strains and base stress."""
        strains = np.maximum(1e-12, self.tol * self.step_motion / self.step.heights)
        return strains, min(self.worst * self.tol, 1e-3) * self.step_stress

    def note(self, span: float, last: bool) -> None:
        """Update the scales by a step; raise the floor after too many short steps in a row."""
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
        """Return the first event of a step.

        A spring that starts within its slack of the end of its branch must exceed the slack to
        leave. The base stress must rise to ten times its slack before contact can end.
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
        """Return what to do with a step aimed at an event, its length, and its new target."""
        step, first = self.step, self._first_event(start, struck)
        when, which, side = first.when, aimed_at.which, aimed_at.side
        aimed = which >= 0 and (first.which < 0 or first.which == which or when > 1.0 - 1e-9)
        if not aimed:
            which, side = first.which, first.side
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
            if first.which < 0:  # aim a little further, unless the curve turns back
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
