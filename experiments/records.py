"""Measurements of others, by name: file, specimen and columns of each record.

They are not part of this repository: FOAMFIT_DATA is their folder. `place` links a record into a
folder and writes its TOML beside it, as a user keeps it. Foams whose records have several cycles
are read with `cycle` or `cycles`; "turbo-comp-1 cycles" are those of turbo-comp-1.
"""

from collections.abc import Iterator
from pathlib import Path

import pandas as pd

import foamfit as ff
import studies

SOURCE = "arXiv:2602.12694 (LivingMatterLab/CANN)"  # of the shoe foams
SHOE_FOAM = {  # height and diameter (mm) of specimens whose first cycle is a file of its own
    "turbo-comp-1": ("10.53", "7.63"),
    "turbo-comp-2": ("9.66", "7.68"),
    "leap-comp-2": ("10.65", "7.62"),
    "leap-comp-3": ("10.68", "7.80"),
}
HEELS = tuple(f"{age}-heel-comp-{i}" for age in ("new", "worn") for i in range(1, 6))
LATTICES = ("tpu87-20", "tpu87-35", "tpu87-50")
SPECIMEN = '[specimen]\nheight = "{} mm"\ndiameter = "{} mm"\n'
GAP = '[columns]\ndisplacement = { column = "Gap (um)", counts_down = true }\n'
LATTICE = """\
[columns]
time = { column = "Total Time (s)" }
displacement = { column = "Position(Linear:Position) (mm)", counts_down = true }
force = { column = "Force(Linear:Load) (kN)", scale = -1 }
cycle = { column = "Total Cycles" }
"""
LATTICE_DROP = """\
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
ALUMINIUM = """\
[columns]
strain = { column = "reference_engineering_strain" }
stress = { column = "reference_engineering_stress_MPa", unit = "MPa" }
"""
STRIKER = '[striker]\nmass = "358.39 g"\nvelocity = "0.9 m/s"\n'


def described(name: str, data: Path) -> tuple[str, str]:
    """Return the file of a record below a folder, and its TOML."""
    family, _, number = name.partition(" ")
    if family == "cartilage":
        return f"cartilage-impact/test_{number}_impact.csv", SPECIMEN.format(0.563, 8.5) + STRIKER
    if name == "lattice drop":
        return "lattice-impact/Hex_Diamond_contact.csv", LATTICE_DROP
    if name == "aluminium foam":
        return "aluminium-foam/stress_strain_rate.csv", SPECIMEN.format(15, 30) + ALUMINIUM
    if name in LATTICES:
        return f"lattice-cycles/{name}_raw.csv", SPECIMEN.format(12, 20) + LATTICE
    if name in SHOE_FOAM:
        return f"shoe-foam/{name}_cycle1.csv", SPECIMEN.format(*SHOE_FOAM[name])
    if family in SHOE_FOAM:
        return f"shoe-foam/{family}_raw.txt", SPECIMEN.format(*SHOE_FOAM[family]) + GAP
    if name in HEELS:
        row = pd.read_csv(data / "shoe-foam-twins/specimens.csv", dtype=str, index_col=0).loc[name]
        text = SPECIMEN.format(row["height_mm"], row["diameter_mm"])
        return f"shoe-foam-twins/{name}_raw.txt", text + GAP
    file = f"mycelium-rates/{name}_raw.txt"
    height = float((data / file).read_text(encoding="utf-8").splitlines()[1].split("\t")[5]) / 1e3
    return file, SPECIMEN.format(height, 8) + GAP


def place(name: str, folder: Path, data: Path | None = None) -> Path:
    """Link a record into a folder, with its TOML beside it; return the path of the link."""
    data = data or studies.measurements()
    file, toml = described(name, data)
    path = folder / Path(file).name
    if not path.exists():
        path.symlink_to((data / file).resolve())
    path.with_suffix(".toml").write_text(f'name = "{name}"\n{toml}', encoding="utf-8")
    return path


def first_cycles(folder: Path) -> Iterator[ff.Measurement]:
    """Yield the first cycle of every shoe foam."""
    for name in (*SHOE_FOAM, *HEELS):
        yield ff.read_test(place(name, folder))
