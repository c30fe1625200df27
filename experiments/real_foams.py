"""Fit the measurements of others, where they lie on disk; write experiments/real_foams.md.

The measurements are not part of this repository. Give their folder:

    FOAMFIT_DATA=path/to/data python experiments/real_foams.py

It holds shoe-foam/ (running-shoe foam, cycles of compression, arXiv:2602.12694) and
cartilage-impact/ (a striker dropped on cartilage, JoVE 64450).
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import foamfit as ff

HERE = Path(__file__).parent
SHOE_FOAM = {  # diameter and height, mm
    "turbo-comp-1": (7.63, 10.53),
    "turbo-comp-2": (7.68, 9.66),
    "leap-comp-2": (7.62, 10.65),
    "leap-comp-3": (7.80, 10.68),
    "new-heel-comp-1": (7.67, 9.90),
}
CARTILAGE = """\
[specimen]
height = "0.563 mm"
diameter = "8.5 mm"
[striker]
mass = "358.39 g"
velocity = "{velocity} m/s"
"""
PAGE = """\
# Fits of measurements by others

Made by `python experiments/real_foams.py`; the data are not part of this repository.

## Running-shoe foam (measurements: arXiv:2602.12694)

First cycles in the displacement drive. Misfit: RMS of the stress over its range.

| specimen | model | misfit | descents that agree | search (s) | not determined or weak |
| --- | --- | --- | --- | --- | --- |
{foam}

## Articular cartilage under a dropped striker (measurements: JoVE 64450)

Impact drive, one bistable spring. The impulse of the force is not the striker's change of momentum:
mass, load scale and motion do not agree, and no model can fit both curves.

| test | misfit of stress-time | misfit of displacement-time | impulse over momentum | status |
| --- | --- | --- | --- | --- |
{cartilage}
"""


def foam_rows(data: Path, toml: Path) -> list[str]:
    rows = []
    for name, (diameter, height) in SHOE_FOAM.items():
        toml.write_text(f'[specimen]\nheight = "{height} mm"\ndiameter = "{diameter} mm"\n')
        test = ff.read_test(data / "shoe-foam" / f"{name}_cycle1.csv", toml)
        for model in ("bistable", "bistable+bistable"):
            result = ff.fit(test, model=model)
            doubtful = [n for n, p in result.parameters.items() if p.state not in STATES]
            rows.append(
                f"| {name} | {model} | {result.misfit['stress_strain']:.4f} "
                f"| {result.statistics['n_agreeing']} of {result.statistics['n_starts']} "
                f"| {result.runtime_s:.1f} | {', '.join(doubtful) or 'none'} |"
            )
            print(rows[-1])
    return rows


STATES = ("determined", "fixed")


def cartilage_rows(data: Path, toml: Path) -> list[str]:
    rows = []
    for name, velocity in (("test_1_impact", 0.785), ("test_3_impact", 0.905)):
        toml.write_text(CARTILAGE.format(velocity=velocity))
        result = ff.fit(ff.read_test(data / "cartilage-impact" / f"{name}.csv", toml))
        rows.append(
            f"| {name} | {result.misfit['stress_time']:.3f} "
            f"| {result.misfit['displacement_time']:.3f} "
            f"| {result.energy['impulse_ratio']:.2f} | {result.status} |"
        )
        print(rows[-1])
    return rows


def main() -> None:
    data = Path(os.environ.get("FOAMFIT_DATA", ""))
    if not (data / "shoe-foam").is_dir():
        raise SystemExit("set FOAMFIT_DATA to the folder that holds shoe-foam/")
    ff.fit(ff.read_test(HERE / "foam-1" / "model-1-2.0mps-reconstruction.csv"))  # compiles
    with tempfile.TemporaryDirectory() as folder:
        toml = Path(folder) / "specimen.toml"
        page = PAGE.format(
            foam="\n".join(foam_rows(data, toml)), cartilage="\n".join(cartilage_rows(data, toml))
        )
    (HERE / "real_foams.md").write_text(page)


if __name__ == "__main__":
    from unchanged import keep_unchanged

    with keep_unchanged(HERE):
        main()
