"""What was measured: the samples of a file, and the test made of them, all in SI."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array, Integers, Mask
from foamfit.text import engineering

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
    """Height before the test, m, cross-section, m², mass, kg; heights of springs, base first."""

    height: float
    area: float
    mass: float | None = None
    heights: tuple[float, ...] | None = None


GRAVITY = 9.80665  # standard gravity, m/s²


@dataclass(frozen=True)
class Striker:
    """Mass, kg, and velocity at contact, m/s, of the striker; either may be unknown.

    `gravity`, m/s², accelerates it; None: as its flight before contact shows.
    """

    mass: float | None = None
    velocity: float | None = None
    gravity: float | None = None


@dataclass(frozen=True)
class NoiseLevel:
    """Standard deviation of the noise of a channel, Pa or m, `given` or estimated (`how`).

    `time` is its autocorrelation time, in samples (1: white).
    """

    sigma: float
    given: bool
    how: str
    time: float = 1.0


@dataclass(frozen=True)
class Noise:
    """Noise that the TOML states, one standard deviation each, Pa and m, or else estimated.

    The displacement's holds for masses inside, too.
    """

    stress: float | None = None
    displacement: float | None = None
    estimated: dict[str, NoiseLevel] = field(default_factory=dict)

    def of(self, channel: str) -> NoiseLevel | None:
        """Return the noise of a channel, stated or else estimated; None if neither is known."""
        stated = {"stress": self.stress, "acceleration": None}
        given = stated.get(channel, self.displacement)
        return self.estimated.get(channel) if given is None else NoiseLevel(given, True, "given")


@dataclass(frozen=True, eq=False)
class Outliers:
    """Samples of a channel that are `left_out` of the fit (n,): spikes, short gaps, a clipped top.

    Spikes and gaps are bridged by a straight line; the file has the `values` (k,), Pa or m, `at`
    times (k,), s, or samples. The force is clipped at `clipped_at`, Pa.
    """

    left_out: Mask
    at: Array
    values: Array
    clipped_at: float | None = None


@dataclass(frozen=True)
class Dropped:
    """Number of rows not used for one reason, the `first` and the `last` (lines of the file)."""

    rows: int
    first: int
    last: int
    why: str

    @classmethod
    def of(cls, rows: Integers, why: str) -> Dropped:
        """Count the rows with these numbers."""
        return cls(rows.size, int(rows[0]), int(rows[-1]), why)

    def __str__(self) -> str:
        """Return for example "rows 2 to 200 (199): before contact starts"."""
        if self.rows == 1:
            return f"row {self.first}: {self.why}"
        part = "" if self.rows == self.last - self.first + 1 else "of "
        return f"{part}rows {self.first} to {self.last} ({self.rows}): {self.why}"


@dataclass(frozen=True)
class RowCount:
    """Rows of numbers in a file: all, used and dropped, with the reasons.

    A row is used if each of its channels is fitted or integrated, as it stands or averaged.
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
    last: int | None = None  # of several that are one history; by default none but `cycle`


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """What a `Record` and the `Measurement` made of it both hold; see there."""

    interior: dict[int, Array] = field(default_factory=dict)
    sampled: dict[str, Mask] = field(default_factory=dict)
    zeros: dict[str, float] = field(default_factory=dict)
    origins: dict[str, float] = field(default_factory=dict)
    derived: tuple[str, ...] = ()
    braked: bool = False
    notes: tuple[str, ...] = ()

    def curves(self, *more: str) -> dict[str, Array]:
        """Stress, displacement, `more` and displacements inside, as far as they are there."""
        names = ("stress", "displacement", *more)
        found = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return found | {interior_channel(node): values for node, values in self.interior.items()}


@dataclass(frozen=True, eq=False)
class Record(Samples):
    """The channels of a test in SI, each of shape (n,) or None where the file lacks it.

    Time, s, stress, Pa, displacement, m, velocity, m/s, and deceleration of the top, m/s² (positive
    in compression). `excess` is what the file has beyond the straight line that bridges outliers, 0
    elsewhere; `clipped` marks samples of a clipped force; `standstills` those in which the gauge
    stood still, each with the sentence on it. `cycle` is what a column of cycle numbers says,
    `numbers` are the rows in the file (None: from 1).
    """

    time: Array | None
    stress: Array
    displacement: Array | None
    velocity: Array | None = None
    acceleration: Array | None = None
    excess: dict[str, Array] = field(default_factory=dict)
    clipped: Mask | None = None
    cycle: Array | None = None
    numbers: Integers | None = None
    dropped: tuple[Dropped, ...] = ()
    standstills: dict[str, Mask] = field(default_factory=dict)
    motion: str = MEASURED

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.stress)

    @property
    def row_numbers(self) -> Integers:
        """Row number in the file of each sample, shape (n,)."""
        return np.arange(1, len(self) + 1) if self.numbers is None else self.numbers

    @property
    def instants(self) -> Array:
        """Time, or the sample's number where there is none, shape (n,)."""
        return np.arange(len(self), dtype=np.float64) if self.time is None else self.time

    @property
    def stood_still(self) -> Mask:
        """Samples at which the gauge stood still, shape (n,)."""
        none = np.zeros(len(self), dtype=bool)
        still: Mask = np.logical_or.reduce([none, *self.standstills.values()])
        return still

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

    def shifted(self, name: str, by: float) -> Record:
        """Take a value off the time or another channel; `origins` say how much was taken off."""
        values = self.channel(name)
        assert values is not None  # its values have shown what is to be taken off
        key = "contact_time" if name == "time" else f"{name}_zero"
        origins = self.origins | {key: self.origins.get(key, 0.0) + by}
        return replace(self.changed(name, values - by), origins=origins)

    def interpolated(self, name: str, values: Array, taken: Any) -> Record:
        """Put values into a channel of which only the samples `taken` count as measured."""
        counts = np.zeros(len(self), dtype=bool)
        counts[taken] = True
        return replace(self.changed(name, values), sampled=self.sampled | {name: counts})

    def noted(self, *notes: str) -> Record:
        """Add sentences to what was done."""
        return replace(self, notes=(*self.notes, *notes))

    def rows(self, which: slice | Mask) -> Record:
        """Keep some rows of every channel; those that `without` leaves out are counted, too."""

        def part(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: part(one) for key, one in value.items()}
            return value[which] if isinstance(value, np.ndarray) else value

        return replace(self, **{item.name: part(getattr(self, item.name)) for item in fields(self)})

    def without(self, gone: slice | Mask, why: str) -> Record:
        """Leave out some rows of every channel, and count them with the reason."""
        numbers, kept = self.row_numbers, np.ones(len(self), dtype=bool)
        kept[gone] = False
        if kept.all():
            return self
        dropped = (*self.dropped, Dropped.of(numbers[~kept], why))
        return replace(self, numbers=numbers, dropped=dropped).rows(kept)

    def between(self, first: int, end: int, before: str, after: str) -> Record:
        """Keep the samples from `first` up to `end`; the reasons count what lies outside."""
        return self.without(slice(end, None), after).without(slice(0, first), before)


@dataclass(frozen=True, eq=False)
class Measurement(Samples):
    """One test, conditioned and in SI: compression positive, time zero where contact starts.

    Attributes
    ----------
    name, path, data_sha256
        Its name, its file (None if from none) and the digest of that.
    time, stress, displacement, acceleration : (n,) array or None
        s, increasing; nominal base stress, Pa; displacement of the top, m; deceleration of the
        striker, m/s², where an impact has it and no displacement.
    specimen, striker, noise
        What the TOML says, and the noise that was estimated.
    motion
        Where the displacement came from: "measured", "integrated from force", …
    notes
        A sentence for each thing that was done or could not be done.
    interior
        Displacements of the masses inside, m: 1 is the one above spring 1.
    outliers, sampled
        By channel: samples left out, and those that count as measured, where not all do; others
        are interpolated.
    contact
        What set time zero: "stress" (then the displacement is zero there too), "motion" or "file".
    count
        Rows of the file, None without one.
    cycle, cycles, last_cycle
        Number of the cycle that is used, of all in the record, and of the last one of several that
        are used as one history.
    start_strain
        Strain at which the contact of a later cycle starts, from the first contact; taken off.
    zeros, origins
        Standard error of the zero of a channel where samples show it; and what was taken off:
        "contact_time", s, "stress_zero", Pa, "acceleration_zero", m/s², "displacement_zero", m.
    derived
        Channels that were computed from others and are no measurement of their own.
    braked
        Whether the stress is the striker's mass over the area times its deceleration.
    block
        Rows of the file that are averaged in each sample.
    uncertainties
        Standard deviations that the TOML states: "height", "height_1", … (m), "area" (m²),
        "specimen_mass", "striker_mass" (kg), "velocity" (m/s), "delay" (s) of a motion with its own
        clock, and of scales, as a share: "stress_scale", "displacement_scale", ….
    standstills
        First and last time, s (or sample), of each stretch in which the gauge stood still.
    priors
        What the TOML says of parameters before the fit, like "5.5 ± 0.1 MPa".
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
    outliers: dict[str, Outliers] = field(default_factory=dict)
    contact: str = "file"
    count: RowCount | None = None
    cycle: int = 1
    cycles: tuple[int, ...] = (1,)
    last_cycle: int | None = None
    start_strain: float = 0.0
    acceleration: Array | None = None
    block: int = 1
    uncertainties: dict[str, float] = field(default_factory=dict)
    standstills: tuple[tuple[float, float], ...] = ()
    priors: dict[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Tell what it holds, without its samples."""
        height, area = engineering(self.specimen.height, "m"), f"{self.specimen.area:.4g} m²"
        held = f"{self.rows.used} rows of {', '.join(self.channels())}"
        return f"Measurement {self.name!r}: {held}; height {height}, area {area}"

    @property
    def rows(self) -> RowCount:
        """Rows of the file, used and not used; without a file all samples are used."""
        n = max((values.size for values in self.channels().values()), default=0)
        return self.count or RowCount(n, n)

    def channels(self) -> dict[str, Array]:
        """Stress, displacement, acceleration and displacements inside, as far as they are there."""
        return self.curves("acceleration")
