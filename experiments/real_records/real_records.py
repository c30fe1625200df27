"""Does a fit of a real record accept what the record itself excludes?

Method and answer: README.md. Also written: loops.csv and halves.csv.

    FOAMFIT_DATA=… python experiments/real_records/real_records.py   # minutes; --page: table alone
"""

import math
import shutil
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

import foamfit as ff

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies
from studies import Array

HERE = Path(__file__).parent

# Laws by their names in the tables: model and number of relaxation terms.
LAWS = {"bistable": ("bistable", 0), "microscale, relaxation": ("microscale", 1)}
# Values of a law in plain least squares: units (stiffness, stress, strain, time, none) and bounds.
BOX = {  # k0, kc, −Δσ/σ_a, ε_a, ε_c − ε_a, k_h+, k_h−; k0, kc, ε_* beyond the least, snaps, g, τ
    "bistable": ("kk1eekk", (0.03, 0.03, 1e-4, 0.02, 5e-3, 0.01, 1e-4),
                 (30, 300, 0.999, 0.9, 0.8, 30, 30)),
    "microscale": ("kk1s1s11t", (0.03, 0.01, 1e-3, 0.02, 0.05, 2e-3, 0.05, 0.01, 1e-3),
                   (300, 100, 0.6, 3, 3, 1.5, 3, 5, 1)),
}  # fmt: skip
STARTS = 25
SECONDS = 60.0


class Real(NamedTuple):
    """A record: height (m), and its columns of motion and stress with their units."""

    name: str
    height: float
    motion: tuple[str, float] = ("displacement_m", 1.0)  # m per unit
    stress: tuple[str, float] = ("stress_Pa", 1.0)  # Pa per unit


RECORDS = (
    Real("cartilage 1", 0.563e-3),
    Real("cartilage 3", 0.563e-3),
    Real("lattice drop", 20e-3, stress=("specific_force_N_per_kg", 1.0 / 400e-6)),
    Real("aluminium foam", 15e-3, ("reference_engineering_strain", 15e-3),
         ("reference_engineering_stress_MPa", 1e6)),
    Real("turbo-comp-2", 9.66e-3),
    Real("leap-comp-3", 10.68e-3),
)  # fmt: skip


class Judge(NamedTuple):
    """What a file says without foamfit, in SI."""

    rise: float  # s, time at which the stress leaves 1 % of its peak for good
    step: float  # s
    motion: float  # m, range
    highest: float  # m
    rest: float  # Pa, stress at the start
    peak: float  # Pa, above that

    @classmethod
    def of(cls, real: Real, path: Path) -> Self:
        """Read a file."""
        table = pd.read_csv(path)
        instants = table["time_s"].to_numpy(float)
        moved = table[real.motion[0]].to_numpy(float) * real.motion[1]
        stress = table[real.stress[0]].to_numpy(float) * real.stress[1]
        top = int(np.argmax(stress))
        rest = float(np.median(stress[: max(1, top // 10)]))
        peak = float(stress[top]) - rest
        rise = int(np.flatnonzero(stress[:top] - rest < 0.01 * peak)[-1]) + 1
        gap = float(np.median(np.diff(instants)))
        return cls(float(instants[rise]), gap, float(np.ptp(moved)), float(moved.max()), rest, peak)

    def excluded(self, result: ff.FitResult, height: float) -> Iterator[str]:
        """Yield what a fit accepts although the record excludes it."""
        found = {name: item.value for name, item in result.parameters.items()}
        motion, stress = found.get("displacement_zero"), found.get("stress_zero", self.rest)
        if motion is not None and abs(motion) > 0.05 * self.motion:
            yield f"motion zero {100.0 * motion / self.motion:+.0f} % of the motion"
        if motion is not None and (strain := (self.highest - motion) / height) >= 1.0:
            yield f"measured strain {strain:.2f}"
        if abs(stress - self.rest) > 0.05 * self.peak:
            share = (stress - self.rest) / self.peak
            yield f"stress zero {100.0 * share:+.0f} % of the stress"
        early = (self.rise - found.get("contact_time", self.rise)) / self.step
        if early > 10.0:
            yield f"contact {early:.0f} samples early"
        for name, misfit in result.misfit.items():
            if misfit is not None and not misfit <= 1.0:
                yield f"misfit of {name} {100.0 * misfit:.0f} %"


def stress_of(model: str, values: Array, strain: Array, instants: Array) -> Array:
    """Return the stress of a law; values as in `BOX`."""
    k0, kc, third, *rest = values
    if model == "bistable":
        eps_a, more, plus, minus = rest
        dsigma = -third * k0 * eps_a / (1.0 - eps_a)
        spring = ff.BistableSpring(k0, kc, dsigma, eps_a, eps_a + more, plus, minus)
        return np.asarray(spring.stress(strain))
    *snap, g, tau = rest
    least = max(0.0, (math.sqrt(kc) - math.sqrt(k0)) / (math.sqrt(kc) + math.sqrt(k0)))
    relaxing = ff.MicroscaleSpring(k0, kc, least + third, *snap, relaxation=[(g, tau)])
    drive = ff.DisplacementDrive(strain)
    return np.asarray(ff.simulate(ff.Chain([relaxing], [1.0], 1.0), drive, instants).base_stress)


def plain_misfit(test: ff.Measurement, model: str, zero: float, *, starts: int = STARTS) -> float:
    """Return the misfit of plain least squares from random starts: RMS over range of the stress."""
    strain = test.displacement / test.specimen.height - zero
    strain = np.maximum(strain, 0.0) if test.contact != "file" else strain
    instants = np.arange(strain.size, dtype=float) if test.time is None else test.time
    kept = test.sampled.get("stress", np.ones(strain.size, bool))
    if "stress" in test.outliers:
        kept = kept & ~test.outliers["stress"].left_out
    size, most, span = float(test.stress.max()), float(strain.max()), float(np.ptp(test.stress))
    units = {"k": size / most, "s": size, "e": most, "t": float(np.ptp(instants)), "1": 1.0}
    kinds, *ends = BOX[model]
    low, high = np.log(np.array(ends) * [units[kind] for kind in kinds])

    def residual(point: Array) -> Array:
        try:
            return (stress_of(model, np.exp(point), strain, instants) - test.stress)[kept] / span
        except (ValueError, ff.SimulationError):
            return np.full(int(kept.sum()), 10.0)

    rng, best = np.random.default_rng(1), math.inf
    for _ in range(starts):
        points = rng.uniform(low, high, (40, low.size))
        start = min(points, key=lambda one: float(np.sum(residual(one) ** 2)))
        found = least_squares(residual, start, bounds=(low, high), max_nfev=100)
        best = min(best, float(np.sqrt(2.0 * found.cost / kept.sum())))
    return best


def compared(folder: Path) -> Iterator[dict[str, object]]:
    """Yield one row for each record and law: what the fit excludes, and plain least squares."""
    mycelium = (f"outplane-{period}-1" for period in ("2s", "4s", "80s"))
    known = {real.name: real for real in RECORDS}
    others = (*records.SHOE_FOAM, *records.HEELS, *mycelium, *records.LATTICES)
    for name in dict.fromkeys((*known, *others)):
        path, real = records.place(name, folder), known.get(name)
        test, judge = ff.read_test(path), Judge.of(real, path) if real else None
        for law, (model, terms) in LAWS.items():
            result, seconds = studies.timed(ff.fit, test, model=model, relaxation=terms)
            assert result.drive == "displacement"
            wrong = list(judge.excluded(result, real.height)) if judge else ["not judged"]
            wrong += [f"{seconds:.0f} s"] if seconds > SECONDS else []
            zero = result.parameters.get("displacement_zero")
            moved = (zero.value - test.origins.get("displacement_zero", 0.0)) if zero else 0.0
            other = plain_misfit(test, model, moved / test.specimen.height)
            own = result.misfit["stress_strain"] or 0.0
            found = result.parameters.items()
            states = [p.state for n, p in found if n.startswith("s1_")]
            yield {
                "record": name, "law": law, "fit (%)": 100.0 * own,
                "plain (%)": 100.0 * other, "fit over plain": own / other,
                "determined": states.count("determined"),
                "held by the record": ", ".join(n for n, p in found if "record shows" in p.why),
                "seconds": seconds, "excluded": "; ".join(wrong) or "nothing",
            }  # fmt: skip


def halves(folder: Path) -> Iterator[dict[str, object]]:
    """Yield whether each value of one half of the rows lies in the range of the other half."""
    more = LAWS | {"two bistable": ("bistable+bistable", 0)}
    for name, (law, (model, terms)) in product(records.SHOE_FOAM, more.items()):
        path, fits = records.place(name, folder), list[ff.FitResult]()
        for i in range(2):
            half = folder / f"half-{i}.csv"
            pd.read_csv(path)[i::2].to_csv(half, index=False)
            shutil.copy(path.with_suffix(".toml"), half.with_suffix(".toml"))
            fits.append(ff.fit(ff.read_test(half), model=model, relaxation=terms))
        for one, other in (fits, fits[::-1]):
            for key, item in one.parameters.items():
                if key.startswith("s") and item.range and other.parameters[key].vary:
                    inside = item.range[0] <= other.parameters[key].value <= item.range[1]
                    yield {"record": name, "law": law, "state": item.state, "inside": inside}


def main() -> None:
    """Fit all records and write tables and page."""
    args = studies.arguments(__doc__, HERE, page=True).parse_args()
    if not args.page:
        studies.measurements("cartilage-impact", "lattice-impact", "aluminium-foam", "shoe-foam")
        with studies.workplace() as made:
            studies.write_csv(studies.said(compared(made)), args.out / "loops.csv")
            studies.write_csv(halves(made), args.out / "halves.csv")
    table, held = (pd.read_csv(args.out / name) for name in ("loops.csv", "halves.csv"))
    judged, worst = table[table["excluded"] != "not judged"], table["fit over plain"].idxmax()
    studies.write_page(
        HERE, args.out, loops=studies.shown(table),
        halves=studies.shown(held.groupby(["law", "state"], as_index=False).agg(
            **{"inside": ("inside", "sum"), "of": ("inside", "size")})),
        number=len(table), count=len(judged), wrong=int((judged["excluded"] != "nothing").sum()),
        worst="{fit over plain:.3f} ({record}, {law})".format(**table.loc[worst]),
    )  # fmt: skip


if __name__ == "__main__":
    main()
