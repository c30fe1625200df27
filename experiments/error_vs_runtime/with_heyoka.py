"""heyoka's Taylor integrator for the impact on one bistable spring: one integrator per branch.

It is compiled just in time, and finds ends of branches and of contact as terminal events. heyoka is
an optional dependency of this study alone: `pip install heyoka`.
"""

import math
from typing import Any

import heyoka as hy
import numpy as np

import independent as law
from independent import Array

FREE = -1  # the branch of a striker that has flown off


class Impact:
    """An impact of a striker on one undamped bistable spring, at one tolerance."""

    def __init__(self, chain: Any, drive: Any, time: Array, tol: float) -> None:
        """Compile the integrators of the four branches, and the ends of each."""
        (self.height,), (spring,) = chain.heights, chain.springs
        assert spring.eta == chain.site_damping == 0.0
        self.time, self.velocity = time, drive.velocity
        self.row = row = law.row_of(spring, self.height)[0]
        ends: dict[int, list[tuple[float, int]]] = {  # strains, and the branches beyond
            law.A: [(row[law.EPS_A], law.D), (0.0, FREE)],
            law.D: [(row[law.HAT_C], law.C), (row[law.EPS_A], law.A)],
            law.C: [(row[law.EPS_C], law.E)],
            law.E: [(row[law.EPS_C], law.C), (row[law.HAT_A], law.A),
                    (row[law.EPS_C] - row[law.SIG_C] / row[law.DOWN], FREE)],
        }  # fmt: skip
        w, v = hy.make_vars("w", "v")
        push = -chain.area / drive.mass
        self.integrators, self.beyond = {}, dict[int, list[int]]()
        for branch, own in ends.items():
            known = [(at, to) for at, to in own if at > -math.inf]
            self.beyond[branch] = [to for _, to in known]
            ways = ("positive" if to in (law.D, law.C) else "negative" for _, to in known)
            ways = [getattr(hy.event_direction, way) for way in ways]
            self.integrators[branch] = hy.taylor_adaptive(
                [(w, v), (v, push * self.stress(branch, w / self.height))], [0.0, 0.0], tol=tol,
                t_events=[hy.t_event(w / self.height - at, direction=way)
                          for (at, _), way in zip(known, ways, strict=True)],
            )  # fmt: skip

    def stress(self, branch: int, eps: Any) -> Any:
        """Return the stress on a branch: numbers, or an expression for heyoka."""
        row = self.row
        if branch == law.A:
            return row[law.K0] * eps / (1.0 - eps)
        if branch == law.C:
            return row[law.KC] * (eps - row[law.STAR]) / (1.0 - (eps - row[law.STAR]))
        if branch == law.D:
            return row[law.SIG_A] + row[law.UP] * (eps - row[law.EPS_A])
        return row[law.SIG_C] + row[law.DOWN] * (eps - row[law.EPS_C])

    def run(self) -> tuple[Array, Array]:
        """Return displacement of the striker and base stress at the samples."""
        time, branch, done = self.time, law.A, 1  # the first sample is at rest
        moved, base = np.zeros(time.size), np.zeros(time.size)
        now, state = float(time[0]), (0.0, self.velocity)
        while done < time.size and branch != FREE:
            integrator = self.integrators[branch]
            integrator.reset_cooldowns()
            integrator.time, integrator.state[:] = now, state
            outcome, *_, rows = integrator.propagate_grid(np.append(now, time[done:]))
            last = done + len(rows) - 1
            moved[done:last] = rows[1:, 0]
            base[done:last] = self.stress(branch, rows[1:, 0] / self.height)
            now, state, done = integrator.time, tuple(integrator.state), last
            if done < time.size:
                branch = self.beyond[branch][-int(outcome) - 1]
        moved[done:] = state[0] + state[1] * (time[done:] - now)
        return moved, base
