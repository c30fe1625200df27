"""The integrator of stiff scenes: implicit collocation between switches of branch.

Light masses, and heavy or very light dashpots, cause fast rates that explicit steps must resolve.
The steps of `implicit.collocation` (Radau IIA, order 9) need not: the method is L-stable, so that
unresolved relaxation and vibration die out (`implicit.vibration` estimates the resulting error).

No branch changes inside a step. A switch, or the end of contact, is the first crossing of the
polynomial; the step is repeated, shorter, until it ends there. Derivatives by parameters are
integrated on request; the law is continuous at its switches, so they do not jump there.

Stiff scenes are rare, and compilation would take longer than thousands of steps. The steps are
therefore plain NumPy, vectorised over springs and points.
"""

from __future__ import annotations

import math

import numpy as np

from foamfit.arrays import Array
from foamfit.solve import scene as scenes
from foamfit.solve.implicit.collocation import NODES, STAGES, THROUGH, Step, plain, polynomial
from foamfit.solve.implicit.control import (
    AGAIN,
    FREELY,
    SMALL_BASE_ERROR,
    Control,
    Event,
    Start,
    slope_at_end,
)
from foamfit.solve.implicit.vibration import Vibrations
from foamfit.solve.rates import contact_time, is_overdamped
from foamfit.springs import kernels
from foamfit.springs.kernels import ETA, OPEN
from foamfit.springs.parameters import OWN_ETA, OWN_HEIGHT


class _EndError(Exception):
    """The end of a run."""

    def __init__(self, outcome: int, time: float) -> None:
        self.outcome, self.time = outcome, time


def integrate_implicit(
    scene: scenes.Scene,
    tol: float,
    max_steps: int,
    directions: kernels.Branches,
    start: Array,
    out: scenes.Samples,
    log: Array,
) -> tuple[int, float, int, int, float]:
    """Integrate a chain, at rest or struck, over the samples of a scene by implicit steps.

    See `explicit.taylor.integrate`. The last value returned is the size of the unresolved
    vibrations that were damped out, relative to motion and stress.
    """
    with np.errstate(all="ignore"):
        run = _Run(scene, tol, directions, start, out, log)
        try:
            run.follow(max_steps)
        except _EndError as end:
            lost = run.control.damped
            if run.vibrations.worst[1] > 0.0:
                scales = run.control.motion, run.control.stress
                lost += float((run.vibrations.worst / scales).max())
            return end.outcome, end.time, run.steps, run.switches, lost
    raise AssertionError  # `follow` always raises `_EndError`


class _Run:
    """One run over the samples: the state of a chain between steps."""

    def __init__(
        self,
        scene: scenes.Scene,
        tol: float,
        directions: kernels.Branches,
        start: Array,
        out: scenes.Samples,
        log: Array,
    ) -> None:
        self.scene, self.out, self.log = scene, out, log
        self.t, self.struck = scene.t, scene.speed > 0.0
        self.step = Step(scene, directions)
        self.count, self.first = scene.heights.size, int(scene.ends[0])
        # The springs above the last mass inside; the drive determines where their nodes start.
        self.above = slice(int(scene.ends[-2]) if scene.ends.size > 1 else 0, None)
        self.nodes = slice(None) if len(out.curves) > 2 else slice(-1, None)
        duration, weight = float(self.t[-1] - (0.0 if self.struck else self.t[0])), 0.0
        if self.struck:
            chain = scene.rows, scene.heights, scene.mass[-1]
            duration = min(duration, 5.0 * plain(contact_time)(*chain, scene.drag))
            if plain(is_overdamped)(*chain):
                weight = min(1.0, tol / SMALL_BASE_ERROR)
        self.vibrations = Vibrations(scene)
        self.control = Control(self.step, self.vibrations, tol, duration, weight)
        if self.struck:
            self.control.proposed = 0.02 * duration
        self.steps = self.switches = self.knot = self.done = 0
        self.now, self.fall, self.pressed = 0.0 if self.struck else float(self.t[0]), 0.0, False
        self.weight = float(scene.values[0]) if self.struck else 0.0
        self.gravity = self.weight / float(scene.mass[-1]) if self.struck else 0.0
        self._begin(start)

    def _begin(self, start: Array) -> None:
        """Fill the initial state and its scales; the nodes below the last mass are at rest."""
        step, heights = self.step, self.scene.heights
        for i, row in enumerate(self.scene.rows):
            branch = plain(kernels.first_branch)(row)
            if start.shape[1] > 0:
                branch = plain(kernels.branch_at_strain)(row, branch, start[0, i])
            step.enter(i, branch)
        if start.shape[1] > 0:
            step.eps0, step.d_eps0 = start[0].copy(), start[1:].copy()
        longer = step.d_eps0 * heights
        longer += step.longer[..., 0] * step.eps0
        step.w[self.above] = np.cumsum(heights * step.eps0)[self.above]
        step.d_w[:, self.above] = np.cumsum(longer[:, self.above], axis=1)
        self.control.motion = float(np.abs(heights * step.eps0).max())
        step.settle()
        self.control.stress = float(np.abs(step.stress0).max())
        if len(longer) and self.scene.top == scenes.MOTION and self.scene.ends.size == 1:
            step.z[:] = 0.0
            step.eps = np.repeat(step.eps0[:, None], STAGES, axis=1)
            step.d_base = step.stress_tangents(step.d_eps0[..., None])[:, 0, 0]
        if self.struck:
            step.v0[-1] = step.v[-1] = self.scene.speed
            self.done = int(np.searchsorted(self.t, 0.0))
            before = slice(0, self.done)
            self.out.curves[:, before], self.out.slopes[:, :, before] = 0.0, 0.0
            falling = self.scene.speed + 0.5 * self.gravity * self.t[before]
            self.out.curves[-1, before] = falling * self.t[before]

    def follow(self, max_steps: int) -> None:
        """Take steps until the run ends, which raises `_EndError`."""
        step, stalled = self.step, 0
        while self.steps < max_steps:
            if self.done == self.t.size:
                raise _EndError(scenes.DONE, math.nan)
            horizon, push, push_rate = float(self.t[-1]), self.weight, 0.0
            if not self.struck:
                horizon, push, push_rate = self._drive(self.steps == 0 and stalled == 0)
            step.settle()
            free = (step.slope0 == 0.0) & (self.scene.rows[:, ETA] == 0.0)  # on a flat branch
            if self.scene.top == scenes.STRESS and free[self.above].any():
                raise _EndError(scenes.FLAT_UNDER_STRESS, self.now)
            base = self._base_stress(push)
            if horizon <= self.now:  # a single sample, or the last one
                curves, slopes = self.out.curves[:, self.done :], self.out.slopes[..., self.done :]
                curves[0], curves[1:] = base, step.w[self.nodes, None]
                slopes[:, 0], slopes[:, 1:] = step.d_base[:, None], step.d_w[:, self.nodes, None]
                raise _EndError(scenes.DONE, math.nan)
            start = Start(self.now, base, self.pressed, push, push_rate)
            span = min(horizon - self.now, self.control.proposed)
            span, arrived, event = self._longest_step(start, span)
            leaves = arrived and event.which == self.count
            stalled += 1
            if span > 0.0 and self.now + span > self.now:
                stalled = 0
                self._take(span, horizon, leaves)
            elif stalled > 4 * self.count + 8:
                raise _EndError(scenes.STEP_UNDERFLOW, self.now)
            if arrived and not leaves:
                opened = self._switch(event, span)
                leaves = opened and self.struck and self.pressed
            if leaves:
                self._fly()
                raise _EndError(scenes.DONE, self.now)
        raise _EndError(scenes.TOO_MANY_STEPS, self.now)

    def _longest_step(self, start: Start, span: float) -> tuple[float, bool, Event]:
        """Return the longest step, whether it ends at an event, and that event."""
        step, control, now = self.step, self.control, start.now
        longest, trials, event = span, 0, Event(1.0, -1, 0)
        first, first_error = span, math.inf
        for _ in range(200):
            if now + span <= now:
                break
            self._guess(span)
            if not step.collocate(start.push, start.push_rate, span, control.motion):
                span *= 0.3
                longest, trials, event = span, 0, Event(1.0, -1, 0)
                continue
            error = control.error(start)
            if trials == 0:
                if first_error == math.inf:
                    first, first_error = span, error
                rounded = span <= 1e-6 * first and error > 0.3 * first_error
                allowed = control.allowed(now, span, error, rounded)
                if allowed < span:
                    longest = span = allowed
                    continue
            trials += 1
            what, span, event = control.aim(start, self.struck, span, longest, trials > 13, event)
            if what != AGAIN:
                return span, what != FREELY, event
        if (step.ahead() < 1e-3).any():
            raise _EndError(scenes.NOT_FINITE, now)
        raise _EndError(scenes.STEP_UNDERFLOW, now)

    def _guess(self, span: float) -> None:
        """Fill z with the motion of the last step, extrapolated."""
        step, taken = self.step, self.control.taken
        times = span * NODES
        if 0.0 < span <= 2.0 * taken:
            powers = (1.0 + times / taken) ** np.arange(STAGES + 1)[:, None] - 1.0
            step.z = step.moves @ powers - step.v0[:, None] * times
        else:
            step.z = (step.v - step.v0)[:, None] * times
        if step.held:
            step.z[-1] = 0.0

    def _take(self, span: float, horizon: float, leaves: bool) -> None:
        """Accept a step: write its samples and advance the state."""
        step, control = self.step, self.control
        last = span >= horizon - self.now or self.now + span >= horizon
        end = horizon if last else self.now + span
        begun = self.done
        self.done = max(begun, int(np.searchsorted(self.t, end, "right" if last else "left")))
        step.moves = polynomial(0.0, step.z + step.v0[:, None] * (span * NODES))
        if not self._record(slice(begun, self.done), span):
            raise _EndError(scenes.NOT_FINITE, self.now)
        self.steps += 1
        wait = float(self.t[min(begun, self.t.size - 1)]) - self.now
        self.vibrations.remember(step, span, wait)
        step.carry(span)
        if self.scene.top != scenes.STRESS:
            control.motion = max(control.motion, abs(float(step.w[-1])))
        self.fall = slope_at_end(control.ending) / span
        risen = float(step.total[0, -1]) > 10.0 * control.slack()[1]
        self.pressed = self.pressed or (not leaves and risen)
        self.now = end
        control.note(span, last)

    # ---------------------------------------------------------------- the state between steps

    def _drive(self, fresh: bool) -> tuple[float, float, float]:
        """Prescribe motion or stress until the next sample; return its time, stress and rate."""
        t, values, step = self.t, self.scene.values, self.step
        while self.knot < t.size - 2 and self.now >= t[self.knot + 1]:
            self.knot, fresh = self.knot + 1, True
        knot, rate, horizon = self.knot, 0.0, float(t[-1])
        if t.size > 1:
            horizon = float(t[knot + 1])
            rate = float(values[knot + 1] - values[knot]) / (horizon - float(t[knot]))
        if self.scene.top != scenes.MOTION:
            return horizon, float(values[knot]) + rate * (self.now - float(t[knot])), rate
        if fresh:
            if knot > 0 and self.scene.ends.size == 1:
                self._mend_kink(rate - float(step.v0[-1]))
            # Remove accumulated rounding errors.
            step.eps0[-1] += (values[knot] - step.w[-1]) / self.scene.heights[-1]
            step.w[-1] = values[knot]
        step.v0[-1] = step.v[-1] = rate
        return horizon, 0.0, 0.0

    def _base_stress(self, push: float) -> float:
        """Return the stress of the springs below the lowest node with a state."""
        scene, first = self.scene, self.first
        alone = scene.ends.size == 1
        if alone and scene.top == scenes.STRESS:
            return push
        stress = self.step.stress0[:first]
        eta = scene.rows[:first, ETA]
        if (eta == 0.0).any():
            return float(stress[eta == 0.0][0])
        share = scene.heights[:first] / eta
        rate, flow = float((share * stress).sum()), float(share.sum())
        if alone and scene.top == scenes.VISCOUS:
            return (rate + push / scene.drag) / (flow + 1.0 / scene.drag)
        return (rate + float(self.step.v0[first - 1])) / flow

    def _switch(self, event: Event, span: float) -> bool:
        """Change the branch of a spring, and of all that reach an end at the same time.

        Return whether an undamped spring of the first group opened, so that the base is unloaded.
        """
        step, opened = self.step, False
        out = np.zeros(self.count)
        if span > 0.0:
            tilt = self.control.strains[:, 1:] @ np.arange(1.0, STAGES + 1.0)
            out[(tilt > 0.0) & (step.eps0 >= step.high - 1e-12)] = 1.0
            out[(tilt < 0.0) & (step.eps0 <= step.low + 1e-12)] = -1.0
        out[event.which] = event.side
        for i in np.flatnonzero(out):
            left, up = int(step.branches[i]), out[i] > 0.0
            entered = plain(kernels.above if up else kernels.below)(left)
            undamped = self.scene.rows[i, ETA] == 0.0
            opened = opened or bool(entered == OPEN and i < self.first and undamped)
            eps = (step.high if up else step.low)[i]
            if self.switches < len(self.log):
                self.log[self.switches] = self.now, i, left, entered, eps
            self.switches += 1
            step.enter(int(i), entered)
        return opened

    # ---------------------------------------------------------------- samples

    def _record(self, done: slice, span: float) -> bool:
        """Write the samples and derivatives of a step; return false if there are no derivatives."""
        step, (_, curves, slopes) = self.step, self.out
        at = (self.t[done] - self.now) / span
        powers = at ** np.arange(STAGES + 1)[:, None]
        curves[0, done] = self.control.ending @ powers
        curves[1:, done] = step.w[self.nodes, None] + step.moves[self.nodes] @ powers
        if not len(slopes):
            return True
        if not step.linearise(span):
            return False
        # Without inertia or dashpots, derivatives by a dashpot jump at switches and kinks, so the
        # polynomial passes through the points only, not through the end of the last step.
        through = THROUGH.T @ powers[:-1]
        slopes[:, 0, done] = step.d_total[:, 0] @ through
        start = step.d_w[:, self.nodes, None] + step.d_v0[:, self.nodes, None] * (at * span)
        slopes[:, 1:, done] = start + step.d_z[:, self.nodes] @ through
        step.carry_tangents(span)
        return True

    def _mend_kink(self, jump: float) -> None:
        """Give dashpots the mean rate at a sample where the prescribed rate jumps by `jump`."""
        t, k, heights, eta = self.t, self.knot, self.scene.heights, self.scene.rows[:, ETA]
        flow = float((heights / eta).sum())
        share = jump * float((t[k] - t[k - 1]) / (t[k + 1] - t[k - 1]))
        self.out.curves[0, k] += share / flow
        for p, (i, what) in enumerate(self.step.directions if flow < math.inf else ()):
            if what in (OWN_ETA, OWN_HEIGHT):
                more = 1.0 / eta[i] if what == OWN_HEIGHT else -heights[i] / (eta[i] * eta[i])
                self.out.slopes[p, 0, k] -= share / (flow * flow) * more

    def _fly(self) -> None:
        """Fill the samples after contact, which ends now, and their derivatives.

        These include the shift of the end of contact: the nodes move on until then, and the top
        keeps its velocity from then on.
        """
        step, (_, curves, slopes) = self.step, self.out
        done = slice(self.done, None)
        later = self.t[done] - self.now
        curves[0, done] = 0.0
        curves[1:, done] = step.w[self.nodes, None] + step.v[-1] * later
        curves[1:, done] += 0.5 * self.gravity * later**2
        if not len(slopes):
            return
        pull = -(float(step.total[-1, -1]) + step.drag * step.v[-1]) / step.mass[-1]
        late = -step.d_base[:, None] / self.fall if self.fall != 0.0 else 0.0 * step.d_base[:, None]
        place = step.d_w + (step.v - step.v[-1]) * late
        speed = step.d_v0[:, -1:] + pull * late
        slopes[:, 0, done] = 0.0
        slopes[:, 1:, done] = place[:, self.nodes, None] + speed[..., None] * later
