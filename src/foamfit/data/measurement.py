"""Measured data in SI units: the samples of a file, and the test prepared from them."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array, Integers, Mask
from foamfit.text import engineering, rounded

MIN_ROWS = 10  # samples of a test


# Sources of a displacement; an integrated one is not an independent measurement.
MEASURED, INTEGRATED = "measured", "integrated from force"
FROM_VELOCITY = "integrated from velocity"
# SI units of the channels other than displacements, which are in m.
UNITS = {"stress": "Pa", "velocity": "m/s", "acceleration": "m/s²"}


def interior_channel(node: int) -> str:
    """Return the name of the displacement channel of an interior mass; 1 is next to the base."""
    return f"displacement_{node}"


def interior_node(channel: str) -> int | None:
    """Return the number of the interior mass of a channel, None for any other channel."""
    match = re.fullmatch(r"displacement_([1-9]\d{0,3})", channel, re.ASCII)
    return int(match[1]) if match else None


@dataclass(frozen=True)
class Specimen:
    """Height before the test, m, cross-section, m², mass, kg, and spring heights, base first."""

    height: float
    area: float
    mass: float | None = None
    heights: tuple[float, ...] | None = None


GRAVITY = 9.80665  # standard gravity, m/s²


@dataclass(frozen=True)
class Striker:
    """Mass, kg, and velocity at contact, m/s, of the striker; either may be unknown.

    `gravity` is its acceleration, m/s²; None: to be determined from the flight before contact.
    """

    mass: float | None = None
    velocity: float | None = None
    gravity: float | None = None


@dataclass(frozen=True)
class NoiseLevel:
    """Standard deviation of a channel's noise, Pa or m, `given` by the user or estimated (`how`).

    `time` is the autocorrelation time in samples (1: white noise).
    """

    sigma: float
    given: bool
    how: str
    time: float = 1.0


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the noise from the TOML, Pa and m, and the `estimated` ones.

    The value of the displacement also applies to interior masses.
    """

    stress: float | None = None
    displacement: float | None = None
    estimated: dict[str, NoiseLevel] = field(default_factory=dict)

    @property
    def levels(self) -> dict[str, NoiseLevel]:
        """The noise of stress and displacement from the TOML, where given."""
        every = ("stress", self.stress), ("displacement", self.displacement)
        return {c: NoiseLevel(sigma, True, "given") for c, sigma in every if sigma is not None}

    def of(self, channel: str) -> NoiseLevel | None:
        """Return the noise of a channel, from the TOML if given there; None if unknown."""
        stated = channel if channel in ("stress", "acceleration") else "displacement"
        return self.levels.get(stated) or self.estimated.get(channel)


@dataclass(frozen=True, eq=False)
class Outliers:
    """Samples of a channel that are `left_out` of the fit (n,): spikes, short gaps, clipped force.

    Spikes and gaps are replaced by a straight line. Their original `values` (k,), Pa or m, belong
    to the times `at` (k,), s, or sample numbers. The force is clipped at `clipped_at`, Pa.
    """

    left_out: Mask
    at: Array
    values: Array
    clipped_at: float | None = None


@dataclass(frozen=True)
class Dropped:
    """Number of rows dropped for one reason, and the first and last of them (lines of the file)."""

    rows: int
    first: int
    last: int
    why: str

    @classmethod
    def of(cls, rows: Integers, why: str) -> Dropped:
        """Count the rows with the given row numbers."""
        return cls(rows.size, int(rows[0]), int(rows[-1]), why)

    def __str__(self) -> str:
        """Return, for example, "rows 2 to 200 (199): before contact starts"."""
        if self.rows == 1:
            return f"row {self.first}: {self.why}"
        part = "" if self.rows == self.last - self.first + 1 else "of "
        return f"{part}rows {self.first} to {self.last} ({self.rows}): {self.why}"


@dataclass(frozen=True)
class Entry:
    """Entry of [columns] for one channel: header or number (from 1) of a column, unit and scale.

    With `inverse`, the scale is a sensitivity, such as "2 mV/N"; `spread` is its relative standard
    deviation. The values of a column that `counts_down` decrease in compression. `table` is the
    section of the TOML.
    """

    channel: str
    column: str | int = "…"
    unit: str | None = None
    scale: float = 1.0
    scale_unit: str = ""
    counts_down: bool = False
    spread: float = 0.0
    inverse: bool = False
    table: str = "columns"

    def __str__(self) -> str:
        """Return the line of the TOML."""
        return self._line(f"{self.scale:.12g}" if self.scale != 1.0 or self.scale_unit else "")

    def _line(self, scale: str) -> str:
        scale = f'"{scale} {self.scale_unit}"' if self.scale_unit else scale
        more = f', unit = "{self.unit}"' * bool(self.unit) + f", scale = {scale}" * bool(scale)
        more += ", counts_down = true" * self.counts_down
        column = json.dumps(self.column, ensure_ascii=False) + more
        return f"{self.channel} = {{ column = {column} }}"

    def times(self, factor: float, within: float) -> str:
        """Return the line for a channel larger by a factor, rounded `within` a share of it."""
        return self._line(rounded(self.scale * factor ** (-1.0 if self.inverse else 1.0), within))


@dataclass(frozen=True)
class RowCount:
    """Rows of numbers in a file: all, used, and dropped with the reasons.

    A row is used if all its channels are fitted or integrated, directly or averaged.
    """

    rows: int
    used: int
    dropped: tuple[Dropped, ...] = ()

    def sentences(self) -> list[str]:
        """Return sentences with the number of rows and the rows that are not used."""
        unused = (f"Not used: {item}." for item in self.dropped)
        return [f"{self.rows} in the file, {self.used} used.", *unused]


@dataclass(frozen=True)
class Window:
    """The part of a file to use: start and end on the file's own clock, s, and the cycle."""

    start: float = -np.inf
    end: float = np.inf
    cycle: int | None = None  # None: the first
    last: int | None = None  # last of several cycles taken as one history; None: only `cycle`


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Fields shared by `Record` and `Measurement`; see their docstrings."""

    interior: dict[int, Array] = field(default_factory=dict)
    sampled: dict[str, Mask] = field(default_factory=dict)
    zeros: dict[str, float] = field(default_factory=dict)
    origins: dict[str, float] = field(default_factory=dict)
    derived: tuple[str, ...] = ()
    braked: bool = False
    notes: tuple[str, ...] = ()
    before: tuple[Array, Array] | None = None  #: times (s) and motion (m) before a later cycle

    @property
    def instants(self) -> Array:
        """Time, or sample numbers without a time, shape (n,)."""
        time: Array | None = vars(self)["time"]
        n = next(iter(self.curves("acceleration").values())).size
        return np.arange(n, dtype=np.float64) if time is None else time

    def curves(self, *more: str) -> dict[str, Array]:
        """Return the available ones of stress, displacement, `more`, interior displacements."""
        names = ("stress", "displacement", *more)
        present = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return present | {interior_channel(node): w for node, w in self.interior.items()}


@dataclass(frozen=True, eq=False)
class Record(Samples):
    """The channels of a test in SI, each of shape (n,) or None if missing from the file.

    Time, s, stress, Pa, displacement, m, velocity, m/s, and deceleration of the top, m/s² (positive
    in compression). `excess` is the original value of an outlier minus the straight line that
    replaces it, 0 elsewhere; `clipped` marks samples of a clipped force; `standstills` maps a note
    on a stuck gauge to a mask of the samples affected. `cycle` is the column of cycle numbers,
    `numbers` are the rows in the file (None: counted from 1).
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
        """Return the number of samples."""
        return len(self.stress)

    @property
    def row_numbers(self) -> Integers:
        """Row number in the file of each sample, shape (n,)."""
        return np.arange(1, len(self) + 1) if self.numbers is None else self.numbers

    @property
    def stood_still(self) -> Mask:
        """Mask of the samples with a stuck gauge, shape (n,)."""
        masks = np.zeros(len(self), dtype=bool), *self.standstills.values()
        return np.asarray(np.logical_or.reduce(masks))

    def channel(self, name: str) -> Array | None:
        """Return a channel by its name; "displacement_1" is the interior mass above spring 1."""
        node = interior_node(name)
        values: Array | None = getattr(self, name) if node is None else self.interior.get(node)
        return values

    def changed(self, name: str, values: Array) -> Record:
        """Return a record with new values in a channel."""
        node = interior_node(name)
        if node is None:
            return replace(self, **{name: values})  # type: ignore[arg-type]
        return replace(self, interior=self.interior | {node: values})

    def shifted(self, name: str, by: float) -> Record:
        """Subtract a value from the time or a channel, and add it to `origins`."""
        values = self.channel(name)
        assert values is not None  # the offset was determined from them
        key = "contact_time" if name == "time" else f"{name}_zero"
        origins = self.origins | {key: self.origins.get(key, 0.0) + by}
        return replace(self.changed(name, values - by), origins=origins)

    def interpolated(self, name: str, values: Array, taken: Any) -> Record:
        """Replace a channel by interpolated values; only the samples `taken` count as measured."""
        measured = np.zeros(len(self), dtype=bool)
        measured[taken] = True
        return replace(self.changed(name, values), sampled=self.sampled | {name: measured})

    def noted(self, *notes: str) -> Record:
        """Append notes."""
        return replace(self, notes=(*self.notes, *notes))

    def rows(self, which: slice | Mask) -> Record:
        """Select rows of every channel, without counting the others as dropped."""

        def part(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: part(item) for key, item in value.items()}
            return value[which] if isinstance(value, np.ndarray) else value

        return replace(self, **{item.name: part(getattr(self, item.name)) for item in fields(self)})

    def without(self, gone: slice | Mask, why: str) -> Record:
        """Drop rows of every channel and count them with the reason."""
        numbers, kept = self.row_numbers, np.ones(len(self), dtype=bool)
        kept[gone] = False
        if kept.all():
            return self
        dropped = (*self.dropped, Dropped.of(numbers[~kept], why))
        return replace(self, numbers=numbers, dropped=dropped).rows(kept)

    def between(self, first: int, end: int, before: str, after: str) -> Record:
        """Keep samples `first` to `end` (exclusive); drop those outside with the two reasons."""
        return self.without(slice(end, None), after).without(slice(0, first), before)


@dataclass(frozen=True, eq=False)
class Measurement(Samples):
    """One test, prepared for the fit, in SI: compression positive, time zero at contact.

    `interior` contains the displacements, m, of the interior masses, 1 above spring 1; `sampled` a
    mask of the measured samples of a channel whose others are interpolated; `zeros` the standard
    error of the zero of a channel if determined from samples; `origins` the values subtracted:
    "contact_time", s, "stress_zero", Pa, "acceleration_zero", m/s², "displacement_zero", m.
    `derived` channels were computed from others; with `braked` the stress is the striker's mass
    times its deceleration over the area. A note is a sentence on a step of the preparation.
    """

    name: str
    path: Path | None  #: None without a file
    data_sha256: str  #: digest of the file
    time: Array | None  #: s, increasing, (n,)
    stress: Array  #: nominal base stress, Pa, (n,)
    displacement: Array | None  #: of the top, m, (n,)
    specimen: Specimen
    striker: Striker | None = None
    noise: Noise = field(default_factory=Noise)  #: from the TOML, and estimated
    motion: str | None = None  #: source of the displacement: "measured", "integrated from force", …
    outliers: dict[str, Outliers] = field(default_factory=dict)  #: samples left out, by channel
    #: what set time zero: "stress" (the displacement is then zero there too), "motion" or "file"
    contact: str = "file"
    count: RowCount | None = None  #: rows of the file
    cycle: int = 1  #: number of the cycle in use
    cycles: tuple[int, ...] = (1,)  #: numbers of all cycles in the record
    last_cycle: int | None = None  #: number of the last of several used as one history
    start_strain: float = 0.0  #: not recovered before a later cycle, relative to first contact
    #: deceleration of the striker, m/s², only of an impact without a measured displacement
    acceleration: Array | None = None
    #: contact time by the first rise of the stress alone, s (or sample number) after time zero, and
    #: its standard error; None if the record does not show it
    rise: tuple[float, float] | None = None
    block: int = 1  #: rows of the file averaged in each sample
    #: standard deviations from the TOML: "height", "height_1", … (m), "area" (m²), "specimen_mass",
    #: "striker_mass" (kg), "velocity" (m/s), "delay" (s) of a motion with its own clock, and
    #: relative ones of scales: "stress_scale", "displacement_scale", …
    uncertainties: dict[str, float] = field(default_factory=dict)
    standstills: tuple[tuple[float, float], ...] = ()  #: first and last time (or sample) of each
    turned: tuple[str, ...] = ()  #: channels that were negative in compression
    priors: dict[str, str] = field(default_factory=dict)  #: of parameters, like "5.5 ± 0.1 MPa"
    #: entries of [columns] by which "stress", "displacement", … are read
    entries: dict[str, Entry] = field(default_factory=dict)
    #: velocity of the striker by its motion before contact, and standard error, m/s; None if the
    #: gauge did not follow it
    flight: tuple[float, float] | None = None

    def __repr__(self) -> str:
        """Return a summary without the samples."""
        height, area = engineering(self.specimen.height, "m"), f"{self.specimen.area:.4g} m²"
        data = f"{self.rows.used} rows of {', '.join(self.channels())}"
        return f"Measurement {self.name!r}: {data}; height {height}, area {area}"

    @property
    def rows(self) -> RowCount:
        """Rows of the file, used and dropped; without a file all samples are used."""
        n = max((values.size for values in self.channels().values()), default=0)
        return self.count or RowCount(n, n)

    def channels(self) -> dict[str, Array]:
        """Return the available ones of stress, displacement, acceleration, interior motions."""
        return self.curves("acceleration")


def is_clipped(test: Measurement) -> bool:
    """Return whether the force of a test is clipped."""
    force = test.outliers.get("stress")
    return force is not None and force.clipped_at is not None
