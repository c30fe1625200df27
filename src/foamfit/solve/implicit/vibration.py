"""Estimate of the vibrations of masses that implicit steps do not resolve but damp out.

A response can then be rejected if this error exceeds its tolerance.
"""

from __future__ import annotations

import numpy as np

from foamfit.arrays import Array
from foamfit.solve.implicit.collocation import COEFFICIENTS, Step
from foamfit.solve.scene import FREE, STRESS, Scene
from foamfit.springs.kernels import ETA


class Vibrations:
    """Vibrations of the masses, (groups,) each, between neighbours that are assumed fixed.

    `own` is the angular frequency, 1/s, `fade` its decay rate, 1/s, and `stiff` the stiffness on
    the stiffer side. `alive` is the unresolved vibration, `fading` its decay rate, and `worst` its
    largest motion and stress at a sample.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.first = np.concatenate(([0], scene.ends[:-1]))  # spring of each group
        self.swings = np.arange(scene.ends.size) < scene.ends.size - (scene.top != FREE)
        self.own, self.fade, self.stiff = np.zeros((3, scene.ends.size))
        self.alive, self.fading = np.zeros((2, scene.ends.size))
        self.worst = np.zeros(2)
        eta = scene.rows[:, ETA]
        flow = np.where(eta > 0.0, scene.heights / np.where(eta > 0.0, eta, 1.0), np.inf)
        group = self._with_ends(1.0 / np.add.reduceat(flow, self.first))
        damping = group[:-1] + group[1:]
        damping[-1] += scene.drag
        self._decay = np.where(self.swings, 0.5 * damping / scene.mass, 0.0)

    def _with_ends(self, groups: Array) -> Array:
        """Append 0 for the free end; under a prescribed stress the last group resists nothing."""
        out = np.append(groups, 0.0)
        if self.scene.top == STRESS:
            out[-2] = 0.0
        return out

    def unresolved(self, span: float) -> bool:
        """Whether a mass vibrates too fast for a step and keeps vibrating after it."""
        fast = (self.own * span > 0.5) & (self.fade < self.own) & (self.fade * span < 20.0)
        return bool(fast.any())

    def remember(self, step: Step, span: float, wait: float) -> None:
        """Add the vibrations that a step was too long to resolve to those the response lacks.

        A mass whose velocity differs by δv from the initial velocity of the step's polynomial then
        vibrates with amplitude δv/ω. `alive` sums δv/√ω over all steps, because a vibration whose
        stiffness changes slowly conserves energy over frequency. In a row of masses the slowest
        unresolved vibration decays last, with the amplitude of all of them together; `fading` is
        its decay rate. `worst` includes the vibration left after `wait`, at the first sample that
        may show it.
        """
        scene = self.scene
        if not self.swings.any():
            return
        soft = scene.heights / step.slope0
        stiffness = self._with_ends(1.0 / np.add.reduceat(soft, self.first))
        below, above = stiffness[:-1], stiffness[1:]
        self.own = np.where(self.swings, np.sqrt((below + above) / scene.mass), 0.0)
        moves = self.own > 0.0
        self.fade = np.where(moves, self._decay, 0.0)
        self.stiff = np.where(moves, np.maximum(below, above), 0.0)
        root = np.sqrt(np.where(moves, self.own, 1.0))
        passed = moves & (self.own * span > 2.0) & (self.fade < self.own)
        if passed.any():
            kick = np.abs(step.z[scene.ends - 1] @ COEFFICIENTS[0]) / span
            started = np.where(passed, kick / root, 0.0)
            row = np.sin(0.5 * np.pi / max(scene.ends.size, 2))
            share = np.maximum(2.0 * row * row, 4.0 / (np.where(moves, self.own, 1.0) * span) ** 2)
            slow = self.fade * np.minimum(share, 1.0)
            lasting = self.alive > 1e-3 * started
            slow = np.where(lasting, np.minimum(slow, self.fading), slow)
            self.fading = np.where(passed, slow, self.fading)
            self.alive += started
        if not self.alive.any():
            return
        size = np.where(moves, self.alive / root * np.exp(-self.fading * wait), 0.0)
        self.worst = np.maximum(self.worst, (size.sum(), (self.stiff * size).max()))
        self.alive = np.where(moves, self.alive * np.exp(-self.fading * span), self.alive)
