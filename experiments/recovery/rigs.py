"""Do the 95 % intervals contain the true values on records like those of a test rig?

Method and answer: README.md. Synthetic tests of four families are processed like a user's: impact
and slow (`rig`), fault (impacts with a wrong number or channel) and memory (three cycles). A row
for each parameter contains true value and interval; a test that cannot be read or fitted gets a row
with the message.

    python experiments/recovery/rigs.py --raw rows.csv         # 200 tests of each class, resumable
    python experiments/recovery/rigs.py --family slow --classes microscale --tests 20
"""

import re
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff
from foamfit.data.calibration import contradictions

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from rig import Impact, Record, Slow, impact, slow, write
from truth import Array, Bistable, Rig

Row = dict[str, Any]
Job = tuple[str, str, int]
JOB = ["family", "class", "test"]
COLUMNS = [
    *JOB, "parameter", "truth", "value", "low", "high", "state", "holds", "far", "contradicted",
    "seconds", "error",
]  # fmt: skip

# Wrong calibrations and faulty channels: each changes the record of a synthetic impact.


def stated(record: Record, velocity: float = 1.0, mass: float = 1.0) -> Record:
    """Multiply velocity and mass in the TOML."""
    said = f"{velocity * record.rig.velocity:.12g} m/s"
    return replace(record, toml_velocity=said, rig=replace(record.rig, mass=mass * record.rig.mass))


def sensed(record: Record, change: Callable[[Array, Array, float], Array]) -> Record:
    """Change the force, given its samples, the time over the time under load, and its range."""
    force, lasts = record.channels["force"], record.course.end
    since = (record.time - record.truth["contact_time"]) / lasts
    changed = {"force": change(force, since, float(np.ptp(force)))}
    return replace(record, channels=record.channels | changed)


def clipped(force: Array, _: Array, size: float, share: float) -> Array:
    """Clip the force at a share of its range."""
    return np.minimum(force, np.min(force) + share * size)


def ringing(force: Array, since: Array, size: float) -> Array:
    """Add a decaying vibration that starts at contact."""
    after = np.maximum(since, 0.0)
    return force + 0.05 * size * np.exp(-6.0 * after) * np.sin(2.0 * np.pi * 15.0 * after)


BOTH = ("force", "displacement")
IMPACTS = {
    "trimmed at contact": Impact(trimmed=True),
    "right zero": Impact(zero=False),
    "any zero": Impact(),
    "any zero, 0.05 %": Impact(noise=5e-4),
    "any zero, 2 %": Impact(noise=0.02),
    "any zero, correlated": Impact(tau=8.0),
    "any zero, 150 samples": Impact(samples=150),
    "any zero, 3000 samples": Impact(samples=3000),
    "few rows before": Impact(before=0.02),
    "force only": Impact(channels=("force",)),
    "acceleration only": Impact(channels=("acceleration",)),
    "acceleration only, 0.1 %": Impact(channels=("acceleration",), noise=1e-3),
    "force and acceleration": Impact(channels=("force", "acceleration")),
    "acceleration and motion": Impact(channels=("acceleration", "displacement")),
    "all three": Impact(channels=(*BOTH, "acceleration")),
    "gauge on the specimen": Impact(gauge=True),
    "late motion": Impact(delay_sd=0.03),
    "late motion, gauge on the specimen": Impact(delay_sd=0.03, gauge=True),
    "velocity only": Impact(channels=("velocity",), noise=1e-3),
    "gravity": Impact(gravity=True),
    "gravity, not said": Impact(gravity=True, said=False),
    "velocity ± 1 %": Impact(velocity_sd=0.01),
    "microscale": Impact(law="microscale"),
    "microscale, force only": Impact(law="microscale", channels=("force",)),
    "microscale+1": Impact(law="microscale", relaxation=1),
    "microscale+1, force only": Impact(law="microscale", relaxation=1, channels=("force",)),
}
LAWS = {
    "bistable": Slow("bistable"),
    "microscale": Slow("microscale"),
    "microscale+1": Slow("microscale", 1),
    "microscale+2": Slow("microscale", 2),
    "two springs": Slow("bistable+bistable"),
}
SLOW = {
    f"{law}, {rows} rows, {100.0 * noise:g} %": replace(setup, rows=rows, noise=noise)
    for (law, setup), rows, noise in product(LAWS.items(), (300, 1000, 5000), (5e-4, 1e-3, 3e-3))
} | {
    "microscale, exact motion": Slow(exact=True),
    "microscale with dashpot": Slow(dashpot=True, noise=1e-3),
    "microscale+1 with dashpot": Slow(relaxation=1, dashpot=True, noise=1e-3),
    "microscale+1, sine": Slow(relaxation=1, motion="sine", noise=1e-3),
    "microscale+1, trapezoid": Slow(relaxation=1, motion="trapezoid", noise=1e-3),
    "microscale+1, slow start":
        Slow("microscale", 1, False, "ramp", noise=1e-3, early=True, zero=True),
    "microscale, unloading by 10 %": Slow(inner=0.1, noise=1e-3),
    "microscale, unloading by 3 %": Slow(inner=0.03, noise=1e-3),
    "microscale, unloading by 1 %": Slow(inner=0.01, noise=1e-3),
    "microscale, noise given": Slow(noise_given=True),
    "bistable, before contact, any zero": Slow("bistable", noise=1e-3, early=True, zero=True),
}  # fmt: skip
FAULTS: dict[str, Callable[[Record], Record]] = {
    "nothing wrong": lambda record: record,
    "velocity -10 %": partial(stated, velocity=0.9),
    "velocity +10 %": partial(stated, velocity=1.1),
    "mass -20 %": partial(stated, mass=0.8),
    "mass +25 %": partial(stated, mass=1.25),
} | {
    name: partial(sensed, change=change)
    for name, change in {
        "force x 0.8": lambda force, *_: 0.8 * force,
        "force x 1.25": lambda force, *_: 1.25 * force,
        "clipped at 80 %": partial(clipped, share=0.8),
        "clipped at 60 %": partial(clipped, share=0.6),
        "drift of 5 %": lambda force, since, size: force + 0.05 * size * since,
        "ringing, 5 %": ringing,
        "lag of 3 %": lambda force, since, _: np.interp(since - 0.03, since, force),
    }.items()
}
MEMORY = {
    "three cycles": Slow(relaxation=1, cycles=3, rows=1200, noise=1e-3, early=True, zero=True)
}
FAMILIES: dict[str, dict[str, Any]] = {
    "impact": IMPACTS, "slow": SLOW, "fault": FAULTS, "memory": MEMORY,
}  # fmt: skip


def make(family: str, name: str, seed: int) -> Record:
    """Return one record of a class."""
    setup = FAMILIES[family][name]
    if family == "fault":
        return setup(impact(Impact(), seed))
    return impact(setup, seed) if family == "impact" else slow(setup, seed)


def chain_of(made: Rig) -> ff.Chain:
    """Return the true springs as a chain of foamfit."""
    kinds = (ff.MicroscaleSpring, ff.BistableSpring)
    springs = [kinds[isinstance(one, Bistable)](**asdict(one)) for one in made.springs]
    return ff.Chain(springs, made.heights, made.area)


def fitted(record: Record) -> tuple[ff.Measurement, dict[str, Any]]:
    """Write, read and fit a record; return test and estimates with a true value.

    The rig numbers springs by the stress at which they start to snap, and relaxation terms by their
    time, like the fit.
    """
    options: dict[str, Any] = {"model": record.setup.law, "relaxation": record.setup.relaxation}
    cycles = getattr(record.setup, "cycles", 1)
    with studies.workplace() as folder:
        path = write(record, folder)
        test = ff.read_test(path, cycles=(1, cycles)) if cycles > 1 else ff.read_test(path)
    if cycles > 1:
        options |= {"stiffening": True, "mullins": True}
    if getattr(record.setup, "dashpot", False):  # fixed at zero by default
        options["params"] = ff.make_params(test, drive="displacement", **options)
        options["params"]["s1_eta"].vary = True
    result = ff.fit(test, seed=0, **options)
    return test, {a: p for a, p in result.parameters.items() if a in record.truth}


def judged(parameter: str, truth: float, estimate: Any) -> Row:
    """Compare an estimate with the true value."""
    low, high = map(float, estimate.ci95 or (np.nan, np.nan))
    outside = max(low - truth, truth - high)
    return {
        "parameter": parameter, "truth": truth, "value": float(estimate.value), "low": low,
        "high": high, "state": estimate.state, "holds": bool(outside <= 0.0),
        "far": estimate.state == "determined" and bool(outside > high - low),
    }  # fmt: skip


def run_test(family: str, name: str, seed: int) -> list[Row]:
    """Simulate, write, read and fit one test; return a row per parameter, or for a failure."""
    about, began = dict(zip(JOB, (family, name, seed), strict=True)), time.perf_counter()
    try:
        record = make(family, name, seed)
        began = time.perf_counter()
        test, estimates = fitted(record)
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})"
        return [about | {"error": text, "seconds": time.perf_counter() - began}]
    about["seconds"] = time.perf_counter() - began
    about["contradicted"] = ", ".join(one.quantity for one in contradictions(test))
    found = estimates.items()
    return [about | judged(name, record.truth[name], one) for name, one in found if one.vary]


def run(jobs: list[Job], raw: Path | None, processes: int) -> pd.DataFrame:
    """Run the jobs that are not yet in `raw`, and update it after each."""
    old = pd.read_csv(raw) if raw is not None and raw.exists() else pd.DataFrame(columns=COLUMNS)
    done = set(old[JOB].itertuples(index=False, name=None))
    left = [job for job in jobs if job not in done]
    tables = [old] if len(old) else []
    for number, more in enumerate(studies.in_order(run_test, left, processes), start=1):
        tables.append(pd.DataFrame(more, columns=COLUMNS).astype(object))
        if raw is not None:
            tables[-1].to_csv(raw, mode="a", index=False, header=not raw.exists())
        print(f"\r{number} of {len(left)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    rows = pd.concat(tables, ignore_index=True).infer_objects()
    return rows[pd.MultiIndex.from_frame(rows[JOB]).isin(jobs)]


def coverage(rows: pd.DataFrame, by: str) -> pd.DataFrame:
    """Return the coverage for each value of a column and for all together."""
    out = []
    for name, group in [*rows.groupby(by, sort=False), ("all", rows)]:
        springs = group
        if by != "parameter":  # without contact and zeros
            springs = group[group["parameter"].str.match(r"s\d_", na=False)]
        given, each = springs[springs["low"].notna()], group.drop_duplicates(JOB)
        holds = studies.share(given["holds"].astype(bool).tolist()) if len(given) else {}
        out.append({
            by: name, "tests": len(each), "failed": int(each["parameter"].isna().sum()),
            "intervals": len(given), **{f"{k} %": 100.0 * part for k, part in holds.items()},
            "far": int(given["far"].sum()), "parameters": len(springs),
            "determined": int((springs["state"] == "determined").sum()),
            "contradicted": int(each["contradicted"].fillna("").ne("").sum()),
            "seconds": each["seconds"].median(),
        })  # fmt: skip
    return pd.DataFrame(out)


def main() -> None:
    parser = studies.arguments(__doc__, tests=200, jobs=(1, "processes"))
    parser.add_argument("--family", choices=[*FAMILIES], help="by default impact and slow")
    parser.add_argument("--classes", default="", help="a pattern that names of classes begin with")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--raw", type=Path, help="rows of all tests; resumed")
    parser.add_argument("--out", type=Path, help="the table of classes")
    options = parser.parse_args()
    families = [options.family] if options.family else ["impact", "slow"]
    classes = [(f, name) for f in families for name in FAMILIES[f]]
    classes = [(f, name) for f, name in classes if re.match(options.classes, name)]
    seeds = range(options.first_seed, options.first_seed + options.tests)
    jobs = [(*one, seed) for seed, one in product(seeds, classes)]
    rows = run(jobs, options.raw, options.jobs)
    # the grid of slow tests by law, rows and noise
    grid = rows["class"].str.extract(r"(?P<law>.*), (?P<n>\d+ rows), (?P<noise>.* %)")
    rows = rows.assign(**grid)
    for by in ("class", "parameter", *(name for name in grid if grid[name].notna().any())):
        table = coverage(rows.dropna(subset=by), by)
        print(table.to_string(index=False, float_format="{:.3g}".format), end="\n\n")
        if by == "class" and options.out is not None:
            studies.write_csv(table, options.out)
    print(rows.loc[rows["error"].notna(), ["class", "test", "error"]].to_string(index=False))


if __name__ == "__main__":
    main()
