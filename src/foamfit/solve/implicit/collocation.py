"""One implicit step of a chain on fixed branches: Radau IIA collocation, and its linearisation.

A step is a polynomial in time that satisfies the balance of every node at five Radau points (order
9):

    μ_i d²w_i/dt² + c dw_i/dt + Σ_i - Σ_{i+1} = p,      Σ_i = σ_i(ε_i) + η_i dε_i/dt

For a node without mass or a spring without dashpot a term vanishes, so that massless, undamped and
mixed chains are one case. Newton's method with the exact Jacobian solves for the displacements of
all nodes at the points. The linear systems keep the stresses of the springs as unknowns, so that a
soft spring next to a stiff one loses no digits. They are banded, and their cost is proportional to
the number of springs. The derivatives by parameters solve the same equations, linearised.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from foamfit.arrays import Array
from foamfit.solve.scene import FREE, MOTION, Scene
from foamfit.springs import kernels
from foamfit.springs.parameters import DRAG, OWN_ETA, OWN_HEIGHT
from foamfit.springs.sensitivities import branch_derivative

STAGES = 5
_BAND = 2 * STAGES - 1  # diagonals of the linear systems on each side of the main one
_ROWS = 3 * _BAND + 1  # of LAPACK's band storage, with room for the factors


def radau(stages: int) -> tuple[Array, Array]:
    """Return the nodes c and the matrix A of the Radau IIA method of order 2 stages - 1."""
    series = np.zeros(stages + 1)
    series[-2:] = 1.0, -1.0
    nodes = np.sort(0.5 * (1.0 + np.real(np.polynomial.legendre.legroots(series))))
    nodes[-1] = 1.0
    powers = np.arange(1, stages + 1)
    integrals = nodes[:, None] ** powers / powers
    values = nodes[:, None] ** (powers - 1)
    return nodes, np.asarray(np.linalg.solve(values.T, integrals.T).T, dtype=np.float64)


NODES, WEIGHTS = radau(STAGES)
# Matrices from increments at the points to: their first and second time derivatives times step,
RATES = np.linalg.inv(WEIGHTS)
RATES_2 = RATES @ RATES
# coefficients 1 … 5 of the polynomial over the step [0, 1],
COEFFICIENTS = np.linalg.inv(NODES[:, None] ** np.arange(1, STAGES + 1))
# and, from values at the points, coefficients 0 … 4 of the polynomial through the points only.
THROUGH = np.linalg.inv(NODES[:, None] ** np.arange(STAGES))


def plain(loop: Any) -> Any:
    """Return the Python function of a compiled function."""
    return getattr(loop, "py_func", loop)


def relative(nodes: Array) -> Array:
    """Return differences of neighbouring nodes, along the second last axis, for the springs."""
    out = nodes.copy()
    out[..., 1:, :] -= nodes[..., :-1, :]
    return out


def polynomial(first: Array | float, points: Array) -> Array:
    """Return polynomials over [0, 1] through `first` at 0 and the values at the points."""
    out = np.empty((*points.shape[:-1], STAGES + 1))
    out[..., 0] = first
    out[..., 1:] = (points - out[..., :1]) @ COEFFICIENTS.T
    return out


class Step:
    """A chain, its state at the start of a step, and the solution at the points of the step.

    State, (springs,): displacements `w` and velocities `v` of the nodes; `v0`, the velocities of
    nodes with a mass or prescribed motion (0 for others); strains `eps0`; `branches` and the
    strains `low` and `high` at which they end; stresses `stress0` and slopes `slope0` of the law.
    `moves` (springs, 6) are the polynomials of the last motion. Solution, (springs, points): node
    displacements `z` beyond v0 times time, strains `eps`, node velocities `vel`, stress of the law
    `stress`, with dashpots `total`, and `slope` dσ/dε. Derivatives in p directions: `d_w`, `d_v0`,
    `d_eps0` (p, springs), `d_z`, `d_eps`, `d_total` (p, springs, points), and `d_base` (p,) of the
    last base stress.
    """

    def __init__(self, scene: Scene, directions: kernels.Branches) -> None:
        self.rows, self.heights, self.drag = scene.rows, scene.heights, scene.drag
        count, p = scene.heights.size, len(directions)
        self.height, self.eta = self.heights[:, None], self.rows[:, kernels.ETA, None]
        self.mass = np.zeros(count)
        inside = slice(None, None if scene.top == FREE else -1)
        self.mass[scene.ends[inside] - 1] = scene.mass[inside]
        self.heavy, self.held = self.mass > 0.0, scene.top == MOTION
        self.branches, self.low, self.high = np.empty(count, np.int64), *np.zeros((2, count))
        self._shape = np.zeros((4, count, 1))  # curved, k, x0, s0
        self.w, self.v, self.v0, self.eps0 = np.zeros((4, count))
        self.z, self.moves = np.zeros((count, STAGES)), np.zeros((count, STAGES + 1))
        self.directions = directions
        self.d_shape = np.zeros((3, p, count, 1))  # of k, x0, s0
        self.d_w, self.d_v0, self.d_eps0 = np.zeros((3, p, count))
        self.d_base = np.zeros(p)
        own, what = directions[:, :1], directions[:, 1:]
        mine = own == np.arange(count)
        self.longer = np.where(mine & (what == OWN_HEIGHT), 1.0, 0.0)[..., None]
        self._damped = np.where(mine & (what == OWN_ETA), 1.0, 0.0)[..., None]
        self._dragged = np.where(what == DRAG, 1.0, 0.0)
        self._lay_out(count)

    def enter(self, i: int, branch: int) -> None:
        """Put spring i on a branch."""
        row = self.rows[i]
        self.branches[i] = branch
        self.low[i], self.high[i] = plain(kernels.interval)(row, branch)
        self._shape[:, i, 0] = plain(kernels.branch_shape)(row, branch)
        for p, (spring, what) in enumerate(self.directions):
            if spring == i and what < OWN_ETA:
                self.d_shape[:, p, i, 0] = plain(branch_derivative)(row, branch, what)

    def settle(self) -> None:
        """Compute stresses and slopes at the start of the next step."""
        stress, slope = self.law(self.eps0[:, None])
        self.stress0, self.slope0 = stress[:, 0], slope[:, 0]

    def law(self, eps: Array) -> tuple[Array, Array]:
        """Return stress and slope dσ/dε at strains (springs, …); infinite past a branch's end."""
        curved, k, x0, s0 = self._shape
        x = eps - x0
        rest = 1.0 - x
        bent = np.where(rest > 0.0, k * x / rest, math.inf)
        return np.where(curved, bent, s0 + k * x), np.where(curved, k / (rest * rest), k)

    def stress_tangents(self, d_eps: Array) -> Array:
        """Return derivatives of the stresses at the points from those of the strains."""
        (curved, k, x0, _), (dk, dx0, ds0) = self._shape, self.d_shape
        x = self.eps - x0
        at_rest = np.where(curved, x / (1.0 - x), x) * dk + ds0
        slope = np.where(curved, k / (1.0 - x) ** 2, k)
        out: Array = at_rest + slope * (d_eps - dx0)
        return out

    def ahead(self) -> Array:
        """Return the distances of the strains from the ends of curved branches."""
        curved, _, x0, _ = self._shape[..., 0]
        return np.where(curved > 0.0, 1.0 - (self.eps0 - x0), math.inf)

    def _fill(self, span: float) -> bool:
        """Compute the solution from z; return false past the end of a branch."""
        self.vel = self.v0[:, None] + self.z @ RATES.T / span
        moved = relative(self.z + self.v0[:, None] * (span * NODES))
        self.stretching = relative(self.vel) / self.height
        self.eps = self.eps0[:, None] + moved / self.height
        self.stress, self.slope = self.law(self.eps)
        self.total = self.stress + self.eta * self.stretching
        return bool(np.isfinite(self.stress).all())

    # ---------------------------------------------------------------- the linear systems

    def _lay_out(self, count: int) -> None:
        """Compute the places of the entries in LAPACK's band storage.

        The unknowns of spring i are its stresses and the displacements above it, at the points.
        """
        i, j, k = np.ogrid[:count, :STAGES, :STAGES]
        spring, node = 2 * STAGES * i, 2 * STAGES * i + STAGES

        def place(row: Any, column: Any) -> NDArray[np.int64]:
            return np.asarray(column * _ROWS + 2 * _BAND + row - column).ravel()

        self._entries = np.concatenate(
            [
                place(spring + j, node + k),
                place(spring + j, node - 2 * STAGES + k)[STAGES * STAGES :],
                place(node + j, node + k),
            ]
        )
        self._empty = np.zeros(2 * STAGES * count * _ROWS)
        i, j = np.ogrid[:count, :STAGES]
        spring, node = 2 * STAGES * i + j, 2 * STAGES * i + STAGES + j
        self._empty[place(spring, spring)] = -1.0
        self._empty[place(node, spring)] = 1.0
        self._empty[place(node, spring + 2 * STAGES)[:-STAGES]] = -1.0
        if self.held:
            self._empty[place(node, spring)[-STAGES:]] = 0.0
        self._soft = 1e-12 * self.rows[:, kernels.K0, None]

    def _solve(self, residual: Array, span: float) -> Array | None:
        """Return displacements (…, springs, points) that balance forces; None if singular."""
        count = self.heights.size
        stiff = self.eta[..., None] / (self.height[..., None] * span) * RATES
        # Keep the Newton step bounded on a flat branch.
        diagonal = np.maximum(self.slope, self._soft) / self.height
        stiff[:, range(STAGES), range(STAGES)] += diagonal
        unit = float(np.abs(stiff).max())
        stiff /= unit
        heavy = (self.mass / (span * span * unit))[:, None, None] * RATES_2
        if self.held:
            heavy[-1] = np.eye(STAGES)
        elif self.drag > 0.0:
            heavy[-1] += self.drag / (span * unit) * RATES
        band = self._empty.copy()
        entries = (stiff.ravel(), -stiff[1:].ravel(), heavy.ravel())
        band[self._entries] = np.concatenate(entries)
        columns = math.prod(residual.shape[:-2])
        right = np.zeros((columns, count, 2, STAGES))
        right[:, :, 1] = (residual / unit).reshape(columns, count, STAGES)
        if self.held:
            right[:, -1] = 0.0
        matrix, sides = band.reshape(-1, _ROWS).T, right.reshape(columns, -1).T
        x, info = lapack.dgbsv(_BAND, _BAND, matrix, sides, overwrite_ab=1, overwrite_b=1)[2:]
        if info != 0:
            return None
        out: Array = x.T.reshape(columns, count, 2, STAGES)[:, :, 1].reshape(residual.shape)
        return out

    def _net(self, total: Array) -> Array:
        """Return the net stress on each node from the stresses of the springs."""
        out = -total
        out[..., :-1, :] += total[..., 1:, :]
        return out

    # ---------------------------------------------------------------- Newton's method

    def collocate(self, push: float, push_rate: float, span: float, reach: float) -> bool:
        """Solve one step by Newton's method from the guess in z; return false if it fails."""
        if not self._fill(span):
            self.z[:] = 0.0
            if not self._fill(span):
                return False
        if self.held and self.heights.size == 1:
            return True
        before, slow = math.inf, 0
        pushed = push + push_rate * span * NODES
        for _ in range(30):
            residual = self._net(self.total)
            residual[-1] += pushed - self.drag * self.vel[-1]
            residual -= (self.mass / (span * span))[:, None] * (self.z @ RATES_2.T)
            delta = self._solve(residual, span)
            if delta is None or not np.isfinite(delta).all():
                return False
            size = float(np.abs(delta).max())
            moved = float(np.abs(self.z + self.v0[:, None] * (span * NODES)).max())
            gain = relative(delta) / self.height
            most = 0.9 * (1.0 - (self.eps - self._shape[2]))
            ahead = (gain > most) & (self._shape[0] > 0.0)
            part = float((most / gain)[ahead].min()) if ahead.any() else 1.0
            self.z += part * delta
            if not self._fill(span):
                return False
            if part == 1.0:
                if size <= 1e-8 * moved + 1e-15 * reach:
                    return True
                slow = slow + 1 if size > 0.5 * before else 0
                if slow > 5:  # near a pole corrections may grow at first
                    return False
                before = size
        return False

    def linearise(self, span: float) -> bool:
        """Compute the derivatives at the points of a solved step; return false if singular.

        First those of the forces by parameters and initial state at fixed z, then those of z.
        """
        d_v = relative(self.d_v0[..., None])
        moved = d_v * (span * NODES) - (self.eps - self.eps0[:, None]) * self.longer
        self.d_eps = self.d_eps0[..., None] + moved / self.height
        self.d_total = self.stress_tangents(self.d_eps)
        self.d_total += self.eta * (d_v - self.stretching * self.longer) / self.height
        self.d_total += self.stretching * self._damped
        net = self._net(self.d_total)
        net[:, -1] -= self.drag * self.d_v0[:, -1:] + self.vel[-1] * self._dragged
        d_z = self._solve(net, span)
        if d_z is None:
            return False
        self.d_z = d_z
        moved = relative(d_z) / self.height
        self.d_eps += moved
        self.d_total += self.slope * moved + self.eta * (moved @ RATES.T) / span
        return True

    # ---------------------------------------------------------------- the end of a step

    def carry(self, span: float) -> None:
        """Advance the state over a step."""
        self.w += self.z[:, -1] + span * self.v0
        self.eps0, self.v = self.eps[:, -1].copy(), self.vel[:, -1].copy()
        self.v0 = np.where(self.heavy, self.v, self.v0)

    def carry_tangents(self, span: float) -> None:
        """Advance the derivatives of the state over a step."""
        self.d_w += self.d_z[..., -1] + span * self.d_v0
        self.d_eps0 = self.d_eps[..., -1].copy()
        self.d_v0 += np.where(self.heavy, self.d_z @ RATES[-1] / span, 0.0)
        self.d_base = self.d_total[:, 0, -1].copy()
