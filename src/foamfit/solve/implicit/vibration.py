"""What implicit steps do not resolve of the vibrations of masses.

They damp out what is too fast for them. How much that is, is estimated here, so that a response can
be refused where it exceeds its tolerance.
"""

from __future__ import annotations

import numpy as np

from foamfit.arrays import Array
from foamfit.solve.implicit.collocation import COEFFICIENTS, Step
from foamfit.solve.scene import FREE, STRESS, Scene
from foamfit.springs.kernels import ETA


class Vibrations:
    """Vibrations of the masses, (groups,) each, between neighbours that are taken as fixed.

    `own` is the rate and `fade` that of its decay, 1/s, `stiff` the stiffness on the stiffer side.
    `alive` is what steps did not resolve, `worst` the largest motion and stress that it had at a
    sample.
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
        damp = self._held(1.0 / np.add.reduceat(flow, self.first))
        hold = damp[:-1] + damp[1:]
        hold[-1] += scene.drag
        self._decay = np.where(self.swings, 0.5 * hold / scene.mass, 0.0)

    def _held(self, groups: Array) -> Array:
        """What holds the masses from below and above, (groups + 1,), from that of the groups."""
        out = np.append(groups, 0.0)
        if self.scene.top == STRESS:
            out[-2] = 0.0
        return out

    def unresolved(self, span: float) -> bool:
        """Whether a mass vibrates too fast for a step and goes on vibrating after it."""
        fast = (self.own * span > 0.5) & (self.fade < self.own) & (self.fade * span < 20.0)
        return bool(fast.any())

    def remember(self, step: Step, span: float, wait: float) -> None:
        """Add what a step was too long to show to the vibrations that the answer lacks.

        A mass whose velocity differs by δv from that at which the polynomial of the step sets out
        vibrates from then on by δv/ω. `alive` is δv/√ω of all steps so far: a vibration whose
        stiffness changes slowly keeps its energy over its frequency. `fading` is the rate at which
        it dies out: of masses in a row the slowest vibration that the step is too long for decays
        last, and moves as far as all of them together. `worst` counts what is left after `wait`, at
        the first sample that may show it.
        """
        scene = self.scene
        if not self.swings.any():
            return
        soft = scene.heights / step.slope0
        hold = self._held(1.0 / np.add.reduceat(soft, self.first))
        below, above = hold[:-1], hold[1:]
        self.own = np.where(self.swings, np.sqrt((below + above) / scene.mass), 0.0)
        moves = self.own > 0.0
        self.fade = np.where(moves, self._decay, 0.0)
        self.stiff = np.where(moves, np.maximum(below, above), 0.0)
        root = np.sqrt(np.where(moves, self.own, 1.0))
        passed = moves & (self.own * span > 2.0) & (self.fade < self.own)
        if passed.any():
            kick = np.abs(step.z[scene.ends - 1] @ COEFFICIENTS[0]) / span
            begun = np.where(passed, kick / root, 0.0)
            row = np.sin(0.5 * np.pi / max(scene.ends.size, 2))
            share = np.maximum(2.0 * row * row, 4.0 / (np.where(moves, self.own, 1.0) * span) ** 2)
            slow = self.fade * np.minimum(share, 1.0)
            lasting = self.alive > 1e-3 * begun
            slow = np.where(lasting, np.minimum(slow, self.fading), slow)
            self.fading = np.where(passed, slow, self.fading)
            self.alive += begun
        if not self.alive.any():
            return
        size = np.where(moves, self.alive / root * np.exp(-self.fading * wait), 0.0)
        found = size.sum(), (self.stiff * size).max()
        self.worst = np.maximum(self.worst, found)
        self.alive = np.where(moves, self.alive * np.exp(-self.fading * span), self.alive)
