"""Synthetic records of three cycles of a foam that remembers what has snapped.

The foam is a chain of discrete micro-springs (docs/theory.md), each with a flag "has snapped once",
and one relaxation term. The machine starts before contact, with arbitrary zeros, and compresses it
three times without losing contact. Nothing here comes from foamfit: the stress at a strain is found
by bisection over the chain.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import minimize_scalar
from scipy.special import ndtri

from rig import draw_microscale
from truth import Array

MICRO_SPRINGS, STEPS, CYCLE = 4000, 2000, 4.0  # springs; steps per leg; s per cycle
HEIGHT, AREA = 10e-3, 4.5e-5  # m, m²
ROWS, NOISE = 1200, 1e-3  # samples; noise of each channel relative to its range
LEAST = 0.02  # fraction of the peak stress at which the machine reverses
DEEPEST, BACK = 0.82, 0.3  # largest strain; largest fraction left at the reversal


@dataclass
class Ensemble:
    """Micro-springs in series at one stress, with the state of each."""

    values: dict[str, float]
    count: int = MICRO_SPRINGS

    def __post_init__(self) -> None:
        """Start unloaded, with ranks of equal shares."""
        v, ranks = self.values, ndtri((np.arange(self.count) + 0.5) / self.count)
        self.first = v["sigma_plus"] * np.exp(v["spread_plus"] * ranks)
        self.back = v["sigma_minus"] * np.exp(v["spread_minus"] * ranks)
        self.snapped = np.zeros(self.count, bool)
        self.ever = self.snapped.copy()
        self.stress = 0.0

    def after(self, stress: float) -> Array:
        """Return which micro-springs are snapped after the stress has reached this value."""
        through = np.where(self.ever, self.first * math.exp(-self.values["weakening"]), self.first)
        if stress >= self.stress:
            return self.snapped | (stress >= through)
        return self.snapped & (stress >= np.minimum(self.back, through))

    def strain(self, stress: float, snapped: Array) -> float:
        """Return the mean strain of the chain."""
        v, n = self.values, self.values["stiffening"]
        soft = v["k0"] * math.exp(-v["softening"])
        virgin, worn = (1.0 - (1.0 + n * stress / k) ** (-1.0 / n) for k in (v["k0"], soft))
        compressed = v["eps_star"] + stress / (v["kc"] + stress)
        p, ever = float(snapped.mean()), float((self.ever | snapped).mean())
        return (1.0 - ever) * virgin + (ever - p) * worn + p * compressed

    def press(self, strain: float) -> float:
        """Bring the chain to a strain; return the stress."""
        rising = strain > self.strain(self.stress, self.snapped)
        low, high = (self.stress, 20.0 * self.first[-1]) if rising else (0.0, self.stress)
        for _ in range(50):
            middle = 0.5 * (low + high)
            above = self.strain(middle, self.after(middle)) > strain
            low, high = (low, middle) if above else (middle, high)
        self.snapped = self.after(high)
        self.stress, self.ever = high, self.ever | self.snapped
        return high


def draw(rng: np.random.Generator) -> tuple[dict[str, float], float]:
    """Draw a foam and the stress at its largest compression."""
    names = ("k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus")
    while True:
        spring, most = draw_microscale(rng)
        values = {name: getattr(spring, name) for name in names}
        values["stiffening"] = 10.0 ** rng.uniform(0.0, 1.2)
        values["softening"], values["weakening"] = rng.uniform(0.3, 1.0), rng.uniform(0.1, 0.5)
        values["g1"] = rng.uniform(0.1, 0.8)
        values["tau1"] = CYCLE * 10.0 ** rng.uniform(-2.0, -0.7)
        soft, n = values["k0"] * math.exp(-values["softening"]), values["stiffening"]

        def lead(log: float, soft: float = soft, n: float = n, kc: float = values["kc"]) -> float:
            s = math.exp(log)
            return s / (kc + s) - 1.0 + (1.0 + n * s / soft) ** (-1.0 / n)

        bounds = (math.log(1e-4 * soft), math.log(1e4 * soft))
        least = -min(minimize_scalar(lead, bounds=bounds, method="bounded").fun, 0.0)
        values["eps_star"] = least + rng.uniform(0.02, 0.2)
        row = Ensemble(values)
        top = row.strain(most, row.after(most))
        if top < DEEPEST:
            return values, top


def pressed(values: dict[str, float], top: float) -> tuple[list[float], list[float]]:
    """Compress a foam three times, to `top` and slightly beyond; return strains and stresses."""
    row, g, tau = Ensemble(values), values["g1"], values["tau1"]
    step = 0.5 * CYCLE / STEPS
    fade, gain = math.exp(-step / tau), g * tau / step * (1.0 - math.exp(-step / tau))
    strains, stresses, relaxing, peak = [0.0], [0.0], 0.0, 0.0
    for leg in range(6):
        ups = leg % 2 == 0
        goal = top * (1.0 + 0.02 * (leg // 2))
        rate = (goal - strains[-1]) / STEPS if ups else -top / STEPS
        for _ in range(STEPS):
            before = row.stress
            strains.append(strains[-1] + rate)
            relaxing = relaxing * fade + gain * (row.press(strains[-1]) - before)
            stresses.append(row.stress + relaxing)
            peak = max(peak, stresses[-1])
            if not ups and stresses[-1] < LEAST * peak:
                break
    return strains, stresses


@dataclass(frozen=True)
class Cycled:
    """A noisy record of three cycles, and the true parameters by foamfit's names."""

    truth: dict[str, float]
    table: pd.DataFrame

    def write(self, folder: Path) -> Path:
        """Write CSV and TOML; return the path of the CSV."""
        path = folder / "test.csv"
        self.table.to_csv(path, index=False, float_format="%.9g")
        specimen = f'[specimen]\nheight = "{HEIGHT} m"\narea = "{AREA} m^2"\n'
        path.with_suffix(".toml").write_text(specimen, encoding="utf-8")
        return path


def cycled(seed: int) -> Cycled:
    """Return the record of one test."""
    rng = np.random.default_rng([seed, 11])
    values, top = draw(rng)
    strains, stresses = pressed(values, top)
    while strains[-1] > BACK * top:
        values, top = draw(rng)
        strains, stresses = pressed(values, top)
    step = 0.5 * CYCLE / STEPS
    own = np.linspace(0, len(strains) - 1, ROWS)
    at = np.arange(len(strains))
    early = int(rng.uniform(30, 120))  # rows before contact, at the speed of the first leg
    own = np.concatenate([own[1] * np.arange(-early, 0) + 0.3 * own[1], own])
    strain = np.interp(own, at, strains) + np.minimum(own, 0.0) * strains[1]
    clean = [strain * HEIGHT, np.interp(own, at, stresses) * AREA]
    w, force = (c + NOISE * np.ptp(c) * rng.standard_normal(own.size) for c in clean)
    w, force = w + rng.uniform(-3.0, 3.0) * HEIGHT, force + 0.02 * rng.normal() * np.ptp(force)
    columns = {"time (s)": own * step + 5.0, "displacement (mm)": 1e3 * w, "force (N)": force}
    return Cycled({f"s1_{name}": value for name, value in values.items()}, pd.DataFrame(columns))
