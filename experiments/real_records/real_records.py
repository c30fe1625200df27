"""Does a fit of a real record accept what the record itself excludes?

Method. Six records of real rigs, whose law, gauge or calibration is not the model's, are fitted
with the default and the displacement drive, by a bistable spring and by a microscale spring with
one relaxation term. The judge reads the file without foamfit: where the stress leaves its rest,
where the motion is there, how far both go. It then asks of each fit: is the motion zero within 5 %
of the motion, the stress zero within 5 % of the stress, the contact not more than 10 samples before
the rise, every measured strain below 1, every misfit at most 100 %, the run time at most 60 s? Each
loop along its measured motion is also fitted by plain least squares of the same law
(`scipy.optimize.least_squares`, 25 starts, zeros as in the file).

Answer. See README.md. Sources of the measurements: cartilage JoVE 64450; lattice Radi, Glaesener,
Kumar & Kochmann; aluminium foam H. Yao, shpb-shtb-data-processor; shoe foam arXiv:2602.12694.

    FOAMFIT_DATA=path/to/data python experiments/real_records/real_records.py
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

import foamfit as ff
import studies

HERE = Path(__file__).parent
MODELS = {"bistable": 0, "microscale": 1}  # and the number of relaxation terms
DRIVES = None, "displacement"
CARTILAGE = """\
[specimen]
height = "0.563 mm"
diameter = "8.5 mm"
[striker]
mass = "358.39 g"
velocity = "0.9 m/s"
"""
LATTICE = """\
[specimen]
height = "20 mm"
area = "400 mm^2"
[striker]
mass = "1 kg"
velocity = "1.0 m/s"
[columns]
time = { column = "time_s", unit = "s" }
displacement = { column = "displacement_m", unit = "m" }
force = { column = "specific_force_N_per_kg", unit = "N" }
"""


@dataclass(frozen=True)
class Real:
    """A record: file, TOML, and the columns that the judge reads, in SI, compression positive."""

    name: str
    file: str
    toml: str
    time: str
    motion: str
    stress: str
    height: float  # m; the motion column times `per` is in m
    per: float = 1.0


RECORDS = (
    *(
        Real(
            f"cartilage {n}", f"cartilage-impact/test_{n}_impact.csv", CARTILAGE,
            "time_s", "displacement_m", "stress_Pa", 0.563e-3,
        )  # fmt: skip
        for n in (1, 3)
    ),
    Real(
        "lattice drop", "lattice-impact/Hex_Diamond_contact.csv", LATTICE,
        "time_s", "displacement_m", "specific_force_N_per_kg", 20e-3,
    ),
    Real(
        "aluminium foam", "aluminium-foam/stress_strain_rate.csv",
        '[specimen]\nheight = "15 mm"\ndiameter = "30 mm"\n[columns]\n'
        'strain = { column = "reference_engineering_strain" }\n'
        'stress = { column = "reference_engineering_stress_MPa", unit = "MPa" }\n',
        "time_s", "reference_engineering_strain", "reference_engineering_stress_MPa", 15e-3, 15e-3,
    ),
    Real(
        "shoe foam turbo-comp-2", "shoe-foam/turbo-comp-2_cycle1.csv",
        '[specimen]\nheight = "9.66 mm"\ndiameter = "7.68 mm"\n',
        "time_s", "displacement_m", "stress_Pa", 9.66e-3,
    ),
    Real(
        "shoe foam leap-comp-3", "shoe-foam/leap-comp-3_cycle1.csv",
        '[specimen]\nheight = "10.68 mm"\ndiameter = "7.80 mm"\n',
        "time_s", "displacement_m", "stress_Pa", 10.68e-3,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Judged:
    """What the file says without foamfit: the rise of the stress, motion and stress there."""

    rise: float  # s
    step: float  # s
    motion: float  # m, at the rise
    travel: float  # m, from there to the largest motion
    rest: float  # stress before the rise, in the unit of the file
    peak: float  # above that

    @classmethod
    def of(cls, real: Real, data: Path) -> Judged:
        """Find the rise: the first of five samples over 1 % of the peak and over the rest's noise.

        It is followed back to where the stress last was at the rest's level.
        """
        table = pd.read_csv(data / real.file)
        t, w, s = (table[c].to_numpy(float) for c in (real.time, real.motion, real.stress))
        top = int(np.argmax(np.where(np.isfinite(s), s, -np.inf)))
        lowest = s[: max(5, int(0.02 * top))]
        rest = float(np.median(lowest)) if top > 40 else float(s[0])
        spread = 1.4826 * float(np.median(np.abs(lowest - rest)))
        above = s - rest > max(0.01 * (s[top] - rest), 5.0 * spread)
        first = next(i for i in range(top) if above[i : i + 5].all())
        motion = float(w[first]) * real.per
        travel = float(np.nanmax(w)) * real.per - motion
        return cls(float(t[first]), float(np.median(np.diff(t))), motion, travel, rest, s[top] - rest)


def excluded(result: ff.FitResult, record: Judged, height: float, unit: float) -> Iterator[str]:
    """Yield what the record excludes; `unit` is Pa per unit of its stress."""
    zeros = {name: item.value for name, item in result.parameters.items()}
    motion = zeros.get("displacement_zero")
    if motion is not None and abs(motion - record.motion) > 0.05 * record.travel:
        yield f"motion zero {100 * (motion - record.motion) / record.travel:+.0f} % of the motion"
    stress = zeros.get("stress_zero")
    if stress is not None and abs(stress / unit - record.rest) > 0.05 * record.peak:
        yield f"stress zero {100 * (stress / unit - record.rest) / record.peak:+.0f} % of the peak"
    contact = zeros.get("contact_time")
    if contact is not None and contact < record.rise - 10.0 * record.step:
        yield f"contact {(record.rise - contact) / record.step:.0f} samples before the rise"
    largest = (record.motion + record.travel - (motion or 0.0)) / height
    if motion is not None and largest >= 1.0:
        yield f"measured strain {largest:.2f}"
    for name, misfit in result.misfit.items():
        if misfit is not None and misfit > 1.0:
            yield f"misfit of {name} {100 * misfit:.0f} %"


def fitted(real: Real, data: Path, folder: Path) -> Iterator[dict[str, object]]:
    """Yield one row for each fit of a record."""
    toml = folder / f"{Path(real.file).stem}.toml"
    toml.write_text(real.toml)
    record = Judged.of(real, data)
    test = ff.read_test(data / real.file, toml)
    area = test.specimen.area
    unit = {"stress_Pa": 1.0, "specific_force_N_per_kg": 1.0 / area}.get(real.stress, 1e6)
    for drive in DRIVES:
        for model, terms in MODELS.items():
            began = time.perf_counter()
            try:
                result = ff.fit(test, model=model, relaxation=terms, drive=drive, seed=0)
            except (ff.InputError, ff.SimulationError) as error:
                yield {"record": real.name, "model": model, "drive": drive or "default", "excluded": f"refused: {error}"}
                continue
            took = time.perf_counter() - began
            wrong = list(excluded(result, record, real.height, unit))
            wrong += [f"{took:.0f} s"] if took > 60 else []
            states = [p.state for n, p in result.parameters.items() if n.startswith("s1") and p.vary]
            yield {
                "record": real.name, "model": model, "drive": f"{drive or 'default'}: {result.drive}",
                **{n: None if m is None else 100 * m for n, m in result.misfit.items()},
                "determined": f"{states.count('determined')} of {len(states)}",
                "status": result.status, "seconds": took, "excluded": "; ".join(wrong) or "nothing",
                "zeros": {n: result.parameters[n].value for n in ("contact_time", "displacement_zero", "stress_zero") if n in result.parameters},
                "values": {n: p.value for n, p in result.parameters.items() if n.startswith("s1") and p.vary},
            }  # fmt: skip


def main() -> None:
    """Fit all records and write table and page."""
    parser = studies.arguments(__doc__, HERE)
    args = parser.parse_args()
    data = studies.measurements("cartilage-impact", "lattice-impact", "aluminium-foam", "shoe-foam")
    rows = []
    with tempfile.TemporaryDirectory() as made:
        for real in RECORDS:
            for row in fitted(real, data, Path(made)):
                rows.append(row)
                print(row, flush=True)


if __name__ == "__main__":
    main()
