"""How accurately is a motion recovered from a noisy displacement, and with what uncertainty?

Method and answer: README.md, which 225 draws of each class (a minute) write.

    python experiments/motion/motion.py
    python experiments/motion/motion.py --draws 4 --out FOLDER
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from foamfit.data.measurement import NoiseLevel
from foamfit.data.motion import follow

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies

HERE = Path(__file__).parent
ROWS, NOISE = (300, 1000, 5000), (0.0005, 0.001, 0.003)
NEAR = 0.01  # of the duration, on both sides of a turning point
Z95 = 1.959964


@dataclass(frozen=True)
class Motion:
    """A motion over the times 0 to 1, its turning points in order, and its holds."""

    at: Callable[[np.ndarray], np.ndarray]
    turns: np.ndarray
    holds: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))


def straight(places: list[float], heights: list[float]) -> Motion:
    """Return straight lines; the turning point of a hold is at its middle."""
    places, heights = np.array(places), np.array(heights)
    moves = np.flatnonzero(np.diff(heights))
    up = np.sign(np.diff(heights)[moves])
    back = np.flatnonzero(up[:-1] != up[1:])
    turns = 0.5 * (places[moves[back] + 1] + places[moves[back + 1]])
    flat = np.flatnonzero(np.diff(heights) == 0.0)
    holds = np.column_stack([places[flat], places[flat + 1]])
    return Motion(lambda t: np.interp(t, places, heights), turns, holds)


def smooth(function: Callable[[np.ndarray], np.ndarray]) -> Motion:
    fine = np.linspace(0.0, 1.0, 200_001)
    values = function(fine)
    low, size = values.min(), np.ptp(values)
    speed = np.diff(values)
    turns = fine[1:-1][speed[:-1] * speed[1:] < 0.0]
    return Motion(lambda t: (function(t) - low) / size, turns)


def half_sine(end: float) -> Motion:
    return smooth(lambda t: np.sin(np.pi * end * t))


def haversine(turn: float) -> Motion:
    return smooth(lambda t: 0.5 - 0.5 * np.cos(np.pi * t / turn))


def slow_start(ramp: float, turn: float) -> Motion:
    """Return a triangle whose speed grows from zero along the ramp."""

    def up(t: np.ndarray) -> np.ndarray:
        return np.where(t < ramp, t**2 / (2.0 * ramp), t - 0.5 * ramp)

    high = float(up(np.array(turn)))
    return Motion(
        lambda t: np.where(t < turn, up(t), high * (1.0 - t) / (1.0 - turn)) / high,
        np.array([turn]),
    )


def inner_loop(rng: np.random.Generator) -> Motion:
    """Return a triangle with one reversal by 0.5 to 20 % of its range on the way up or down."""
    size, level = float(np.exp(rng.uniform(np.log(0.005), np.log(0.2)))), rng.uniform(0.3, 0.75)
    heights = [0.0, level, level - size, 1.0, 0.0]
    if rng.random() < 0.5:
        heights = [0.0, 1.0, level - size, level, 0.0]
    way = np.append(0.0, np.cumsum(np.abs(np.diff(heights))))
    return straight(list(way / way[-1]), heights)


def random_smooth(rng: np.random.Generator) -> Motion:
    """Return a half sine with uneven time scale and waves that may add turning points."""
    phase, size = rng.uniform(0.0, 2.0 * np.pi, 4), rng.normal(0.0, 1.0, 4)
    wave, number = rng.uniform(0.0, 0.08), rng.integers(2, 6)

    def at(t: np.ndarray) -> np.ndarray:
        late = sum(
            s / (k + 1) ** 2 * (np.sin(np.pi * (k + 1) * t + p) - np.sin(p))
            for k, (s, p) in enumerate(zip(size, phase, strict=True))
        )
        clock = t + 0.05 * late
        return np.sin(0.95 * np.pi * clock) + wave * np.sin(2.0 * np.pi * number * t + phase[0])

    return smooth(at)


CLASSES: dict[str, Callable[[np.random.Generator], Motion]] = {
    "triangle": lambda rng: straight(
        [0.0, rng.uniform(0.4, 0.6), 1.0], [0.0, 1.0, rng.uniform(0.0, 0.1)]),
    "unequal speeds": lambda rng: straight(
        [0.0, rng.choice([rng.uniform(0.08, 0.4), rng.uniform(0.6, 0.92)]), 1.0], [0.0, 1.0, 0.0]),
    "half sine": lambda rng: half_sine(rng.uniform(0.8, 1.0)),
    "haversine": lambda rng: haversine(rng.uniform(0.45, 0.55)),
    "trapezoid": lambda rng: straight(
        [0.0, start := rng.uniform(0.35, 0.45), start + rng.uniform(0.02, 0.2), 1.0],
        [0.0, 1.0, 1.0, 0.0]),
    "slow start": lambda rng: slow_start(rng.uniform(0.01, 0.1), rng.uniform(0.4, 0.6)),
    "inner loop": inner_loop, "random smooth": random_smooth,
}  # fmt: skip


def matched(motion: Motion, turns: np.ndarray) -> list[tuple[int, int]]:
    """Pair true and found turning points of one kind, each closer than the next true one."""
    ends = np.concatenate([[0.0], motion.turns, [1.0]])
    pairs, taken = [], set()
    for i, true in enumerate(motion.turns):
        left, right = 0.5 * (ends[i] + true), 0.5 * (true + ends[i + 2])
        inside = [j for j in np.flatnonzero((turns > left) & (turns < right)) if j not in taken]
        if inside:
            j = min(inside, key=lambda k: abs(turns[k] - true))
            pairs.append((i, int(j)))
            taken.add(j)
    return pairs


def one(name: str, rows: int, noise: float, rng: np.random.Generator) -> dict[str, float]:
    """Smooth one noisy motion; return its errors in units of the noise."""
    motion, t = CLASSES[name](rng), np.linspace(0.0, 1.0, rows)
    if rng.random() < 0.3:  # uneven sampling
        t[1:-1] += rng.uniform(-0.33, 0.33, rows - 2) / rows
    true = motion.at(t)
    noisy = true + noise * rng.standard_normal(rows)
    found, seconds = studies.timed(follow, t, noisy, NoiseLevel(noise, True, ""))
    off = found.at(t) - true
    held = np.abs(off) < Z95 * np.linalg.norm(found.modes(t), axis=1)
    near = np.any(np.abs(t[:, None] - motion.turns) < NEAR, axis=1)
    for a, b in motion.holds:
        near |= (t > a - NEAR) & (t < b + NEAR)
    some, pairs = bool(near.any()), matched(motion, found.turns)
    fine = np.union1d(np.linspace(0.0, 1.0, 7 * rows), found.turns)
    steps, stretch = np.diff(found.at(fine)), np.searchsorted(found.turns, fine[:-1], side="right")
    back = (  # the largest step against the direction of each stretch between turning points
        min(np.maximum(-part, 0.0).max(), np.maximum(part, 0.0).max())
        for part in (steps[stretch == k] for k in np.unique(stretch))
    )
    heights = [
        (found.at(here)[0] - motion.at(motion.turns[i : i + 1])[0]) / np.linalg.norm(
            found.modes(here))
        for i, j in pairs for here in [found.turns[j : j + 1]]
    ]  # fmt: skip
    return {
        "mean square": float(np.mean((off / noise) ** 2)),
        "near": float(np.mean((off[near] / noise) ** 2)) if some else np.nan,
        "worst": np.abs(off).max() / noise, "held": held.mean(),
        "held near": held[near].mean() if some else np.nan,
        "heights": len(heights), "heights held": int(np.sum(np.abs(heights) < Z95)),
        "invented": len(found.turns) - len(pairs), "back": max(back), "ms": 1e3 * seconds,
    }  # fmt: skip


def table(data: pd.DataFrame, by: str) -> pd.DataFrame:
    """Return means over draws."""
    m = data.groupby(by, sort=False)
    return pd.DataFrame({
        "draws": m.size(), "RMS (σ)": m["mean square"].mean() ** 0.5,
        "RMS near turns (σ)": m["near"].mean() ** 0.5, "worst (σ)": m["worst"].max(),
        "held (%)": 100.0 * m["held"].mean(), "held near turns (%)": 100.0 * m["held near"].mean(),
        "height held (%)": 100.0 * m["heights held"].sum() / m["heights"].sum(),
        "false turns (%)": 100.0 * m["invented"].agg(lambda v: np.mean(v > 0)),
        "largest reversal (σ)": m["back"].max(), "median time (ms)": m["ms"].median(),
    }).reset_index()  # fmt: skip


def main() -> None:
    draws = (25, "of each class, rows and noise")
    options = studies.arguments(__doc__, HERE, draws=draws).parse_args()
    cases = product(enumerate(CLASSES), ROWS, enumerate(NOISE), range(options.draws))
    data = pd.DataFrame(
        {"class": name, "cell": f"{n} rows, {100.0 * noise:g} %"}
        | one(name, n, noise, np.random.default_rng([0, k, n, i, draw]))
        for (k, name), n, (i, noise), draw in cases
    )  # fmt: skip
    studies.write_page(
        HERE, options.out, draws=options.draws * len(ROWS) * len(NOISE),
        **{by: studies.shown(table(data, by)) for by in ("class", "cell")},
    )  # fmt: skip


if __name__ == "__main__":
    main()
