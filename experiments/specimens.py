"""The TOML of a specimen whose machine records the gap between its plates, as several studies have.

The compressions of others that these studies fit (LivingMatterLab/CANN) are all of that kind.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

GAP = 'displacement = { column = "Gap (um)", counts_down = true }'


def write_specimen(path: Path, height: str, diameter: str, columns: str = GAP) -> Path:
    """Write the TOML of a cylinder, with what its columns are; returns its path."""
    path.write_text(
        f'[specimen]\nheight = "{height}"\ndiameter = "{diameter}"\n[columns]\n{columns}\n',
        encoding="utf-8",
    )
    return path


def twins(data: Path) -> Iterator[tuple[str, str, str]]:
    """Name, height and diameter of each specimen of shoe-foam-twins/."""
    with (data / "specimens.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            yield row["test"], f"{row['height_mm']} mm", f"{row['diameter_mm']} mm"
