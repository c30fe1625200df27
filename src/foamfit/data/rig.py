"""RIG.toml: the tests that a rig can make, and the candidates among them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement, Noise, NoiseLevel, Striker, interior_channel
from foamfit.data.noise import with_noise
from foamfit.data.rate import loading_rate
from foamfit.data.toml_file import COUNT, FLAG, check_keys, load_toml
from foamfit.data.units import parse_quantity, split_quantity
from foamfit.errors import InputError, naming
from foamfit.text import engineering, listed

Range = tuple[float, float]
# Each quantity of the file: its unit, an example, and whether it is a range.
_QUANTITIES: dict[str, dict[str, tuple[str, str, bool]]] = {
    "striker": {"velocity": ("m/s", "0.5 to 6 m/s", True)},
    "machine": {
        "rate": ("1/s", "0.01 to 10 1/s", True),
        "strain": ("", "0.1 to 0.7", True),
        "hold": ("s", "10 s", False),
    },
    "limits": {
        "force": ("N", "500 N", False),
        "displacement": ("m", "1 mm", False),
        "strain": ("", "0.9", False),
    },
    "record": {"rate": ("1/s", "1 MHz", False)},
    "noise": {"stress": ("Pa", "20 kPa", False), "displacement": ("m", "2 um", False)},
}
_OTHERS = {"striker": ["masses"], "machine": ["cycles"], "record": ["noise", "interior"]}
VELOCITIES, STRAINS, RATES = 24, 5, 5  # numbers of candidates over each range
LOCK_UP = 0.95  # largest strain, if no limit is stated
# Ranges, relative to the record, that a rig is assumed to have if it states none.
FASTER, FARTHER, RATE_RANGE = (0.5, 3.0), (0.5, 1.25), (0.1, 10.0)
IMPACT_SAMPLES, CYCLE_SAMPLES = 200, 150  # simulated samples; the information is scaled
LONG_HOLD = 10.0  # assumed duration of a hold over that of the record

DRAFT = """\
# The tests that the rig can make, for foamfit plan. What is left out is taken from the record.
# Lines that start with "# " are examples: enter your value and remove the "# ".
[striker]
# velocity = "0.5 to 6 m/s"
# masses = ["7 g", "14 g"]

[machine]                    # only if there is a testing machine
# rate = "0.01 to 10 1/s"    # strain rate
# strain = "0.1 to 0.7"      # largest strain of a test
# cycles = 3
# hold = "10 s"              # longest hold at the largest strain

[limits]
# force = "500 N"
# displacement = "1 mm"
# strain = 0.9

[record]
# rate = "1 MHz"
# noise = { stress = "20 kPa", displacement = "2 um" }
# interior = true            # whether a camera can follow an interior displacement
"""


@dataclass(frozen=True)
class Rig:
    """The tests that a rig can make, SI.

    Without a striker `masses` is empty, and without a testing machine `rates` is (0, 0).
    """

    velocity: Range
    masses: tuple[float, ...]
    strain: Range
    rates: Range
    cycles: int
    hold: float
    force: float  #: largest force, N
    displacement: float  #: largest displacement, m
    largest_strain: float
    sampling: float | None  #: samples per second; None: as many per cycle as in the record
    noise: dict[str, float]
    interior: bool
    notes: tuple[str, ...] = ()  #: what was taken from the record

    @property
    def limits(self) -> str:
        """The limits in words."""
        shown = [engineering(self.force, "N")] if math.isfinite(self.force) else []
        shown += [engineering(self.displacement, "m")] if math.isfinite(self.displacement) else []
        return listed([*shown, f"a strain of {self.largest_strain:g}"])


@dataclass(frozen=True)
class Candidate:
    """A test that the rig can make, SI: an impact, or slow cycles to a strain at a rate."""

    drive: str  #: "impact" or "displacement"
    mass: float | None = None
    velocity: float | None = None
    strain: float | None = None
    rate: float | None = None
    cycles: int = 1
    hold: float = 0.0
    interior: int | None = None  #: interior mass whose displacement is recorded as well
    repeat: bool = False  #: whether it repeats the test at hand

    def __str__(self) -> str:
        """Describe the test in words."""
        if self.mass is not None and self.velocity is not None:
            text = f"an impact of {engineering(self.mass * 1e3, 'g')} at {self.velocity:.3g} m/s"
        else:
            some = "a cycle" if self.cycles == 1 else f"{self.cycles} cycles"
            text = f"{some} to a strain of {self.strain:.2g} at {self.rate:.3g} 1/s"
        text += f" with a hold of {engineering(self.hold, 's')}" if self.hold else ""
        text += f" with the displacement of interior mass {self.interior}" if self.interior else ""
        return text + (" (the same test again)" if self.repeat else "")

    def motion(self, height: float) -> tuple[Array, Array]:
        """Return times (s) and displacements (m) of a slow test of a specimen."""
        assert self.strain is not None
        assert self.rate is not None
        ramp = self.strain / self.rate
        corners, levels = [0.0], [0.0]
        for _ in range(self.cycles):
            corners += [corners[-1] + ramp, *([corners[-1] + ramp + self.hold] * bool(self.hold))]
            corners += [corners[-1] + ramp]
            levels += [self.strain, *([self.strain] * bool(self.hold)), 0.0]
        parts = [
            np.linspace(a, b, CYCLE_SAMPLES // 2, endpoint=False) for a, b in pairwise(corners)
        ]
        time = np.append(np.concatenate(parts), corners[-1])
        return time, height * np.interp(time, corners, levels)

    def recorded(self, test: Measurement, rig: Rig, lasts: float, peak: float) -> Measurement:
        """Return a record of this test of the specimen of `test`; its values are placeholders.

        An impact `lasts` some time (s), and `peak` is the largest stress (Pa). Noise that the TOML
        of `test` does not state counts as estimated, as in a fit.
        """
        height, known, spreads = test.specimen.height, test.noise, dict(test.uncertainties)
        striker = None
        if self.drive == "impact":
            time = np.linspace(0.0, lasts, IMPACT_SAMPLES)
            moved: Array | None = np.linspace(0.0, 0.5 * height, time.size)
            moved = None if test.displacement is None and test.striker is not None else moved
            striker = replace(test.striker or Striker(), mass=self.mass, velocity=self.velocity)
            was = test.striker and test.striker.velocity
            if was and self.velocity and "velocity" in spreads:
                spreads["velocity"] *= self.velocity / was
        else:
            time, moved = self.motion(height)
        estimated = dict[str, NoiseLevel]()
        for channel, sigma in rig.noise.items():
            given = getattr(known, channel) is not None
            size = 0.0 if channel == "displacement" and striker is None else sigma
            estimated[channel] = NoiseLevel(size, given, "the rig")
        seen = {*test.interior, *([] if self.interior is None else [self.interior])}
        ramp = np.linspace(0.0, 1.0, time.size)
        levels = estimated | {interior_channel(node): estimated["displacement"] for node in seen}
        return Measurement(
            name=str(self), path=None, data_sha256="", time=time, displacement=moved,
            stress=peak * ramp, specimen=test.specimen, striker=striker, motion=test.motion,
            noise=Noise(estimated=levels), contact="stress", zeros=test.zeros if striker else {},
            interior=dict.fromkeys(sorted(seen), 0.2 * height * ramp),
            uncertainties={k: s for k, s in spreads.items() if k not in ("delay", "stress_scale")},
        )  # fmt: skip

    def weight(self, time: Array, test: Measurement, rig: Rig) -> float:
        """Return the number of samples of the rig per simulated sample."""
        if rig.sampling is not None:
            return rig.sampling * float(time[-1] - time[0]) / time.size
        rows = test.rows.used if test.displacement is None else test.displacement.size
        return rows / max(len(test.cycles), 1) * self.cycles / time.size

    def toml(self, test: Measurement) -> str:
        """Return the TOML of the test, for its record."""
        height, area = test.specimen.height * 1e3, test.specimen.area * 1e6
        lines = [
            f"# {self}: advised by foamfit plan. Put this beside the record, with the same name.",
            "[specimen]",
            f'height = "{height:.6g} mm"',
            f'area = "{area:.6g} mm^2"',
        ]
        if test.specimen.mass is not None:
            lines.append(f'mass = "{test.specimen.mass * 1e6:.6g} mg"')
        if test.specimen.heights is not None:
            each = ", ".join(f'"{one * 1e3:.6g} mm"' for one in test.specimen.heights)
            lines.append(f"heights = [{each}]")
        if self.mass is not None:
            lines += ["", "[striker]", f'mass = "{self.mass * 1e3:.6g} g"']
            lines.append(f'velocity = "{self.velocity:.6g} m/s"    # enter the measured velocity')
        else:
            lines += ["", f"# Machine: {self}."]
        if self.interior:
            name = interior_channel(self.interior)
            lines.append(f"# Record the displacement of interior mass {self.interior} as {name}.")
        return "\n".join(lines) + "\n"


def candidates(rig: Rig, test: Measurement, springs: int) -> list[Candidate]:
    """Return the candidates: a grid over what the rig can do, and a repeat of the test at hand."""
    out = list[Candidate]()
    speeds = np.geomspace(*rig.velocity, VELOCITIES) if rig.masses else ()
    inner = [None, *range(1, springs)] if rig.interior else [None]
    inner = [node for node in inner if node not in test.interior]
    for mass, speed, node in product(rig.masses, speeds, inner):
        out.append(Candidate("impact", mass, float(f"{speed:.4g}"), interior=node))
    if rig.rates[0] > 0.0:
        counts = sorted({1, rig.cycles})
        grid = _spread(rig.strain, STRAINS), _spread(rig.rates, RATES)
        for strain, rate, cycles in product(*grid, counts):
            out.append(Candidate("displacement", strain=strain, rate=rate, cycles=cycles))
        for strain, rate in product(grid[0], grid[1] if rig.hold else ()):
            out.append(Candidate("displacement", strain=strain, rate=rate, hold=rig.hold))
    again = _again(test, rig)
    return [*out, *([] if again is None else [again])]


def _spread(ends: Range, count: int) -> list[float]:
    """Return values spread evenly in ratio over a range."""
    values = np.geomspace(*ends, count if ends[1] > ends[0] else 1)
    return [float(f"{value:.3g}") for value in values]


def _again(test: Measurement, rig: Rig) -> Candidate | None:
    """Return a repeat of the test at hand."""
    striker, rate = test.striker, loading_rate(test)
    if striker is not None and striker.mass and striker.velocity:
        return Candidate("impact", striker.mass, striker.velocity, repeat=True)
    if test.displacement is None or rate is None or not rig.rates[0] > 0.0:
        return None
    strain = float(np.max(test.displacement)) / test.specimen.height
    return Candidate("displacement", strain=strain, rate=rate, repeat=True)


def read_rig(path: Path | None, test: Measurement, *, relaxing: bool = False) -> Rig:
    """Return the rig of a file; what it does not state is taken from the record of `test`.

    `relaxing` is whether the law relaxes, so that a hold is worth a try. Raises InputError with
    the file and the key that is wrong.
    """
    if path is None:
        return _completed({}, test, relaxing)
    document = load_toml(path, "a rig is a TOML with [striker], [limits], …; foamfit init --rig")
    with naming(path):
        return _completed(_stated(document), test, relaxing)


def _stated(document: dict[str, Any]) -> dict[str, Any]:
    """Return the quantities of the file in SI, by table and key."""
    check_keys("a rig", document, [table for table in _QUANTITIES if table != "noise"])
    out = dict[str, Any]()
    for table, content in document.items():
        if not isinstance(content, dict):
            raise InputError(f"{table} must be a table, [{table}].")
        check_keys(f"[{table}]", content, [*_QUANTITIES[table], *_OTHERS.get(table, ())])
        for key, value in content.items():
            where = f"[{table}] {key}"
            if key in _QUANTITIES[table]:
                out[f"{table}.{key}"] = _quantity(value, where, *_QUANTITIES[table][key])
            elif key == "masses":
                if not isinstance(value, list) or not value:
                    raise InputError(f'{where} must be a list like ["7 g", "14 g"].')
                out["masses"] = tuple(_quantity(one, where, "kg", "7 g", False) for one in value)
            elif key == "noise":
                if not isinstance(value, dict):
                    raise InputError(f'{where} must be like {{ stress = "20 kPa" }}.')
                check_keys(where, value, _QUANTITIES["noise"])
                shown = _QUANTITIES["noise"]
                out |= {
                    f"noise.{channel}": _quantity(one, f"{where}.{channel}", *shown[channel])
                    for channel, one in value.items()
                }
            else:
                rule = COUNT if key == "cycles" else FLAG
                if not rule.valid(value):
                    raise InputError(f"{where} = {value!r} must be {rule.right}.")
                out[key] = value
    return out


def _quantity(value: Any, where: str, unit: str, example: str, several: bool) -> Any:
    """Return a positive quantity, or a range like "0.5 to 6 m/s", in SI."""
    text = f"{value:g}" if isinstance(value, int | float) and not unit else value
    ends = text.split(" to ") if isinstance(text, str) and several else [text]
    if several and len(ends) == 2:
        last = split_quantity(ends[1])
        first = split_quantity(ends[0])
        if first and last and not first[1]:
            ends[0] = f"{ends[0]} {last[1]}"
    numbers = [parse_quantity(end, unit, where, example) for end in ends]
    if len(numbers) > 2 or min(numbers) <= 0.0 or numbers != sorted(numbers):
        wanted = "a range of positive values" if several else "positive"
        raise InputError(f'{where} = "{value}" must be {wanted}, like "{example}".')
    return (numbers[0], numbers[-1]) if several else numbers[0]


def _completed(stated: dict[str, Any], test: Measurement, relaxing: bool) -> Rig:
    """Return the rig, completed from a record."""
    notes, test = list[str](), with_noise(test)

    def of_record(key: str, value: Any, said: str) -> Any:
        if key in stated:
            return stated[key]
        notes.append(said)
        return value

    striker, rate, masses = test.striker, loading_rate(test), stated.get("masses", ())
    velocity, known = stated.get("striker.velocity", (0.0, 0.0)), striker and striker.velocity
    if striker is not None and striker.mass and not masses:
        masses = of_record("masses", (striker.mass,), "the mass of the striker")
    if known and masses:
        scaled = FASTER[0] * known, FASTER[1] * known
        said = f"velocities from {scaled[0]:.3g} to {scaled[1]:.3g} m/s"
        velocity = of_record("striker.velocity", scaled, said)
    if masses and not velocity[0] > 0.0:
        raise InputError('[striker] velocity is missing; give it like "0.5 to 6 m/s".')
    strain, rates, hold = (0.0, 0.0), (0.0, 0.0), 0.0
    machine = any(key.startswith("machine.") for key in stated)
    slow = not masses and rate is not None and test.displacement is not None
    if machine or slow:
        most = 0.5 if test.displacement is None else float(test.displacement.max())
        most = most if test.displacement is None else most / test.specimen.height
        top = min(FARTHER[1] * most, 0.9)
        said = f"strains from {FARTHER[0] * most:.2g} to {top:.2g}"
        strain = of_record("machine.strain", (FARTHER[0] * most, top), said)
        near = rate if rate is not None and not masses else 0.1
        scaled = RATE_RANGE[0] * near, RATE_RANGE[1] * near
        said = f"strain rates from {scaled[0]:.3g} to {scaled[1]:.3g} 1/s"
        rates = of_record("machine.rate", scaled, said)
        hold = stated.get("machine.hold", 0.0)
        if relaxing and not hold and test.time is not None and slow:
            lasts = LONG_HOLD * float(test.time[-1] - test.time[0])
            hold = of_record("machine.hold", lasts, f"a hold of {engineering(lasts, 's')}")
    sampling = stated.get("record.rate")
    if sampling is None and masses and test.time is not None:
        sampling = 1.0 / float(np.median(np.diff(test.time)))
        sampling = of_record("record.rate", sampling, f"{engineering(sampling, 'Hz')} sampling")
    noise = dict[str, float]()
    for channel, unit, least in (("stress", "Pa", test.stress), ("displacement", "m", None)):
        level = test.noise.of(channel)
        usual = 1e-3 * test.specimen.height if least is None else 0.01 * float(np.ptp(least))
        sigma = usual if level is None or not level.sigma else level.sigma
        said = f"noise of {engineering(sigma, unit)} ({channel})"
        noise[channel] = of_record(f"noise.{channel}", sigma, said)
    return Rig(
        velocity=velocity, masses=masses, strain=strain, rates=rates,
        cycles=stated.get("cycles", max(len(test.cycles), 1)), hold=hold,
        force=stated.get("limits.force", math.inf),
        displacement=stated.get("limits.displacement", math.inf),
        largest_strain=stated.get("limits.strain", LOCK_UP), sampling=sampling, noise=noise,
        interior=stated.get("interior", bool(test.interior)), notes=tuple(notes),
    )  # fmt: skip


def beyond(rig: Rig, springs: int) -> Iterator[tuple[str, Rig]]:
    """Yield more capable rigs, each with the name of what it adds."""
    none = {"force": math.inf, "displacement": math.inf}
    if rig.masses:
        high = rig.velocity[1], 3.0 * rig.velocity[1]
        yield "a faster or heavier striker", replace(rig, velocity=high, **none)  # type: ignore[arg-type]
        if springs > 1 and not rig.interior:
            yield "the displacement of an interior mass", replace(rig, interior=True)
    if not rig.rates[0] > 0.0:
        slow: Any = {"strain": (0.5, 0.8), "rates": (0.01, 1.0), "masses": (), "sampling": None}
        yield "a testing machine with slow cycles", replace(rig, **slow)
    else:
        wide = 0.01 * rig.rates[0], 100.0 * rig.rates[1]
        yield "a wider range of strain rates", replace(rig, rates=wide)
        deep = rig.strain[1], max(rig.strain[1], 0.85)
        yield "a larger strain", replace(rig, strain=deep, **none)  # type: ignore[arg-type]
    quiet = {channel: 0.1 * sigma for channel, sigma in rig.noise.items()}
    yield "sensors with a tenth of the noise", replace(rig, noise=quiet)
