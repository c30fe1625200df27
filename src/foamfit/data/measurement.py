"""What was measured: the channels of one test in SI, its specimen and its striker."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Where a motion comes from; the second is no measurement of its own.
MEASURED, INTEGRATED = "measured", "integrated from force"


def interior_channel(node: int) -> str:
    """Name of the channel that holds the displacement of an interior mass, 1 above the base."""
    return f"displacement_{node}"


def interior_node(channel: str) -> int | None:
    """Interior mass that a channel belongs to, None for any other channel."""
    match = re.fullmatch(r"displacement_([1-9]\d{0,3})", channel, re.ASCII)
    return int(match[1]) if match else None


@dataclass(frozen=True)
class Specimen:
    """The foam specimen: height before the test (m), cross-section (m²), mass (kg).

    `heights` are those of the springs of a chain, base first, m.
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
class NoiseLevel:
    """The noise of one channel: one standard deviation, Pa or m.

    It is `given` by the test, or else estimated from the data; `how` says so ("estimated from 40
    samples before contact"). `time` is its autocorrelation time, in samples (1: white).
    """

    sigma: float
    given: bool
    how: str
    time: float = 1.0


@dataclass(frozen=True)
class Noise:
    """The noise of the channels, each one standard deviation, Pa or m.

    `stress` and `displacement` are what the TOML states; the second holds for masses inside too.
    `estimated` holds what was estimated from the data of the channels that it does not state
    ("stress", "displacement", "displacement_1", …).
    """

    stress: float | None = None
    displacement: float | None = None
    estimated: dict[str, NoiseLevel] = field(default_factory=dict)

    def of(self, channel: str) -> NoiseLevel | None:
        """Return the noise of a channel, stated or else estimated; None where neither is known."""
        given = self.displacement if channel.startswith("displacement") else self.stress
        if given is not None:
            return NoiseLevel(given, True, "given")
        return self.estimated.get(channel)


@dataclass(frozen=True, eq=False)
class Outliers:
    """Samples of a channel that are not fitted: spikes, short gaps, and a clipped top.

    `left_out` marks these samples, shape (n,); at spikes and gaps the channel holds a straight
    line. What the file has there is `values` (k,), Pa or m, `at` (k,) times in s, or samples where
    the test has no time. `clipped_at` is the value at which the sensor or its amplifier clips the
    channel, Pa.
    """

    left_out: NDArray[np.bool_]
    at: Array
    values: Array
    clipped_at: float | None = None


@dataclass(frozen=True)
class Dropped:
    """Rows of a file that are not used, for one reason, which follows "not used: ".

    `first` and `last` are lines of the file as an editor counts them, from 1 and with the header.
    Rows that are used may lie between.
    """

    rows: int
    first: int
    last: int
    why: str

    @classmethod
    def of(cls, rows: NDArray[np.int64], why: str) -> Dropped:
        """Leave out the rows with these numbers."""
        return cls(rows.size, int(rows[0]), int(rows[-1]), why)

    def __str__(self) -> str:
        """Return for example "rows 2 to 200 (199): before contact starts"."""
        if self.rows == 1:
            return f"row {self.first}: {self.why}"
        part = "" if self.rows == self.last - self.first + 1 else "of "
        return f"{part}rows {self.first} to {self.last} ({self.rows}): {self.why}"


@dataclass(frozen=True)
class RowCount:
    """How many rows of numbers a file has, how many of them are used, and why not the others.

    `rows` is `used` plus the rows of all `dropped`. A row is used if each channel that was read
    from it is fitted or integrated as it stands, or is averaged with its neighbours.
    """

    rows: int
    used: int
    dropped: tuple[Dropped, ...] = ()

    def sentences(self) -> list[str]:
        """Say how many rows there are, and name those that are not used."""
        told = f"{self.rows} in the file, {self.used} used."
        return [told, *(f"Not used: {item}." for item in self.dropped)]


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
    specimen, striker
        What the TOML says; `striker` is None where nothing of it is known.
    noise : Noise
        What the TOML says of it, and what was estimated of the rest.
    motion : str or None
        Where the displacement came from: "measured", "integrated from force", …
    notes : tuple of str
        Each thing that the loader did to the data or could not do, one sentence each.
    outliers : dict of str to Outliers
        Of the channels that have some.
    contact : str
        What set time zero: "stress" (then the displacement is zero there too), "motion", or "file"
        for the file's own.
    count : RowCount or None
        The rows of the file; None if the test was not read from one.
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
    outliers: dict[str, Outliers] = field(default_factory=dict)
    contact: str = "file"
    count: RowCount | None = None

    @property
    def rows(self) -> RowCount:
        """Rows of the file, used and not used; without a file all samples are used."""
        if self.count is not None:
            return self.count
        n = max((values.size for values in self.channels().values()), default=0)
        return RowCount(n, n)

    def channels(self) -> dict[str, Array]:
        """Stress, displacement and displacements of masses inside, as far as they are there."""
        found = {"stress": self.stress, "displacement": self.displacement}
        found |= {interior_channel(node): values for node, values in self.interior.items()}
        return {name: values for name, values in found.items() if values is not None}
