"""How accurately is a motion recovered from a noisy displacement, and with what uncertainty?

Method and answer: README.md, which 225 draws of each class (a minute) write.

    python experiments/motion/motion.py --draws 25
    python experiments/motion/motion.py --draws 4      # prints the tables only
"""

import sys
from collections.abc import Callable, Iterator
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


def one(name: str, rows: int, noise: float, rng: np.random.Generator) -> Iterator[dict]:
    """Smooth one noisy motion; yield a row for it and one for each true turning point."""
    motion, t = CLASSES[name](rng), np.linspace(0.0, 1.0, rows)
    if rng.random() < 0.3:  # uneven sampling
        t[1:-1] += rng.uniform(-0.33, 0.33, rows - 2) / rows
    true = motion.at(t)
    noisy = true + noise * rng.standard_normal(rows)
    found, seconds = studies.timed(follow, t, noisy, NoiseLevel(noise, True, ""))
    off = found.at(t) - true
    stderr = np.linalg.norm(found.modes(t), axis=1)
    held = np.abs(off) < Z95 * stderr
    near = np.any(np.abs(t[:, None] - motion.turns) < NEAR, axis=1)
    for a, b in motion.holds:
        near |= (t > a - NEAR) & (t < b + NEAR)
    pairs = matched(motion, found.turns)
    fine = np.linspace(0.0, 1.0, 7 * rows)
    steps = np.diff(found.at(np.union1d(fine, found.turns)))
    stretch = np.searchsorted(found.turns, np.union1d(fine, found.turns)[:-1], side="right")
    back = max(
        float(min(np.maximum(-part, 0.0).max(), np.maximum(part, 0.0).max()))
        for part in (steps[stretch == k] for k in np.unique(stretch))
    )
    row = {"class": name, "rows": rows, "noise": noise, "ms": 1e3 * seconds}
    yield row | {
        "what": "motion", "rms": off / noise @ off / noise / rows,
        "near": float(np.mean((off[near] / noise) ** 2)) if near.any() else np.nan,
        "held": held.mean(), "held_near": held[near].mean() if near.any() else np.nan,
        "worst": np.abs(off).max() / noise,
        "invented": len(found.turns) - len(pairs), "back": back,
        "modes": found.modes(t[:1]).shape[1],
    }  # fmt: skip
    ends = np.concatenate([[0.0], motion.turns, [1.0]])
    heights = motion.at(ends)
    sizes, lasts = np.abs(np.diff(heights)), np.diff(ends)
    for i, (at, height) in enumerate(zip(motion.turns, heights[1:-1], strict=True)):
        j = dict(pairs).get(i)
        turn = row | {
            "what": "turn", "size": min(sizes[i : i + 2]) / noise, "found": j is not None,
            "samples": rows * min(lasts[i : i + 2]),
        }  # fmt: skip
        if j is not None:
            here = found.turns[j : j + 1]
            over = float(np.sign(height - heights[i]) * (found.at(here)[0] - height))
            turn["height"] = over / noise
            turn["height_z"] = over / np.linalg.norm(found.modes(here))
            if not motion.holds.size:
                turn["late"] = rows * float(here[0] - at)
        yield turn


def table(data: pd.DataFrame, by: str) -> pd.DataFrame:
    """Return means over draws."""
    motions, turns = data[data.what == "motion"], data[data.what == "turn"]
    m = motions.groupby(by, sort=False)
    f = turns[turns.found.eq(True)].groupby(by, sort=False)

    def held(values: pd.Series) -> float:
        return 100.0 * float((values.dropna().abs() < Z95).mean())

    def rms(values: pd.Series) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return pd.DataFrame({
        "draws": m.size(), "RMS (σ)": m.rms.mean() ** 0.5,
        "RMS near turns (σ)": m.near.mean() ** 0.5, "worst (σ)": m.worst.max(),
        "held (%)": 100.0 * m.held.mean(), "held near turns (%)": 100.0 * m.held_near.mean(),
        "height: bias (σ)": f.height.mean(), "height: RMS (σ)": f.height.apply(rms),
        "height held (%)": f.height_z.apply(held), "instant: RMS (samples)": f.late.apply(rms),
        "false turns (%)": 100.0 * m.invented.apply(lambda v: np.mean(v > 0)),
        "largest reversal (σ)": m.back.max(), "modes": m.modes.median(),
        "median time (ms)": m.ms.median(),
    })  # fmt: skip


def found_by_size(data: pd.DataFrame) -> pd.DataFrame:
    """Return the share of detected inner-loop turning points, by size relative to the noise."""
    turns = data[(data.what == "turn") & (data["class"] == "inner loop")]
    turns = turns[turns["size"] * turns.noise < 0.3]  # larger ones are of the triangle itself
    names = ["0 to 5", "5 to 10", "10 to 15", "15 to 20", "20 to 30", "above 30"]
    shows = pd.cut(turns["size"] * turns.samples**0.5, [0, 5, 10, 15, 20, 30, 1e9], labels=names)
    long = turns.samples.gt(3.0).map({True: "of 3 samples and more", False: "of fewer"})
    seen = turns.found.astype(float)
    counts = {"found (%)": lambda share: 100.0 * share.mean(), "turns": "size"}
    out = seen.groupby([shows, long], observed=True).agg(**counts).unstack()
    out.columns = [f"{kind}: {what}" for what, kind in out]
    return out.rename_axis(index="drop (σ) × √samples")


def main() -> None:
    parser = studies.arguments(__doc__, draws=(25, "of each class, rows and noise"), seed=0)
    options = parser.parse_args()
    cases = product(enumerate(CLASSES), ROWS, enumerate(NOISE), range(options.draws))
    data = pd.DataFrame(
        row for (k, name), n, (i, noise), draw in cases
        for row in one(name, n, noise, np.random.default_rng([options.seed, k, n, i, draw]))
    )  # fmt: skip
    percents = (100.0 * data.noise).round(3).astype(str)
    data["cell"] = data.rows.astype(str) + " rows, " + percents + " %"
    tables = {"classes": table(data, "class"), "cells": table(data, "cell")}
    tables["found"] = found_by_size(data)
    values = {name: studies.shown(one.astype(float).reset_index()) for name, one in tables.items()}
    whole = options.draws >= 25 and options.seed == 0
    with studies.workplace() as folder:
        print(studies.write_page(
            HERE, HERE if whole else folder, draws=options.draws * len(ROWS) * len(NOISE), **values
        ))  # fmt: skip


if __name__ == "__main__":
    main()
