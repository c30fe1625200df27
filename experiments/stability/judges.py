"""The judges of the stability study: the balance of energy, and refinement of the steps.

The first knows the law and the equations of model and experiment, but nothing of the solver: it
takes displacements and base stress as they are answered, on panels of Gauss points between the
switches, and adds up what was put in, what moves, what the springs have taken (with what their
loops keep) and what the dashpots have turned into heat. Velocities of the top come from its balance
of momentum, so that only the light nodes inside and the dashpots need a derivative in time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import foamfit as ff
from foamfit.solve.plan import MOST_WORK, Motion, plan

Scene = tuple[ff.Chain, ff.Impact | ff.StressDrive | ff.DisplacementDrive, NDArray[np.float64]]
Array = NDArray[np.float64]

POINTS = 8  # Gauss points of a panel; its ends are known too
MOST_PANELS, MOST_NUMBERS, MOST_DRIVEN = 3_000, 400_000, 40_000
MOST_RADIANS = 1e5

_x, _w = np.polynomial.legendre.leggauss(POINTS)
NODES = np.concatenate(([0.0], 0.5 * (1.0 + _x), [1.0]))
GAUSS = 0.5 * _w


def _derivative(nodes: Array) -> Array:
    """Matrix that differentiates a polynomial given at the nodes, by barycentric weights."""
    gap = nodes[:, None] - nodes[None, :] + np.eye(nodes.size)
    weight = 1.0 / gap.prod(axis=1)
    matrix = weight[None, :] / weight[:, None] / gap
    np.fill_diagonal(matrix, 0.0)
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    return matrix


SLOPES = _derivative(NODES)
# The last two Legendre coefficients of a polynomial given at the nodes.
TAIL = np.linalg.inv(np.polynomial.legendre.legvander(2.0 * NODES - 1.0, POINTS + 1))[-2:]


# ---------------------------------------------------------------------------------- the law's work


def _curved(k: float, x: Array) -> Array:
    """Integral of k x/(1-x) from 0."""
    return k * (-x - np.log1p(-x))


def _virgin(s: ff.BistableSpring, eps: Array) -> Array:
    """Work density up to a strain on the way up, by branches a, d and c."""
    c0 = _curved(s.kc, np.array(s.eps_hat_c - s.eps_star))
    at_a = _curved(s.k0, np.array(s.eps_a))
    d = np.clip(eps, s.eps_a, s.eps_hat_c) - s.eps_a
    work = _curved(s.k0, np.minimum(eps, s.eps_a))
    work = np.where(eps > s.eps_a, at_a + s.sigma_a * d + 0.5 * s.kh_plus * d**2, work)
    x = np.maximum(eps, s.eps_hat_c) - s.eps_star
    return work + np.where(eps > s.eps_hat_c, _curved(s.kc, x) - c0, 0.0)


def _returning(s: ff.BistableSpring, eps: Array) -> Array:
    """Work density against C2 on the way down, by branches c, e and a."""
    c2 = _curved(s.kc, np.array(s.eps_c - s.eps_star))
    x = np.maximum(eps, s.eps_c) - s.eps_star
    work = np.where(eps > s.eps_c, _curved(s.kc, x) - c2, 0.0)
    low = -math.inf if s.eps_hat_a is None else s.eps_hat_a
    e = np.clip(eps, low, s.eps_c) - s.eps_c
    work = work + np.where(eps < s.eps_c, s.sigma_c * e + 0.5 * s.kh_minus * e**2, 0.0)
    if math.isfinite(low):
        a = np.minimum(eps, low)
        work = work + _curved(s.k0, a) - _curved(s.k0, np.array(low))
    return work


def work_of(spring: ff.BistableSpring | ff.LinearSpring, eps: Array) -> Array:
    """Work density (J/m³) that a spring has taken along a strain history, exact between turns."""
    if isinstance(spring, ff.LinearSpring):
        held = np.maximum(eps, 0.0) if spring.unilateral else eps
        return 0.5 * spring.k0 * (held**2 - held[0] ** 2)
    branches = spring.branches(eps)
    up = np.isin(branches, ("a", "d"))[:-1]
    steps = np.where(up, np.diff(_virgin(spring, eps)), np.diff(_returning(spring, eps)))
    return np.concatenate(([0.0], np.cumsum(steps)))


# ----------------------------------------------------------------------------------- the time grid


def _rates(chain: ff.Chain, drive: object) -> tuple[float, float]:
    """Largest frequency (rad/s) of a mass and largest rate of relaxation (1/s), in small motion."""
    slope = [max(s.k0, getattr(s, "kc", 0.0), getattr(s, "kh_plus", 0.0)) for s in chain.springs]
    stiff = np.array(slope) / np.array(chain.heights)
    damp = np.array([s.eta for s in chain.springs]) / np.array(chain.heights)
    masses = np.array(chain.masses) / chain.area
    if isinstance(drive, ff.Impact):
        masses[-1] += drive.mass / chain.area
    elif isinstance(drive, ff.DisplacementDrive):
        masses[-1] = 0.0
    ring, fade = 0.0, 0.0
    for i, mass in enumerate(masses):
        above = i + 1 if i + 1 < len(masses) else i
        if mass > 0.0:
            ring = max(ring, math.sqrt((stiff[i] + stiff[above]) / mass))
            fade = max(fade, (damp[i] + damp[above] + chain.site_damping / chain.height) / mass)
    for s, k in zip(chain.springs, slope, strict=True):
        if s.eta > 0.0:
            fade = max(fade, max(slope) / s.eta, k / s.eta)
    if chain.site_damping > 0.0:
        fade = max(fade, stiff.max() * chain.height / chain.site_damping)
    return ring, fade


def panels(edges: Array, least: Array, ring: float, density: float = 1.0) -> Array | None:
    """Ends of panels that are `least` long at each edge and grow away; None if that is too many."""
    ends = [edges[:1]]
    total = 0.0
    few = (6.0 if edges.size < 200 else 1.0) * density
    most = MOST_PANELS * density
    for start, stop, at_start, at_stop in zip(
        edges[:-1], edges[1:], least[:-1], least[1:], strict=True
    ):
        gap = stop - start
        longest = min(gap / few, 1.5 / ring if ring > 0.0 else gap)
        total += gap / longest
        if total > most:
            return None
        sides = []
        for first in (at_start, at_stop):
            growing = max(math.ceil(math.log2(longest / min(first, longest))), 0)
            lengths = min(first, longest) * 2.0 ** np.arange(growing)
            sides.append(lengths[np.cumsum(lengths) < 0.5 * gap])
        rest = gap - sides[0].sum() - sides[1].sum()
        count = max(math.ceil(rest / longest), 1)
        places = start + np.cumsum(np.concatenate((sides[0], np.full(count, rest / count))))
        places = np.concatenate((places, (stop - np.cumsum(sides[1]))[::-1], [stop]))
        ends.append(places[places > ends[-1][-1]])
    found = np.unique(np.concatenate(ends))
    apart = np.diff(found, append=math.inf) > 1e-13 * found  # rounding makes neighbours of one end
    found = np.append(found[:-1][apart[:-1]], found[-1])
    return found if found.size <= most else None


# ------------------------------------------------------------------------------- the energy balance


@dataclass(frozen=True)
class Balance:
    """What the first judge found: residuals over the energy, and the impulse, of the scene."""

    energy: float
    impulse: float

    @property
    def worst(self) -> float:
        """The larger residual."""
        return max(self.energy, self.impulse)


def bare(scene: Scene, rtol: float, implicit: bool | None = None, most: int = MOST_WORK) -> Motion:
    """Run a scene once, without the check by shorter steps that `simulate` makes.

    `most` bounds steps times springs.
    """
    chain, drive, time = scene
    max_steps = most // len(chain.springs) + time.size
    made = plan(chain, drive, time, max_steps=max_steps)._replace(implicit=implicit)
    rows = np.array([spring.row for spring in chain.springs])
    return made.run(rows, np.array(chain.heights), rtol)


def _finer(scene: Scene, grid: Array) -> Scene:
    """Sample a scene on another grid; a sampled drive is linear between its samples."""
    chain, drive, time = scene
    if isinstance(drive, ff.StressDrive):
        drive = ff.StressDrive(np.interp(grid, time, drive.stress))
    elif isinstance(drive, ff.DisplacementDrive):
        drive = ff.DisplacementDrive(np.interp(grid, time, drive.displacement))
    return chain, drive, grid


def _peak(scene: Scene, stop: float, rtol: float, implicit: bool | None) -> tuple[float, float]:
    """Time of the largest compression of an impact, and for how long it is near it."""
    chain, drive, _ = scene
    assert isinstance(drive, ff.Impact)
    low, high = 0.0, stop
    for _ in range(4):
        grid = np.linspace(low, high, 401)
        top = bare((chain, drive, grid), rtol, implicit).displacement[-1]
        j = int(top.argmax())
        low, high = grid[max(j - 2, 0)], grid[min(j + 2, 400)]
    strain = np.diff(bare((chain, drive, grid), rtol, implicit).displacement[:, j], prepend=0.0)
    strain = strain / np.array(chain.heights)
    room = min(
        1.0 - (eps - (s.eps_star if eps > s.eps_c else 0.0))
        for s, eps in zip(chain.springs, strain, strict=True)
        if isinstance(s, ff.BistableSpring)
    )
    return float(grid[j]), 0.05 * room * chain.height / drive.velocity


def _own(answer: ff.Response) -> bool | None:
    """Steps by which an answer is repeated: those that it took, also on a shorter grid."""
    return True if answer.method == "Radau IIA" else None


def _tolerance_of(scene: Scene, answer: ff.Response, rtol: float) -> float:
    """Tolerance at which a single run repeats an answer, which may stem from a finer run.

    Masses that collide at the end of their branches make small errors large (a thousandfold in
    three springs at 45 m/s): there a single run at `rtol` is another motion than the answer.
    """
    for finer in (rtol, 1e-2 * rtol, 1e-4 * rtol, 1e-6 * rtol):
        try:
            if difference(answer, bare(scene, finer, _own(answer))) <= 0.1 * rtol:
                return finer
        except ff.SimulationError:
            break
    return rtol


def balance_of(scene: Scene, answer: ff.Response, rtol: float) -> Balance | None:
    """Balance of energy and impulse of a scene; None where its panels would be too many.

    Where it does not close, it is taken again on denser panels: what was the quadrature's goes away
    then, what is the answer's stays.
    """
    best = None
    own = _tolerance_of(scene, answer, rtol)
    for density in (1.0, 3.0, 10.0, 30.0):
        found = _balance_on_panels(scene, answer, own, density)
        if found is None and best is None:
            return None
        if found is not None and (best is None or found.worst < best.worst):
            best = found
        if best is not None and best.worst <= rtol:
            break
    return best


def _balance_on_panels(
    scene: Scene, answer: ff.Response, rtol: float, density: float
) -> Balance | None:
    """Balance of a scene on panels that are `density` times denser than needed in small motion.

    `answer` tells where the switches are and when contact ended; the scene is then simulated at
    the same tolerance once more, sampled on the panels.
    """
    chain, drive, time = scene
    stop = answer.contact_end if answer.contact_end is not None else float(time[-1])
    ring, fade = _rates(chain, drive)
    start = 0.2 / fade if fade > 0.0 else stop
    edges = {0.0: start, stop: stop}
    if isinstance(drive, ff.Impact):
        at, near = _peak(scene, stop, rtol, _own(answer))
        edges[at] = near
    elif time.size > 500:
        return None
    else:
        edges.update((float(t), max(start, 1e-6 * stop)) for t in time)
    switches = answer.switches[:, 0]
    rounds = 1
    if answer.steps == 0:  # in closed form a switch lies before the sample that is named: close in
        rounds, switches = 6, np.empty(0)
    edges.update((float(t), max(start, 1e-6 * stop)) for t in switches if 0.0 < t < stop)
    for turn in range(rounds):
        places = np.array(sorted(edges))
        apart = np.concatenate(([True], np.diff(places) > 1e-12 * stop))
        apart[-1] = True
        places = places[apart]
        if places.size < 2:
            return None
        least = np.array([edges[t] for t in places]) / density
        ends = panels(places, least, ring * density, density)
        most = (MOST_NUMBERS if isinstance(drive, ff.Impact) else MOST_DRIVEN) * density
        if ends is None or len(chain.springs) * ends.size * (POINTS + 1) > most:
            return None
        inner = ends[:-1, None] + np.diff(ends)[:, None] * NODES[None, :-1]
        grid = np.append(inner.ravel(), ends[-1])
        if isinstance(drive, ff.Impact):
            grid[-1] *= 1.0 - 1e-15
        if np.any(np.diff(grid) <= 0.0):
            return None
        finer = _finer(scene, grid)
        motion = bare(finer, rtol, _own(answer))
        if density > 1.0 and isinstance(drive, ff.Impact):
            ends, finer, motion = _resolved(scene, rtol, _own(answer), ends, finer, motion)
        if turn + 1 < rounds:
            index = np.searchsorted(grid, motion.switches[:, 0])
            for j in index[(index > 0) & (index < grid.size)]:
                edges[float(grid[j - 1])] = edges[float(grid[j])] = stop
    return motion_balance(finer[0], finer[1], ends, motion)


def _resolved(
    scene: Scene, rtol: float, implicit: bool | None, ends: Array, finer: Scene, motion: Motion
) -> tuple[Array, Scene, Motion]:
    """Split the panels in which a motion changes too fast for a polynomial, until none is left.

    Masses that meet the end of a branch turn round within 1e-5 of the time of the scene.
    """
    heights = np.array(scene[0].heights)
    for _ in range(12):
        strain = np.diff(motion.displacement, axis=0, prepend=0.0) / heights[:, None]
        curves = [
            motion.displacement,
            [s.stress(eps) for s, eps in zip(scene[0].springs, strain, strict=True)],
        ]
        coarse = np.zeros(ends.size - 1, bool)
        length = np.diff(ends)
        for values, power in zip(curves, (0, 1), strict=True):
            shaped = _shaped(np.asarray(values), length.size)
            tail = np.abs(shaped @ TAIL.T).max(axis=-1) * (length if power else 1.0)
            spread = np.ptp(shaped, axis=-1) * (length if power else 1.0)
            coarse |= (tail > 1e-8 * spread.sum(axis=-1, keepdims=True)).any(axis=0)
        if not coarse.any():
            break
        split = np.linspace(ends[:-1][coarse], ends[1:][coarse], 5)[1:-1]
        places = np.sort(np.concatenate((ends, split.ravel())))
        inner = places[:-1, None] + np.diff(places)[:, None] * NODES[None, :-1]
        grid = np.append(inner.ravel(), finer[2][-1])
        if places.size > 10 * MOST_PANELS or np.any(np.diff(grid) <= 0.0):
            break
        ends, finer = places, _finer(scene, grid)
        motion = bare(finer, rtol, implicit)
    return ends, finer, motion


def _shaped(values: Array, count: int) -> Array:
    """View samples (…, panels × 9 + 1) as (…, panels, 10), both ends included."""
    index = np.arange(count)[:, None] * (POINTS + 1) + np.arange(POINTS + 2)[None, :]
    return values[..., index]


def motion_balance(
    chain: ff.Chain,
    drive: ff.Impact | ff.StressDrive | ff.DisplacementDrive,
    ends: Array,
    response: Motion,
) -> Balance:
    heights, n = np.array(chain.heights), ends.size - 1
    length = np.diff(ends)
    nodes = response.displacement
    strain = np.diff(nodes, axis=0, prepend=0.0) / heights[:, None]
    work, heat, size = np.zeros(n), np.zeros(n), 0.0
    for i, spring in enumerate(chain.springs):
        taken = heights[i] * work_of(spring, strain[i])
        work += taken[POINTS + 1 :: POINTS + 1]
        size = max(size, float(np.abs(taken).max()))
        if spring.eta > 0.0:
            rate = _shaped(strain[i], n) @ SLOPES.T / length[:, None]
            heat += spring.eta * heights[i] * np.cumsum(length * (rate[:, 1:-1] ** 2 @ GAUSS))
    top = chain.springs[-1]
    held = _shaped(top.stress(strain[-1]), n)
    carried = np.cumsum(length * (held[:, 1:-1] @ GAUSS))  # ∫ Σ_N dt
    stretched = strain[-1, POINTS + 1 :: POINTS + 1] - strain[-1, 0]
    carried = carried + top.eta * stretched
    base = _shaped(response.base_stress, n)[:, 1:-1]
    felt = np.cumsum(length * (base @ GAUSS))  # ∫ Σ_1 dt
    low = chain.springs[0]
    law = np.cumsum(length * (_shaped(low.stress(strain[0]), n)[:, 1:-1] @ GAUSS))
    law = law + low.eta * (strain[0, POINTS + 1 :: POINTS + 1] - strain[0, 0])
    impulse_scale = float(np.cumsum(length * (np.abs(base) @ GAUSS))[-1]) or 1.0
    impulse = float(np.abs(felt - law).max()) / impulse_scale
    w_top = nodes[-1, POINTS + 1 :: POINTS + 1]
    drag = chain.site_damping / chain.height
    masses = np.array(chain.masses) / chain.area
    kinetic = np.zeros(n)
    for i in range(len(heights) - 1):
        if masses[i] > 0.0:
            last = _shaped(nodes[i], n) @ SLOPES[-1] / length
            kinetic += 0.5 * masses[i] * last**2
    if not np.any(masses[:-1] > 0.0):
        impulse = max(impulse, float(np.abs(felt - carried).max()) / impulse_scale)
    top_rate = _shaped(nodes[-1], n) @ SLOPES.T / length[:, None]
    if isinstance(drive, ff.DisplacementDrive):
        brought = np.zeros(n)
        rate = np.diff(np.concatenate(([nodes[-1, 0]], w_top))) / length
        pulled = felt if not np.any(masses[:-1] > 0.0) else carried
        brought = np.cumsum(rate * np.diff(np.concatenate(([0.0], pulled))))
    else:
        heat = heat + drag * np.cumsum(length * (top_rate[:, 1:-1] ** 2 @ GAUSS))
        if isinstance(drive, ff.Impact):
            mass = masses[-1] + drive.mass / chain.area
            brought = np.full(n, 0.5 * mass * drive.velocity**2)
            speed = drive.velocity - (carried + drag * w_top) / mass
        else:
            mass = masses[-1]
            stress = _shaped(drive.stress, n)
            slope = (stress[:, -1] - stress[:, 0]) / length
            inside = _shaped(nodes[-1], n)[:, 1:-1]
            parts = stress[:, -1] * w_top - stress[:, 0] * np.concatenate(
                ([nodes[-1, 0]], w_top[:-1])
            )
            brought = np.cumsum(parts - slope * length * (inside @ GAUSS))
            speed = top_rate[:, -1]
        if mass > 0.0:
            kinetic += 0.5 * mass * speed**2
    scale = max(float(np.abs(brought).max()), size, float(heat[-1]))
    return Balance(float(np.abs(brought - kinetic - work - heat).max()) / scale, impulse)


# ---------------------------------------------------------------------------------------- vibration


def ripple_of(scene: Scene, answer: ff.Response | Motion, rtol: float) -> float | None:
    """Ripple of the base stress that a blow starts and that an answer had too few steps to show.

    Closed form: the chain on its first branches at rest, where it is linear, as modes; the blow is
    the velocity of the striker. A mode that goes through more radians than six a step of the
    answer before it has died out to `rtol` cannot be in the answer. The ripple of all such modes at
    the first sample, over the range of the base stress; None where this is not known in advance
    (other drives, massless nodes, long chains).
    """
    chain, drive, time = scene
    masses = np.array(chain.masses) / chain.area
    if not isinstance(drive, ff.Impact) or not 1 < len(masses) <= 300 or np.any(masses[:-1] <= 0):
        return None
    if not answer.steps or time.size < 2:
        return None
    masses[-1] += drive.mass / chain.area
    heights = np.array(chain.heights)

    def matrix(per_strain: Array) -> Array:
        k = per_strain / heights
        full = np.diag(k + np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
        return full / np.sqrt(np.outer(masses, masses))

    stiff = np.array([s.k0 for s in chain.springs])
    squares, modes = np.linalg.eigh(matrix(stiff))
    drag = np.array([s.eta for s in chain.springs])
    damp = matrix(drag)
    damp[-1, -1] += chain.site_damping / chain.height / masses[-1]
    decay = 0.5 * np.einsum("ij,ik,kj->j", modes, damp, modes)
    ring = np.sqrt(np.maximum(squares, 0.0))
    push = modes[-1] * math.sqrt(masses[-1]) * drive.velocity  # of each mode, at the blow
    fast = (decay < ring) & (ring > 0.0)
    size = np.zeros_like(ring)
    first = stiff[0] / heights[0] * modes[0] / math.sqrt(masses[0])
    size[fast] = np.abs(first * push)[fast] / ring[fast]
    size *= np.exp(-decay * time[time > 0.0][0]) / max(float(np.ptp(answer.base_stress)), 1e-300)
    stop = answer.contact_end if answer.contact_end is not None else float(time[-1])
    lasting = np.full(ring.size, stop)
    dies = size > rtol
    lasting[dies] = np.minimum(stop, np.log(size[dies] / rtol) / np.maximum(decay[dies], 1e-99))
    return float(size[fast & (size > 0.0) & (ring * lasting > 6.0 * answer.steps)].sum())


# --------------------------------------------------------------------------------------- refinement


def difference(one: ff.Response | Motion, other: ff.Response | Motion) -> float:
    """Largest difference of displacement, or of base stress, over the range of each."""
    worst = 0.0
    for a, b in ((one.displacement, other.displacement), (one.base_stress, other.base_stress)):
        span = float(np.ptp(np.append(b, 0.0)))
        miss = float(np.abs(a - b).max())
        if miss > 0.0:
            worst = max(worst, miss / span if span > 0.0 else math.inf)
    return worst


def explicit_fits(scene: Scene) -> bool:
    """Tell whether explicit steps are a judge: not where they lose digits, or hardly ever end."""
    chain, drive, time = scene
    made = plan(chain, drive, time)
    rows = np.array([spring.row for spring in chain.springs])
    return max(made.fastest_rates(rows, np.array(chain.heights))) < MOST_RADIANS


def refined(
    scene: Scene, answer: ff.Response, rtol: float, *, implicit: bool, most: int
) -> float | None:
    """Difference of an answer from runs with ever smaller steps, until one agrees.

    None where the method (`implicit` or not) does not fit the scene: it gives up, within `most`
    steps times springs, says that it has damped out more than the tolerance, or does not agree with
    itself.
    """
    least, last = math.inf, None
    agrees = False
    for finer in (1e-2 * rtol, 1e-4 * rtol, 1e-6 * rtol):
        try:
            motion = bare(scene, finer, implicit, most)
        except ff.SimulationError:
            break
        if motion.unresolved > rtol:
            continue
        least = min(least, difference(answer, motion))
        agrees = last is not None and difference(motion, last) <= 0.1 * rtol
        last = motion
        if least <= rtol:
            return least
    return least if agrees else None
