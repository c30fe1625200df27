"""Synthetic records like those of a test rig, with their true parameters.

`impact` and `slow` draw springs and a test and return a `Record`; `write` writes it to a CSV and
its TOML. Nothing here or in `truth`, which integrates the springs, comes from foamfit.

An impact is recorded by an oscilloscope from before to after contact. Each channel has an arbitrary
zero, the clock starts at an arbitrary time, and contact lies between two samples. A slow test
follows a given motion, recorded with noise, until the stress returns to zero. For one law, a seed
always draws the same springs, striker and noise of a channel, whatever else is recorded.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.integrate import quad
from scipy.signal import lfilter
from scipy.special import ndtri

from truth import Array, Bistable, Course, Law, Microscale, Motion, Rig, Terms

GRAVITY = 9.80665
DURATION = 4.0  # s, of a slow motion
LEAST, LEFT = 0.02, 0.3  # between cycles: stress and displacement over the largest
MOST_STRAIN = 0.93
UNITS = {
    "force": ("N", 1.0), "displacement": ("mm", 1e3), "acceleration": ("m/s^2", 1.0),
    "velocity": ("m/s", 1.0),
}  # fmt: skip
# Height (m), cross-section (m²) and striker (kg): the paper's rig, and a drop tower.
BENCH, TOWER = (1.2e-3, 1.9635e-5, 7e-3), (20e-3, 1e-3, 5.0)
SLOW_HEIGHT, SLOW_AREA = 10e-3, 0.25 * math.pi * 7.6e-3**2


@dataclass(frozen=True)
class Impact:
    """Settings of a synthetic impact and its record.

    With `zero` the zero of the motion is arbitrary, with `sensor` the zeros of force and
    acceleration. `noise` is relative to each channel's range during contact, with autocorrelation
    time `tau` in samples. `before` is the fraction of the record before contact (None: drawn up to
    0.6), `samples` the number during contact (None: 150 to 3000, within 20 kHz to 2 MHz). A
    `trimmed` record starts at contact, at time zero, with correct zeros. A `gauge` on the specimen
    rests until contact. `gravity` acts on the striker before, during and after contact; if `said`,
    the TOML states it. `velocity_sd` is the relative standard deviation of the velocity in the
    TOML, which has a random error of this size. With `delay_sd` the motion is in a file of its own,
    and late by a random delay with this standard deviation, in durations of the contact, which the
    TOML gives.
    """

    law: str = "bistable"
    relaxation: int = 0
    channels: tuple[str, ...] = ("force", "displacement")
    samples: int | None = None
    noise: float = 0.01
    tau: float = 1.0
    before: float | None = None
    zero: bool = True
    sensor: bool = True
    trimmed: bool = False
    gauge: bool = False
    gravity: bool = False
    velocity_sd: float = 0.0
    delay_sd: float = 0.0
    said: bool = True


@dataclass(frozen=True)
class Slow:
    """Settings of a synthetic slow test and its record.

    `law` is "bistable", "microscale" or bistable springs joined by "+", all of the same height.
    With `dashpot` a single spring has an eta. `motion` is "triangle", "sine", "trapezoid" (a short
    hold) or "ramp" (a slow start). `inner` is the size of a partial unloading relative to the peak.
    Under several `cycles` a microscale spring remembers what has snapped.
    `noise` is relative to the range of displacement and of force; `noise_given` writes it to the
    TOML, and with `exact` the displacement has no noise. With `early` the motion starts before
    contact; with `zero` its zero is arbitrary.
    """

    law: str = "microscale"
    relaxation: int = 0
    dashpot: bool = False
    motion: str = "triangle"
    inner: float = 0.0
    cycles: int = 1
    rows: int = 1000
    noise: float = 0.003
    early: bool = False
    zero: bool = False
    noise_given: bool = False
    exact: bool = False


@dataclass(frozen=True)
class Record:
    """A record in SI, compression positive: `time` of the file, noisy channels.

    `truth` contains the true parameters by foamfit's names, and contact_time (s) and
    displacement_zero (m), the values of the file's time and displacement at contact; for an impact
    also velocity and striker_mass.
    """

    setup: Impact | Slow
    time: Array
    channels: dict[str, Array]
    noise: dict[str, float]
    truth: dict[str, float]
    rig: Rig
    course: Course
    toml_velocity: str = ""
    delay_sd: float = 0.0  # s


def draw_bistable(rng: np.random.Generator) -> Bistable:
    """Draw a bistable spring from a range that includes those of the paper."""
    k0, eps_a = 10 ** rng.uniform(6.0, 7.5), rng.uniform(0.05, 0.35)
    eps_c, drop = eps_a + rng.uniform(0.1, 0.45), rng.uniform(0.05, 0.8)
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    return Bistable(
        k0=k0, kc=k0 * 10 ** rng.uniform(0.7, 1.7), dsigma=-drop * sigma_a, eps_a=eps_a,
        eps_c=eps_c, kh_plus=k0 * rng.uniform(0.1, 3.0),
        kh_minus=sigma_a * (1.0 - drop) / eps_c * rng.uniform(0.5, 1.1),
    )  # fmt: skip


def draw_microscale(rng: np.random.Generator) -> tuple[Microscale, float]:
    """Draw a microscale spring and the stress that snaps 70 to 98 % of it."""
    while True:
        k0 = 10 ** rng.uniform(5.0, 7.0)
        kc = k0 * 10 ** rng.uniform(-0.5, 1.0)
        least = max(0.0, (math.sqrt(kc) - math.sqrt(k0)) / (math.sqrt(kc) + math.sqrt(k0)))
        plus, spread = k0 * rng.uniform(0.1, 0.5), rng.uniform(0.15, 0.6)
        spring = Microscale(
            k0=k0, kc=kc, eps_star=least + rng.uniform(0.02, 0.3), sigma_plus=plus,
            spread_plus=spread, sigma_minus=plus * rng.uniform(0.3, 0.8),
            spread_minus=rng.uniform(0.3, 0.9),
        )  # fmt: skip
        most = plus * math.exp(spread * float(ndtri(rng.uniform(0.7, 0.98))))
        if spring.strain(most) < 0.85:
            return spring, most


def draw_worn(rng: np.random.Generator) -> tuple[Microscale, float]:
    """Draw a microscale spring that remembers what has snapped; see `draw_microscale`."""
    while True:
        spring, most = draw_microscale(rng)
        n, softening = 10.0 ** rng.uniform(0.0, 1.2), rng.uniform(0.3, 1.0)
        ratio = np.geomspace(1e-4, 1e4, 2001)  # of stress and softened stiffness
        stress = ratio * spring.k0 * math.exp(-softening)
        on_a, on_c = 1.0 - (1.0 + n * ratio) ** (-1.0 / n), stress / (spring.kc + stress)
        least = max(float((on_a - on_c).max()), 0.0)
        spring = replace(
            spring, eps_star=least + rng.uniform(0.02, 0.2), stiffening=n, softening=softening,
            weakening=rng.uniform(0.1, 0.5),
        )  # fmt: skip
        if spring.strain(most) < 0.82:
            return spring, most


def draw_terms(rng: np.random.Generator, count: int, lasts: float) -> Terms:
    """Draw relaxation terms for a test of duration `lasts` (s), fastest first."""
    decades = [(-2.0, -0.5)] if count == 1 else [(-2.2, -1.5), (-1.0, -0.3)]
    return tuple(
        (rng.uniform(0.1, 1.0), lasts * 10 ** rng.uniform(*decade)) for decade in decades[:count]
    )


def work(spring: Law, most: float) -> float:
    """Return the work per volume of a first loading to a stress, J/m³."""
    cuts = [spring.onset, spring.closing] if isinstance(spring, Bistable) else []
    ends = [0.0, *(s for s in cuts if s < most), most]
    beside = [quad(spring.strain, low, high, limit=200)[0] for low, high in pairwise(ends)]
    return most * spring.strain(most) - math.fsum(beside)


def parameters(springs: tuple[Law, ...]) -> dict[str, float]:
    """Return the parameters of springs by foamfit's names."""
    named: dict[str, float] = {}
    for i, spring in enumerate(springs, start=1):
        own = asdict(spring) | {"relaxation": None}
        named |= {f"s{i}_{name}": float(v) for name, v in own.items() if v is not None}
        for k, (g, tau) in enumerate(spring.relaxation, start=1):
            named |= {f"s{i}_g{k}": g, f"s{i}_tau{k}": tau}
    return named


def noisy(
    clean: dict[str, Array], ranges: dict[str, float], share: float, tau: float, seed: int
) -> tuple[dict[str, Array], dict[str, float]]:
    """Add independent noise to each channel; return its standard deviations too."""
    rho, sizes, out = (tau - 1.0) / (tau + 1.0), {name: share * ranges[name] for name in clean}, {}
    for name, values in clean.items():
        rng = np.random.default_rng([seed, 3, list(UNITS).index(name)])
        white = rng.standard_normal(len(values) + 500)
        unit = lfilter([math.sqrt(1.0 - rho * rho)], [1.0, -rho], white)[500:]
        out[name] = values + sizes[name] * unit
    return out, sizes


def drawn_impact(setup: Impact, rng: np.random.Generator) -> Course:
    """Draw a spring and a striker that closes the loop without flattening it; simulate."""
    while True:
        height, area, mass = BENCH if rng.random() < 0.5 else TOWER
        if setup.law == "bistable":
            spring: Law = draw_bistable(rng)
            most, more = spring.closing, rng.uniform(1.3, 2.0)
        else:
            spring, most = draw_microscale(rng)
            more = 1.0 + 0.3 * setup.relaxation
        velocity = math.sqrt(2.0 * more * work(spring, most) * area * height / mass)
        eta = 10 ** rng.uniform(-2.5, -1.0) * most * height / velocity
        if setup.law == "bistable" and rng.random() < 0.5:
            spring = replace(spring, eta=eta)
        terms = draw_terms(rng, setup.relaxation, 1.2 * height / velocity)
        spring = replace(spring, relaxation=terms)
        gravity = GRAVITY if setup.gravity else 0.0
        rig = Rig((spring,), (height,), area, mass, velocity, gravity)
        course = rig.run(0.0, 100.0 * height / velocity)
        reached = course.top(np.linspace(0.0, course.end, 200), gauge=False).max()
        if reached < MOST_STRAIN * height and course.end < 90.0 * height / velocity:
            return course


def impact(setup: Impact, seed: int) -> Record:
    """Return the record of an impact."""
    return recorded(setup, drawn_impact(setup, np.random.default_rng([seed, 1])), seed)


def recorded(
    setup: Impact, course: Course, seed: int, ranges: dict[str, float] | None = None,
    step: float | None = None,
) -> Record:  # fmt: skip
    """Return the record of the course of an impact.

    The noise is relative to `ranges` (SI, by default those of this test); `step` is the sampling
    interval (s).
    """
    rng = np.random.default_rng([seed, 2])
    rig, lasts = course.rig, course.end
    drawn = 10 ** rng.uniform(math.log10(150), math.log10(3000))
    # 20 kHz to 2 MHz
    samples = setup.samples or round(max(150.0, min(max(drawn, 20e3 * lasts), 2e6 * lasts)))
    step = float(f"{lasts / samples:.3g}") if step is None else step
    samples = round(lasts / step)
    part, after, late = rng.uniform(0.0, 0.6), rng.uniform(0.05, 0.25), rng.uniform(0.05, 0.95)
    origin = rng.uniform(-lasts, 0.0) if rng.random() < 0.5 else rng.uniform(0.0, 20.0)
    zeros = rng.uniform((-3.0, -0.05, -0.05), (3.0, 0.05, 0.05)).tolist()
    off = rng.standard_normal()
    part = part if setup.before is None else setup.before
    first = round(part / (1.0 - part) * (1.0 + after) * samples)
    if setup.trimmed:
        first, late, origin = 0, 0.0, 0.0
    origin = round(origin / step) * step
    own = (np.arange(first + math.ceil((1.0 + after) * samples)) - first + late) * step
    spread = float(f"{setup.delay_sd * lasts:.3g}")
    delay = spread * np.random.default_rng([seed, 4]).standard_normal()
    motion, stress = course.top(own - delay, setup.gauge), course.stress(own)
    sides = [course.top(own + side * 1e-3 * step, setup.gauge) for side in (-1.0, 1.0)]
    everything = {
        "force": stress * rig.area,
        "displacement": motion,
        "acceleration": stress * rig.area / rig.mass,  # an accelerometer falling freely reads zero
        "velocity": (sides[1] - sides[0]) / (2e-3 * step),
    }
    inside = (own >= 0.0) & (own <= lasts)
    clean = {name: everything[name] for name in setup.channels}
    ranges = ranges or {name: float(np.ptp(values[inside])) for name, values in clean.items()}
    zero = round(zeros[0] * rig.height, 7) if setup.zero and not setup.trimmed else 0.0
    shifts = {"displacement": zero}
    if setup.sensor and not setup.trimmed:
        sensors = zip(("force", "acceleration"), zeros[1:], strict=True)
        shifts |= {name: share * ranges.get(name, 0.0) for name, share in sensors}
    clean = {name: values + shifts.get(name, 0.0) for name, values in clean.items()}
    channels, sizes = noisy(clean, ranges, setup.noise, setup.tau, seed)
    sd = setup.velocity_sd
    said = f"{rig.velocity * (1.0 + sd * off):.12g}" + (f" ± {sd * rig.velocity:.3g}" if sd else "")
    truth = parameters(rig.springs) | {
        "contact_time": origin + (first - late) * step, "velocity": rig.velocity,
        "striker_mass": rig.mass, "time_shift": delay,
    }  # fmt: skip
    if "displacement" in clean:
        truth["displacement_zero"] = zero
    time = origin + np.arange(len(own)) * step
    return Record(setup, time, channels, sizes, truth, rig, course, f"{said} m/s", spread)


def slow_motion(setup: Slow, peak: float, rng: np.random.Generator) -> Motion:
    """Draw a motion to a displacement and back, with the parameters of its shape."""
    gap = peak * rng.uniform(0.02, 0.1) if setup.early else 0.0
    at, unloading = rng.uniform(0.4, 0.8), rng.random() < 0.5
    up, down = [-gap, peak], [peak, 0.0]
    if setup.inner:
        low = (at - setup.inner) * peak
        if unloading:
            low = max(low, 0.35 * peak)
            down[1:1] = [low, low + setup.inner * peak]
        else:
            up[1:1] = [at * peak, low]
    levels = [*up, *([peak] if setup.motion == "trapezoid" else []), *down[1:]]
    ways = np.abs(np.diff(levels))
    ways[ways == 0.0] = 0.05 * ways.sum()
    rest = "cosine" if setup.motion == "sine" else "line"
    shapes = ("ramp" if setup.motion == "ramp" else rest, *[rest] * (len(ways) - 1))
    times = np.append(0.0, np.cumsum(ways)) * DURATION / ways.sum()
    return Motion(tuple(times.tolist()), tuple(levels), shapes)


def cycled(rig: Rig, cycles: int) -> Motion:
    """Repeat the loading of a motion, each time 2 % deeper, without losing contact in between."""
    assert rig.motion is not None
    first, peak = rig.motion.levels[:2]
    times, levels, speed = [0.0], [first], 2.0 * peak / DURATION
    for cycle in range(cycles):
        for level in (peak * (1.0 + 0.02 * cycle), 0.0):
            times.append(times[-1] + abs(level - levels[-1]) / speed)
            levels.append(level)
        motion = Motion(tuple(times), tuple(levels), ("line",) * (2 * cycle + 2))
        when, stress = replace(rig, motion=motion).pressed(motion.contact(), times[-1])
        end = when[(when > times[-2]) & (stress < LEAST * stress.max())][:1]
        times[-1], levels[-1] = float(end[0]), float(motion.at(end)[0])
    return Motion(tuple(times), tuple(levels), motion.shapes)


def drawn_slow(setup: Slow, rng: np.random.Generator) -> Course:
    """Draw springs and a motion that closes their loops; simulate."""
    kinds = setup.law.split("+")
    while True:
        if kinds[0] == "microscale":
            spring, most = draw_microscale(rng) if setup.cycles == 1 else draw_worn(rng)
            springs: list[Law] = [spring]
        else:
            springs = [draw_bistable(rng) for _ in kinds]
            tops = sorted(spring.onset for spring in springs)
            most = max(spring.closing for spring in springs) * rng.uniform(1.1, 1.6)
            if not all(1.5 < b / a < 4.0 for a, b in pairwise(tops)):
                continue  # springs of one foam must be similar, but distinguishable
        heights = (SLOW_HEIGHT / len(kinds),) * len(kinds)
        strains = [spring.strain(most) for spring in springs]
        if max(strains) > MOST_STRAIN:
            continue
        peak = float(np.dot(heights, strains))
        motion = slow_motion(setup, peak, rng)
        terms = draw_terms(rng, setup.relaxation, DURATION)
        eta = 10 ** rng.uniform(-2.0, -0.8) * most * SLOW_HEIGHT / (2.0 * peak / DURATION)
        springs[0] = replace(springs[0], relaxation=terms, eta=eta if setup.dashpot else 0.0)
        springs = sorted(springs, key=lambda s: s.onset) if len(kinds) > 1 else springs
        rig = Rig(tuple(springs), heights, SLOW_AREA, motion=motion)
        if setup.cycles > 1:
            motion = cycled(rig, setup.cycles)
            rig = replace(rig, motion=motion)
            if motion.levels[-1] > LEFT * peak:
                continue
        course = rig.run(motion.contact(), motion.times[-1])
        if course.end > motion.times[-2] + 0.3 * (motion.times[-1] - motion.times[-2]):
            return course


def slow(setup: Slow, seed: int) -> Record:
    """Return the record of a slow test."""
    course = drawn_slow(setup, np.random.default_rng([seed, 1]))
    rng = np.random.default_rng([seed, 2])
    rig, own = course.rig, np.linspace(0.0, course.end, setup.rows)
    zero = round(rng.uniform(-3.0, 3.0) * rig.height, 7) if setup.zero else 0.0
    motion, stress = course.top(own, gauge=False), course.stress(own)
    clean = {"force": stress * rig.area, "displacement": motion + zero}
    ranges = {name: float(np.ptp(values)) for name, values in clean.items()}
    ranges["displacement"] *= not setup.exact
    channels, sizes = noisy(clean, ranges, setup.noise, 1.0, seed)
    truth = parameters(rig.springs) | {"contact_time": course.start, "displacement_zero": zero}
    return Record(setup, own, channels, sizes, truth, rig, course)


def write_table(path: Path, record: Record, channels: Sequence[str]) -> None:
    """Write the time and some channels of a record as CSV."""
    unit, factor = ("ms", 1e3) if isinstance(record.setup, Impact) else ("s", 1.0)
    table = {f"time ({unit})": [f"{t * factor:.12g}" for t in record.time]}
    for channel in channels:
        unit, factor = UNITS[channel]
        table[f"{channel} ({unit})"] = [f"{v * factor:.9g}" for v in record.channels[channel]]
    pd.DataFrame(table).to_csv(path, index=False, lineterminator="\n")


def write(record: Record, folder: Path, name: str = "test") -> Path:
    """Write a record as CSV and TOML; return the path of the CSV."""
    path, rig, setup = folder / f"{name}.csv", record.rig, record.setup
    apart = ("displacement",) if record.delay_sd else ()
    write_table(path, record, [one for one in record.channels if one not in apart])
    lines = ["[specimen]", f'height = "{rig.height} m"', f'area = "{rig.area} m^2"']
    if len(rig.heights) > 1:
        lines.append("heights = [" + ", ".join(f'"{h} m"' for h in rig.heights) + "]")
    if isinstance(setup, Impact):
        lines += ["[striker]", f'mass = "{rig.mass} kg"', f'velocity = "{record.toml_velocity}"']
        lines += ["gravity = true"] * (setup.gravity and setup.said)
        if apart:
            write_table(folder / f"{name}-motion.csv", record, apart)
            delay = f'delay = "0 ± {1e6 * record.delay_sd:.6g} us"'
            lines += ["[motion]", f'file = "{name}-motion.csv"', delay]
    elif setup.noise_given:
        lines += ["[noise]", f'stress = "{record.noise["force"] / rig.area} Pa"',
                  f'displacement = "{record.noise["displacement"]} m"']  # fmt: skip
    path.with_suffix(".toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
