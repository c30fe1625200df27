"""Do wrong calibrations and faulty channels mislead a fit?

Method. `rig` generates synthetic impacts of a bistable spring with force and displacement. One
thing is wrong in each record: the velocity, the mass or the scale of the force, by 10 to 25 %; or
the force is clipped, drifts, rings or lags behind the motion. Each is processed like a user's: CSV,
TOML, `foamfit.read_test`, the defaults of `foamfit.fit`. Counted are the records that `read_test`
says contradict themselves, and the values of spring parameters that are called determined although
the true value is outside the interval by more than its width ("far").

Answer. Of 1270 values called determined in 360 fits, 1 is far. Every wrong velocity, mass and scale
and every lag is found; no right record contradicts itself. See README.md.

    python experiments/recovery/calibration.py --raw rows.csv            # 30 tests of each class
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from rig import Impact, Record, impact, write
from rigs import JOB, Row, fitted, judged, run, sentence, studies

import foamfit as ff
from foamfit.data.calibration import contradictions


def stated(velocity: float = 1.0, mass: float = 1.0) -> Callable[[Record], Record]:
    """Multiply velocity and mass in the TOML."""

    def changed(record: Record) -> Record:
        said = f"{velocity * record.rig.velocity:.12g} m/s"
        return replace(
            record, toml_velocity=said, rig=replace(record.rig, mass=mass * record.rig.mass)
        )

    return changed


def sensed(
    change: Callable[[np.ndarray, np.ndarray, float], np.ndarray],
) -> Callable[[Record], Record]:
    """Change the force, given its samples, the time over the time under load, and its range."""

    def changed(record: Record) -> Record:
        force, lasts = record.channels["force"], record.course.end
        since = (record.time - record.truth["contact_time"]) / lasts
        channels = record.channels | {"force": change(force, since, float(np.ptp(force)))}
        return replace(record, channels=channels)

    return changed


def clipped(share: float) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray]:
    """Clip the force at a share of its range."""
    return lambda force, _, size: np.minimum(force, np.min(force) + share * size)


def ringing(force: np.ndarray, since: np.ndarray, size: float) -> np.ndarray:
    """Add a decaying vibration that starts at contact."""
    after = np.maximum(since, 0.0)
    return force + 0.05 * size * np.exp(-6.0 * after) * np.sin(2.0 * np.pi * 15.0 * after)


CLASSES: dict[str, Callable[[Record], Record]] = {
    "nothing wrong": lambda record: record,
    "velocity -10 %": stated(velocity=0.9),
    "velocity +10 %": stated(velocity=1.1),
    "mass -20 %": stated(mass=0.8),
    "mass +25 %": stated(mass=1.25),
    "force x 0.8": sensed(lambda force, *_: 0.8 * force),
    "force x 1.25": sensed(lambda force, *_: 1.25 * force),
    "clipped at 80 %": sensed(clipped(0.8)),
    "clipped at 60 %": sensed(clipped(0.6)),
    "drift of 5 %": sensed(lambda force, since, size: force + 0.05 * size * since),
    "ringing, 5 %": sensed(ringing),
    "lag of 3 %": sensed(lambda force, since, _: np.interp(since - 0.03, since, force)),
}


def contradicted(record: Record) -> str:
    """Return the numbers that a record contradicts, as `read_test` finds them."""
    with tempfile.TemporaryDirectory() as folder:
        test = ff.read_test(write(record, Path(folder)))
    return ", ".join(one.quantity for one in contradictions(test))


def run_test(family: str, name: str, seed: int) -> list[Row]:
    """Simulate, spoil, write, read and fit one test; return a row per parameter, or a failure."""
    about: Row = {"family": family, "class": name, "test": seed}
    began = time.perf_counter()
    try:
        record = CLASSES[name](impact(Impact(), seed))
        about |= {"rows": len(record.time), "way": contradicted(record) or "none"}
        _, result, estimates = fitted(record)
    except Exception as error:
        return [about | {"error": sentence(error), "seconds": time.perf_counter() - began}]
    about |= {"status": result.status, "seconds": time.perf_counter() - began}
    springs = {n: one for n, one in estimates.items() if one.vary and n.startswith("s1_")}
    return [about | judged(n, record.truth[n], one) for n, one in springs.items()]


def table_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Count contradictions and far values of each class."""
    out = []
    for name, group in rows.groupby("class", sort=False):
        each, given = group.drop_duplicates(JOB), group[group["low"].notna()]
        out.append({
            "wrong": name, "tests": len(each), "failed": int(group["error"].notna().sum()),
            "contradicted": int((each["way"].notna() & (each["way"] != "none")).sum()),
            "with warnings": int((each["status"] == "warnings").sum()),
            "determined": int((group["state"] == "determined").sum()), "intervals": len(given),
            "contain the true value %": 100.0 * given["holds"].astype(bool).mean(),
            "far": int(group["far"].fillna(False).astype(bool).sum()),
        })  # fmt: skip
    return pd.DataFrame(out)


def main() -> None:
    """Run the classes and print the table."""
    parser = studies.arguments(__doc__, tests=30, jobs=(1, "processes"))
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--raw", type=Path, help="rows of all tests; resumed")
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.tests)
    jobs = [("impact", name, seed) for seed in seeds for name in CLASSES]
    rows = run(run_test, jobs, options.raw, options.jobs)
    print(studies.shown(table_of(rows)))
    for row in rows[rows["far"].fillna(False).astype(bool)].itertuples():
        found = f"{row.value:.3g} ({row.low:.3g} to {row.high:.3g}), true {row.truth:.3g}"
        print(f"{rows.loc[row.Index, 'class']}, test {row.test}: {row.parameter} = {found}")
    for name, error in rows.loc[rows["error"].notna(), ["class", "error"]].to_numpy():
        print(f"{name}: {error}")
    print(studies.circumstances())


if __name__ == "__main__":
    main()
