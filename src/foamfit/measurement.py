"""What was measured: the channels of one test in SI, its specimen and its striker."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def interior_channel(node: int) -> str:
    """Name of the channel that holds the displacement of an interior mass, 1 above the base."""
    return f"displacement_{node}"


def interior_node(channel: str) -> int | None:
    """Interior mass that a channel belongs to, None for any other channel."""
    match = re.fullmatch(r"displacement_([1-9]\d{0,3})", channel, re.ASCII)
    return int(match[1]) if match else None


@dataclass(frozen=True)
class Specimen:
    """The foam specimen.

    Attributes
    ----------
    height : float
        Height H before the test, m.
    area : float
        Cross-section A, m².
    mass : float or None
        Mass of the foam, kg.
    heights : tuple of float or None
        Heights h_i of the springs of a chain, base first, m.
    """

    height: float
    area: float
    mass: float | None = None
    heights: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Striker:
    """The striker: mass in kg and velocity at contact in m/s (either may be unknown)."""

    mass: float | None = None
    velocity: float | None = None


@dataclass(frozen=True)
class Noise:
    """One standard deviation of the noise of a channel: stress in Pa, displacement in m."""

    stress: float | None = None
    displacement: float | None = None


@dataclass(frozen=True, eq=False)
class Measurement:
    """One test, conditioned and in SI: compression positive, time zero where contact starts.

    Attributes
    ----------
    name : str
        Name of the test.
    path : Path or None
        The file that it was read from.
    data_sha256 : str
        Digest of that file's bytes, hexadecimal ("" if it was not read from a file).
    time : (n,) array or None
        s, increasing; None where the file has no time.
    stress : (n,) array or None
        Nominal base stress, Pa.
    displacement : (n,) array or None
        Displacement of the top, m.
    interior : dict of int to (n,) array
        Displacement of the masses inside that a camera followed, m: 1 is the one above spring 1.
    specimen, striker, noise
        What the TOML says; `striker` is None where nothing of it is known.
    motion : str or None
        Where the displacement came from: "measured", "integrated from force", …
    notes : tuple of str
        Each thing that the loader did to the data or could not do, one sentence each.
    """

    name: str
    path: Path | None
    data_sha256: str
    time: Array | None
    stress: Array | None
    displacement: Array | None
    specimen: Specimen
    striker: Striker | None = None
    noise: Noise = field(default_factory=Noise)
    motion: str | None = None
    notes: tuple[str, ...] = ()
    interior: dict[int, Array] = field(default_factory=dict)
