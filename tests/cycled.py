"""A synthetic record of several cycles."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import foamfit as ff
from conftest import write_csv

HEIGHT, AREA = 10e-3, 1e-4
FRESH = ff.BistableSpring(
    k0=5.5e6, kc=20e6, dsigma=-0.3e6, eps_a=0.14, eps_c=0.27, kh_plus=2e6, kh_minus=2.2e6
)
# Only the onset of snapping and the strain at the start change from cycle to cycle.
ONSETS, SETS = (0.14, 0.11, 0.10), (0.0, 0.02, 0.03)


def write_record(folder: Path) -> Path:
    """Write a record of three cycles on a foam that starts to snap earlier in each cycle."""
    springs = [replace(FRESH, eps_a=onset) for onset in ONSETS]
    strain, stress = [], []
    for spring, gone in zip(springs, SETS, strict=True):
        up = np.linspace(0.0, 0.38, 150)
        one = np.concatenate([up, up[::-1][1:-1]])
        strain.append(one)
        along = np.maximum(one - gone, 0.0)
        pressed = spring.stress(along)
        stress.append(np.where(one > gone, np.maximum(pressed, 0.0), 0.0))
    strain, stress = (np.concatenate([*parts, [0.0]]) for parts in (strain, stress))
    stress = stress + 500.0 * np.random.default_rng(0).standard_normal(stress.size)
    columns = 0.01 * np.arange(strain.size), 1e-6 * stress, 1e3 * HEIGHT * strain
    path, head = folder / "synthetic.csv", "time (s),stress (MPa),displacement (mm)"
    toml = f'[specimen]\nheight = "{1e3 * HEIGHT} mm"\narea = "{1e6 * AREA} mm^2"\n'
    return write_csv(path, head, *columns, fmt="%.6f", toml=toml)
