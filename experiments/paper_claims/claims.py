"""The numbers behind the claims of the paper, from the published parameters.

Thevamaran, Fraternali & Daraio 2014, Tables 1-3. A stress drive is the base stress of a simulated
impact, so the exact response is known.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

import foamfit as ff
from foamfit.springs import laws

Array = NDArray[np.float64]

MODEL_1, MODEL_2, MODEL_3, FOAM_2 = "foam-1/model-1", "foam-1/model-2", "foam-1/model-3", "foam-2"
SETS = (MODEL_2, MODEL_3, FOAM_2)  # those with a damper
STRIKER, OWN_MASS = 7e-3, ff.published[MODEL_1].specimen_mass  # kg
ETA = 1e4  # Pa·s, published for model-2 and foam-2

DRIVE_VELOCITY = 2.0  # m/s, just fast enough to close the loop of foam-1
OTHER_VELOCITIES = (1.75, 1.9, 2.0, 2.1, 2.3, 2.5)  # m/s, to show the influence of the drive
SAMPLES = 4001  # of a drive, over the contact
RTOL = 1e-9
TURN = 1e-3  # of the range; smaller turns of a curve are not counted


@dataclass(frozen=True)
class Drive:
    """A simulated base-stress history and the corresponding motion, SI."""

    spring: ff.BistableSpring
    height: float
    area: float
    time: Array
    stress: Array
    displacement: Array


def drive_of_impact(
    name: str = MODEL_2, velocity: float = DRIVE_VELOCITY, samples: int = SAMPLES
) -> Drive:
    """Return base stress and motion of an undamped one-spring model hit by a 7 g striker."""
    chain, spring = impact_scene(name, interior=False), ff.published[name].bistable
    time = np.linspace(0.0, struck(chain, velocity).contact_end or 0.0, samples)
    got = ff.simulate(chain, ff.Impact(STRIKER, velocity), time, rtol=RTOL)
    stress = np.maximum(got.base_stress, 0.0)
    return Drive(spring, chain.height, chain.area, time, stress, got.displacement[-1])


def driven(drive: Drive, mass: float, damper: float, rtol: float = RTOL) -> ff.Response:
    """Simulate the drive's spring under its stress, with a mass (kg) and onsite damper (Pa·s)."""
    chain = ff.Chain([drive.spring], [drive.height], drive.area, [mass], site_damping=damper)
    return ff.simulate(chain, ff.StressDrive(drive.stress), drive.time, rtol=rtol)


def rms(difference: Array, reference: Array) -> float:
    """Return the RMS of a difference over the contact, in % of the peak of the reference."""
    return float(100.0 * np.sqrt(np.mean(difference**2)) / np.max(reference))


def displacement_error(drive: Drive, mass: float, damper: float) -> float:
    """Return the RMS error of the displacement, % of its peak."""
    got = driven(drive, mass, damper)
    return rms(got.displacement[-1] - drive.displacement, drive.displacement)


def extra_turns(curve: Array, reference: Array) -> int:
    """Count the maxima and minima, larger than a share of the range, that the reference lacks."""

    def turns(x: Array) -> int:
        least = TURN * float(np.ptp(reference))
        return sum(find_peaks(sign * x, prominence=least)[0].size for sign in (1.0, -1.0))

    return turns(curve) - turns(reference)


def oscillation(drive: Drive, mass: float, damper: float) -> dict[str, float]:
    """Return the deviation from equilibrium, split into vibration and lag, in % of the peak.

    Vibration is the difference between the responses with and without mass, with the same damper;
    lag is the error of the massless response due to the damper.
    """
    got, massless = driven(drive, mass, damper), driven(drive, 0.0, damper)
    w, stress, stress_0 = got.displacement[-1], got.base_stress, massless.base_stress
    return {
        "damper": damper, "stress": rms(stress - drive.stress, drive.stress),
        "largest": float(100 * np.max(abs(stress - drive.stress)) / np.max(drive.stress)),
        "displacement": rms(w - drive.displacement, drive.displacement),
        "vibration": rms(stress - stress_0, drive.stress),
        "lag": rms(stress_0 - drive.stress, drive.stress),
        "turns": extra_turns(stress, drive.stress), "turns_w": extra_turns(w, drive.displacement),
    }  # fmt: skip


def damper_needed(drive: Drive) -> float:
    """Return the least onsite damper (Pa·s) that removes extra turns of stress and motion."""

    def calm(log_damper: float) -> bool:
        got = oscillation(drive, OWN_MASS, math.exp(log_damper))
        return not (got["turns"] or got["turns_w"])

    return math.exp(least(calm, math.log(0.1), math.log(1000.0), math.log(1.01)))


def least(enough: Callable[[float], bool], low: float, high: float, close: float) -> float:
    """Return the least value, to within `close`, that is enough: not `low`, but `high`."""
    while high - low > close:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def free_period(drive: Drive, mass: float, slope: float) -> float:
    """Return the period (s) of free vibration of a mass on the spring at a slope dσ/dε (Pa)."""
    return 2.0 * math.pi * math.sqrt(mass * drive.height / (drive.area * slope))


def slowed(drive: Drive, damper: float, slower: float) -> float:
    """Return the displacement error (%) of 7 g and a damper for a drive slowed by a factor.

    By scaling of time, a drive slowed by a factor s on a mass m with a damper η is equivalent to
    the original drive on m/s² with η/s.
    """
    return displacement_error(drive, STRIKER / slower**2, damper / slower)


def ratio_readings(name: str, eta: float | None = None) -> dict[str, float]:
    """Return ζ = η/(2 H √(ρ k)), ρ = m/(A H), of a published set by each reading."""
    item = ff.published[name]
    s, chain, own, eta = item.bistable, item.chain, item.specimen_mass, eta or item.eta or 0.0
    whole = chain.height
    other = ff.published[MODEL_1 if name == FOAM_2 else FOAM_2].chain.height

    def ratio(k: float = s.kc, mass: float = STRIKER, height: float = whole) -> float:
        return eta / (2.0 * height * math.sqrt(mass / (chain.area * height) * k))

    return {
        "the formula: k_c, H, ρ of the striker": ratio(),
        "striker and foam together in ρ": ratio(mass=STRIKER + own),
        "ρ = bulk density of the foam": ratio(mass=own),
        "k₀ for k_c": ratio(s.k0),
        "k_h+ for k_c": ratio(s.kh_plus),
        "k_h− (branch e) for k_c": ratio(s.kh_minus),
        "tangent of branch c at C2 for k_c": ratio((s.kc + s.sigma_c) ** 2 / s.kc),
        "tangent of branch c at C1 for k_c": ratio((s.kc + s.sigma_hat_c) ** 2 / s.kc),
        "secant of branch c, C2 to C1, for k_c":
            ratio((s.sigma_hat_c - s.sigma_c) / (s.eps_hat_c - s.eps_c)),
        "secant from zero to C1 for k_c": ratio(s.sigma_hat_c / s.eps_hat_c),
        "secant of branch c from ε_* to C1": ratio(s.sigma_hat_c / (s.eps_hat_c - s.eps_star)),
        "k_c − k₀ for k_c": ratio(s.kc - s.k0),
        "k_c − k_h+ for k_c": ratio(s.kc - s.kh_plus),
        "height of the bistable spring for H": ratio(height=chain.heights[-1]),
        "height at C2, H(1 − ε_c)": ratio(height=whole * (1 - s.eps_c)),
        "height at A1, H(1 − ε_a)": ratio(height=whole * (1 - s.eps_a)),
        "height of the other specimen": ratio(height=other),
        "other specimen's height in 2h only": ratio() * whole / other,
        "other specimen's height in ρ only": ratio() * math.sqrt(other / whole),
    }  # fmt: skip


def viscosity_wanted() -> float:
    """Return the viscosity (Pa·s) that would give the paper's ratio of model-2; ζ ~ η."""
    item = ff.published[MODEL_2]
    by_formula, printed = item.damping_ratio_by_formula(), item.damping_ratio
    assert by_formula is not None
    assert printed is not None
    return ETA * printed / by_formula


def impact_scene(name: str, interior: bool = True) -> ff.Chain:
    """Return the chain of a published set without its numerical damper."""
    chain = ff.published[name].chain
    return ff.Chain(chain.springs, chain.heights, chain.area, chain.masses if interior else None)


def struck(chain: ff.Chain, velocity: float, samples: int = 101) -> ff.Response:
    """Simulate an impact of the 7 g striker until after the end of contact."""
    time = np.linspace(0.0, 4.0 * chain.height / velocity, samples)
    got = ff.simulate(chain, ff.Impact(STRIKER, velocity), time, rtol=RTOL)
    assert got.contact_end is not None
    assert got.contact_end < time[-2]
    return got


def spring_strain(chain: ff.Chain, got: ff.Response) -> Array:
    """Return the strain of the uppermost, bistable spring, (n_t,)."""
    below = got.displacement[-2] if len(chain.heights) > 1 else 0.0
    return (got.displacement[-1] - below) / chain.heights[-1]


def closing_velocity(name: str, interior: bool = True) -> float:
    """Return the least velocity (m/s) at which the impact reaches branch c."""
    chain, c = impact_scene(name, interior), [*laws.law("bistable").branches].index("c")
    return least(lambda v: bool(np.any(struck(chain, v).switches[:, 3] == c)), 1.0, 8.0, 1e-6)


def work_to_c1(name: str) -> float:
    """Return the work per cross-section (J/m²) to load massless springs to C1, closed form."""
    item, total = ff.published[name], 0.0
    top = item.bistable.sigma_hat_c
    for s, h in zip(item.chain.springs, item.chain.heights, strict=True):
        if isinstance(s, ff.LinearSpring):
            total += h * top**2 / (2.0 * s.k0)
        else:
            on_a = s.k0 * (-math.log1p(-s.eps_a) - s.eps_a)
            total += h * (on_a + 0.5 * (s.sigma_a + top) * (s.eps_hat_c - s.eps_a))
    return total


def closing_velocity_by_energy(name: str) -> float:
    """Return the velocity (m/s) whose kinetic energy is the work to C1."""
    return math.sqrt(2.0 * ff.published[name].chain.area * work_to_c1(name) / STRIKER)


def loop_area(name: str) -> float:
    """Return the area (J/m²) of the smallest closed loop, to C1 and back to σ = 0."""
    item = ff.published[name]
    top = item.bistable.eps_hat_c
    strain = np.concatenate([np.linspace(0, top, 20001), np.linspace(top * (1 + 1e-12), 0, 20001)])
    stress = np.maximum(item.bistable.stress(strain), 0.0)
    return float(item.chain.heights[-1] * np.trapezoid(stress, strain))


def rebound(got: ff.Response) -> float:
    """Return the velocity (m/s) of the striker after contact."""
    return -float(np.diff(got.displacement[-1])[-1] / np.diff(got.time)[-1])


def energy_row(name: str, interior: bool = True) -> dict[str, float]:
    """Compare the simulated published impact of one set with its loop; SI."""
    item, chain = ff.published[name], impact_scene(name, interior)
    velocity, needed = item.striker_velocity, closing_velocity(name, interior)
    got = struck(chain, velocity, 4001)
    return {
        "velocity": velocity, "strain": float(np.max(spring_strain(chain, got))),
        "c1": item.bistable.eps_hat_c, "peak": float(np.max(got.base_stress)),
        "rebound": rebound(got), "needed": needed,
        "needed_energy": closing_velocity_by_energy(name),
        "excess": 100.0 * ((needed / velocity) ** 2 - 1.0),
    }  # fmt: skip


def lost_share(chain: ff.Chain, velocity: float) -> float:
    """Return the share (%) of the striker's energy that is lost."""
    return 100.0 * (1.0 - (rebound(struck(chain, velocity)) / velocity) ** 2)
