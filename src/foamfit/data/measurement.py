"""What was measured: the samples of a file, and the test made of them, all in SI."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array

MIN_ROWS = 10  # samples of a test

ASKED = "Check:"  # begins a note on what is probably wrong with the input

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

    It is `given` by the test, or else estimated from the data, and `how` says from what. `time` is
    its autocorrelation time, in samples (1: white).
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
    ("stress", "displacement", "displacement_1", …, and "acceleration", m/s²).
    """

    stress: float | None = None
    displacement: float | None = None
    estimated: dict[str, NoiseLevel] = field(default_factory=dict)

    def of(self, channel: str) -> NoiseLevel | None:
        """Return the noise of a channel, stated or else estimated; None where neither is known."""
        given = self.displacement if channel.startswith("displacement") else self.stress
        given = None if channel == "acceleration" else given
        if given is not None:
            return NoiseLevel(given, True, "given")
        return self.estimated.get(channel)


@dataclass(frozen=True, eq=False)
class Outliers:
    """Samples of a channel that are not fitted: spikes, short gaps, and a clipped top.

    `left_out` marks these samples, shape (n,); at spikes and gaps the channel holds a straight
    line. The file has the `values` (k,), Pa or m, `at` times (k,), s, or samples where the test has
    no time. At `clipped_at`, Pa, the sensor or its amplifier clips the channel.
    """

    left_out: NDArray[np.bool_]
    at: Array
    values: Array
    clipped_at: float | None = None


@dataclass(frozen=True)
class Standstill:
    """A stretch in which the gauge stood still before it jumped; a straight line bridges it.

    `first` and `last` are rows of the file. In them the stress changed by the share `change` of its
    largest value there; the displacement then jumped by `jump`, m.
    """

    first: int
    last: int
    change: float
    jump: float

    def among(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the rows with these numbers are in the stretch."""
        return (rows >= self.first) & (rows <= self.last)


@dataclass(frozen=True)
class Dropped:
    """Rows of a file that are not used, for one reason; rows that are used may lie between.

    `first` and `last` are lines of the file as an editor counts them, from 1 and with the header.
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


@dataclass(frozen=True)
class Window:
    """The part of a file to use: times in s as the file counts them, and which cycle."""

    start: float = -np.inf
    end: float = np.inf
    cycle: int | None = None  # the first one


@dataclass(frozen=True, eq=False)
class Record:
    """The channels of a test in SI, each of shape (n,) or None where the file lacks it.

    Time in s, stress in Pa, displacement of the top in m, velocity of the top in m/s and its
    deceleration in m/s² (like the stress that causes it, it is positive in compression). `interior`
    holds the displacement of masses inside in m, 1 for the one above spring 1. `excess` is what the
    file has beyond the straight line that bridges an outlier, 0 elsewhere, for each channel that
    has outliers. `clipped` marks the samples at which the force is clipped. `cycle` is the number
    of the cycle, where a column counts them. `numbers` holds the row number in the file of each
    sample (None: they count from 1), `dropped` the rows of the file that were left out so far, and
    `standstills` those over which the displacement is bridged, left or not. `sampled`,
    `derived` and `braked` are those of `Measurement`.
    """

    time: Array | None
    stress: Array
    displacement: Array | None
    velocity: Array | None = None
    acceleration: Array | None = None
    interior: dict[int, Array] = field(default_factory=dict)
    excess: dict[str, Array] = field(default_factory=dict)
    clipped: NDArray[np.bool_] | None = None
    cycle: Array | None = None
    numbers: NDArray[np.int64] | None = None
    dropped: tuple[Dropped, ...] = ()
    sampled: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    standstills: tuple[Standstill, ...] = ()
    derived: tuple[str, ...] = ()
    braked: bool = False

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.stress)

    @property
    def row_numbers(self) -> NDArray[np.int64]:
        """Row number in the file of each sample, shape (n,)."""
        return np.arange(1, len(self) + 1) if self.numbers is None else self.numbers

    @property
    def instants(self) -> Array:
        """Time, or the sample's number where there is none, shape (n,)."""
        return np.arange(len(self), dtype=np.float64) if self.time is None else self.time

    @property
    def stood_still(self) -> NDArray[np.bool_]:
        """Samples at which the gauge stood still, shape (n,)."""
        still = np.zeros(len(self), dtype=bool)
        for one in self.standstills:
            still |= one.among(self.row_numbers)
        return still

    def curves(self, *more: str) -> dict[str, Array]:
        """Stress, displacement, `more` and displacements inside, as far as they are there."""
        names = ("stress", "displacement", *more, *map(interior_channel, self.interior))
        found = {name: self.channel(name) for name in names}
        return {name: values for name, values in found.items() if values is not None}

    def channel(self, name: str) -> Array | None:
        """Return a channel by its name; "displacement_1" is the mass inside above spring 1."""
        node = interior_node(name)
        values: Array | None = getattr(self, name) if node is None else self.interior.get(node)
        return values

    def changed(self, name: str, values: Array) -> Record:
        """Put other values into a channel."""
        node = interior_node(name)
        if node is None:
            return replace(self, **{name: values})  # type: ignore[arg-type]
        return replace(self, interior=self.interior | {node: values})

    def rows(self, which: slice | NDArray[np.bool_]) -> Record:
        """Keep some rows of every channel; those that `without` leaves out are counted, too."""
        kept: dict[str, Any] = {}
        for item in fields(self):
            values = getattr(self, item.name)
            if isinstance(values, dict):
                kept[item.name] = {key: v[which] for key, v in values.items()}
            elif isinstance(values, np.ndarray):
                kept[item.name] = values[which]
        return replace(self, **kept)

    def without(self, gone: slice | NDArray[np.bool_], why: str) -> Record:
        """Leave out some rows of every channel, and count them with the reason."""
        numbers = self.row_numbers
        lost = numbers[gone]
        if not lost.size:
            return self
        kept = np.ones(len(self), dtype=bool)
        kept[gone] = False
        dropped = (*self.dropped, Dropped.of(lost, why))
        return replace(self, numbers=numbers, dropped=dropped).rows(kept)

    def between(self, first: int, end: int, before: str, after: str) -> Record:
        """Keep the samples from `first` up to `end`; the reasons count what lies outside."""
        return self.without(slice(end, None), after).without(slice(0, first), before)


@dataclass(frozen=True, eq=False)
class Measurement:
    """One test, conditioned and in SI: compression positive, time zero where contact starts.

    Attributes
    ----------
    name, path, data_sha256
        Name of the test, and the file that it was read from (None if from none) with the
        hexadecimal digest of its bytes.
    time : (n,) array or None
        s, increasing; None where the file has no time.
    stress, displacement : (n,) array or None
        Nominal base stress, Pa, and displacement of the top, m.
    interior : dict of int to (n,) array
        Displacement of the masses inside that a camera followed, m: 1 is the one above spring 1.
    specimen, striker
        What the TOML says; `striker` is None where nothing of it is known.
    noise : Noise
        What the TOML says of it, and what was estimated of the rest.
    motion : str or None
        Where the displacement came from: "measured", "integrated from force", …
    notes : tuple of str
        Each thing that was done to the data or could not be done, one sentence each.
    outliers : dict of str to Outliers
        Of the channels that have some.
    contact : str
        What set time zero: "stress" (then the displacement is zero there too), "motion", or "file"
        for the file's own.
    count : RowCount or None
        The rows of the file; None if the test was not read from one.
    cycle, cycles
        Number of the cycle that is used, and those of all cycles in the record, in its order.
    start_strain : float
        Strain of a later cycle, counted from the first contact, at which its own contact starts:
        what the foam had not recovered. It is taken off.
    sampled : dict of str to (n,) bool array
        Of a channel of which some samples do not count as measured: True at those that do, which
        are those at which its instrument took or renewed a value. Elsewhere it is interpolated.
    zeros : dict of str to float
        Standard error of the zero of a channel ("stress", Pa, "acceleration", m/s², and
        "displacement", m), where samples before contact show the zero.
    origins : dict of str to float
        What was taken off, in SI: "contact_time", s, "stress_zero", Pa, "acceleration_zero", m/s²,
        and "displacement_zero", m.
    acceleration : (n,) array or None
        Deceleration of the striker, m/s², where an impact has it and no displacement.
    derived : tuple of str
        Channels that were computed from others and are no measurement of their own.
    braked : bool
        Whether the stress is the striker's mass over the area times its deceleration.
    block : int
        Rows of the file that are averaged in each sample.
    uncertainties : dict of str to float
        What the TOML says is uncertain, one standard deviation each: "height" and those of the
        springs of a chain, "height_1", … (m), "area" (m²), "specimen_mass" and "striker_mass" (kg),
        "velocity" (m/s), and as a share of the scale of a channel "stress_scale",
        "displacement_scale", "acceleration_scale", "velocity_scale"; and "delay" (s) of a
        motion with its own clock: time of the force = time of the motion + delay. What it does not
        say is not there.
    standstills
        First and last time, s, of each stretch in which the gauge stood still and the displacement
        is bridged by a straight line; samples where the test has no time.
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
    cycle: int = 1
    cycles: tuple[int, ...] = (1,)
    start_strain: float = 0.0
    sampled: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    zeros: dict[str, float] = field(default_factory=dict)
    origins: dict[str, float] = field(default_factory=dict)
    acceleration: Array | None = None
    derived: tuple[str, ...] = ()
    braked: bool = False
    block: int = 1
    uncertainties: dict[str, float] = field(default_factory=dict)
    standstills: tuple[tuple[float, float], ...] = ()

    @property
    def rows(self) -> RowCount:
        """Rows of the file, used and not used; without a file all samples are used."""
        n = max((values.size for values in self.channels().values()), default=0)
        return self.count or RowCount(n, n)

    def channels(self) -> dict[str, Array]:
        """Stress, displacement, acceleration and displacements inside, as far as they are there."""
        found = {"stress": self.stress, "displacement": self.displacement}
        found["acceleration"] = self.acceleration
        found |= {interior_channel(node): values for node, values in self.interior.items()}
        return {name: values for name, values in found.items() if values is not None}
