"""RIG.toml: the tests that a rig can make, and the candidates among them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data import toml_file as toml
from foamfit.data.cycles import loading_rate
from foamfit.data.measurement import (
    MEASURED,
    Measurement,
    Noise,
    NoiseLevel,
    Striker,
    interior_channel,
)
from foamfit.data.noise import with_noise
from foamfit.errors import InputError, naming
from foamfit.text import engineering, listed

Range = tuple[float, float]


_RIG: dict[str, dict[str, toml.Check]] = {
    "striker": {
        "velocity": toml.Span("m/s", "0.5 to 6 m/s"),
        "masses": toml.Several(toml.Quantity("kg", "7 g"), 'like ["7 g", "14 g"]'),
    },
    "machine": {
        "rate": toml.Span("1/s", "0.01 to 10 1/s"),
        "strain": toml.Span("", "0.1 to 0.7", below=1.0),
        "cycles": toml.COUNT,
        "hold": toml.Quantity("s", "10 s"),
    },
    "limits": {
        "force": toml.Quantity("N", "500 N"),
        "displacement": toml.Quantity("m", "1 mm"),
        "strain": toml.Quantity("", "0.9", below=1.0),
    },
    "record": {
        "rate": toml.Quantity("1/s", "1 MHz"),
        "noise": toml.Table(toml.NOISE, '{ stress = "20 kPa" }'),
        "interior": toml.FLAG,
    },
}
# Fields of `Rig` with other names than their keys
_FIELDS = {("machine", "rate"): "rates", ("limits", "strain"): "largest_strain"}
_FIELDS |= {("record", "rate"): "sampling"}
VELOCITIES, STRAINS, RATES = 24, 5, 5  # numbers of candidates over each range
LOCK_UP = 0.95  # largest strain, if no limit is stated
# Ranges, relative to the record, that a rig is assumed to have if it states none.
FASTER, FARTHER, RATE_RANGE = (0.5, 3.0), (0.5, 1.25), (0.1, 10.0)
IMPACT_SAMPLES, CYCLE_SAMPLES = 200, 150  # simulated samples; the information is scaled
LONG_HOLD = 10.0  # assumed duration of a hold over that of the record

# The rig that `foamfit init --rig` writes, to be filled in.
DRAFT = Path(__file__).with_name("rig.toml").read_text(encoding="utf-8")


@dataclass(frozen=True)
class Rig:
    """The tests that a rig can make, SI.

    Without a striker `masses` is empty, and without a testing machine `rates` is (0, 0).
    """

    noise: dict[str, float]
    cycles: int
    interior: bool
    notes: tuple[str, ...]  #: what was taken from the record
    velocity: Range = (0.0, 0.0)
    masses: tuple[float, ...] = ()
    strain: Range = (0.0, 0.0)
    rates: Range = (0.0, 0.0)
    hold: float = 0.0
    force: float = math.inf  #: largest force, N
    displacement: float = math.inf  #: largest displacement, m
    largest_strain: float = LOCK_UP
    sampling: float | None = None  #: samples per second; None: as many per cycle as in the record

    @property
    def limits(self) -> str:
        """The limits in words."""
        largest = (self.force, "N"), (self.displacement, "m")
        shown = (engineering(most, unit) for most, unit in largest if math.isfinite(most))
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
        ramp, top, rows = self.strain / self.rate, self.strain, CYCLE_SAMPLES // 2
        hold = [(self.hold, top)] if self.hold else []
        lasts, levels = zip(*[(ramp, top), *hold, (ramp, 0.0)] * self.cycles, strict=True)
        corners = [0.0, *accumulate(lasts)]
        parts = [np.linspace(*ends, rows, endpoint=False) for ends in pairwise(corners)]
        time = np.append(np.concatenate(parts), corners[-1])
        return time, height * np.interp(time, corners, [0.0, *levels])

    def recorded(
        self, test: Measurement, rig: Rig, lasts: float, peak: float, *, with_motion: bool = False
    ) -> Measurement:
        """Return a record of this test of the specimen of `test`; its values are placeholders.

        An impact `lasts` some time (s), and `peak` is the largest stress (Pa). The motion is that
        of `test`, or measured `with_motion`. The motion of a slow test has no noise, those inside
        have that of the rig. Noise that the TOML of `test` does not state counts as estimated, as
        in a fit.
        """
        height, known, spreads = test.specimen.height, test.noise, dict(test.uncertainties)
        striker = None
        if self.drive == "impact":
            time = np.linspace(0.0, lasts, IMPACT_SAMPLES)
            moved = np.linspace(0.0, 0.5 * height, time.size)
            striker = replace(test.striker or Striker(), mass=self.mass, velocity=self.velocity)
            was = test.striker and test.striker.velocity
            if was and self.velocity and "velocity" in spreads:
                spreads["velocity"] *= self.velocity / was
        else:
            time, moved = self.motion(height)
        given = {c: c in known.levels for c in rig.noise}
        levels = {c: NoiseLevel(sigma, given[c], "the rig") for c, sigma in rig.noise.items()}
        seen = {*test.interior, *filter(None, [self.interior])}
        ramp = np.linspace(0.0, 1.0, time.size)
        levels |= {interior_channel(node): levels["displacement"] for node in seen}
        if striker is None:
            levels["displacement"] = replace(levels["displacement"], sigma=0.0)
        return Measurement(
            name=str(self), path=None, data_sha256="", time=time, displacement=moved,
            stress=peak * ramp, specimen=test.specimen, striker=striker,
            motion=MEASURED if with_motion else test.motion,
            noise=Noise(estimated=levels), contact="stress", zeros=test.zeros if striker else {},
            interior=dict.fromkeys(sorted(seen), 0.2 * height * ramp),
            uncertainties={k: s for k, s in spreads.items() if k not in ("delay", "stress_scale")},
        )  # fmt: skip

    def weight(self, time: Array, test: Measurement, rig: Rig) -> float:
        """Return the number of samples of the rig per simulated sample."""
        if rig.sampling is not None and self.mass is not None:  # the rate of impacts
            return rig.sampling * float(time[-1] - time[0]) / time.size
        return test.instants.size / max(len(test.cycles), 1) * self.cycles / time.size

    def toml(self, test: Measurement) -> str:
        """Return the TOML of the test, for its record."""
        height, area = test.specimen.height * 1e3, test.specimen.area * 1e6
        lines = [
            f"# {self}: advised by foamfit plan. Put this beside the record, with the same name.",
            "[specimen]", f'height = "{height:.6g} mm"', f'area = "{area:.6g} mm^2"',
        ]  # fmt: skip
        if test.specimen.mass is not None:
            lines.append(f'mass = "{test.specimen.mass * 1e6:.6g} mg"')
        if test.specimen.heights is not None:
            each = ", ".join(f'"{one * 1e3:.6g} mm"' for one in test.specimen.heights)
            lines.append(f"heights = [{each}]")
        if self.mass is not None:
            lines += ["", "[striker]", f'mass = "{self.mass * 1e3:.6g} g"']
            lines.append(f'velocity = "{self.velocity:.6g} m/s"    # enter the measured velocity')
            if test.striker is not None and (gravity := test.striker.gravity) is not None:
                lines.append(f"gravity = {'true' if gravity else 'false'}")
        else:
            lines += ["", f"# Machine: {self}."]
            lines += ["[window]", f"cycles = [1, {self.cycles}]"] if self.cycles > 1 else []
        if self.interior:
            name = interior_channel(self.interior)
            lines.append(f"# Record the displacement of interior mass {self.interior} as {name}.")
        return "\n".join([*lines, ""])


def candidates(rig: Rig, test: Measurement, springs: int) -> list[Candidate]:
    """Return the candidates: a grid over what the rig can do, and a repeat of the test at hand."""
    out = list[Candidate]()
    speeds = np.geomspace(*rig.velocity, VELOCITIES) if rig.masses else ()
    inner = [None, *range(1, springs)] if rig.interior else [None]
    inner = [node for node in inner if node not in test.interior]
    for mass, speed, node in product(rig.masses, speeds, inner):
        out.append(Candidate("impact", mass, float(f"{speed:.4g}"), interior=node))
    if rig.rates[0] > 0.0:
        grid = _spread(rig.strain, STRAINS), _spread(rig.rates, RATES)
        for strain, rate, cycles in product(*grid, sorted({1, rig.cycles})):
            out.append(Candidate("displacement", strain=strain, rate=rate, cycles=cycles))
        for strain, rate in product(grid[0], grid[1] if rig.hold else ()):
            out.append(Candidate("displacement", strain=strain, rate=rate, hold=rig.hold))
    striker, own = test.striker, loading_rate(test)
    if striker is not None and striker.mass and striker.velocity:
        out.append(Candidate("impact", striker.mass, striker.velocity, repeat=True))
    elif test.displacement is not None and own is not None and rig.rates[0] > 0.0:
        largest = float(np.max(test.displacement)) / test.specimen.height
        out.append(Candidate("displacement", strain=largest, rate=own, repeat=True))
    return out


def _spread(ends: Range, count: int) -> list[float]:
    values = np.geomspace(*ends, count if ends[1] > ends[0] else 1)
    return [float(f"{value:.3g}") for value in values]


def read_rig(path: Path | None, test: Measurement, *, relaxing: bool = False) -> Rig:
    """Return the rig of a file; what it does not state is taken from the record of `test`.

    `relaxing` is whether the law relaxes, so that a hold is worth a try. Raises InputError with
    the file and the key that is wrong.
    """
    if path is None:
        return _completed({name: {} for name in _RIG}, test, relaxing)
    right = "a rig is a TOML with [striker], [limits], …; foamfit init --rig"
    document = toml.load_toml(path, right)
    with naming(path):
        toml.check_keys("a rig", document, _RIG)
        return _completed(toml.checked_tables(document, _RIG), test, relaxing)


def _completed(stated: dict[str, dict[str, Any]], test: Measurement, relaxing: bool) -> Rig:
    test, notes = with_noise(test), list[str]()
    hits, machine, _, record = (stated[name] for name in _RIG)

    def assume(table: dict[str, Any], key: str, value: Any, said: str) -> None:
        if key not in table:
            table[key] = value
            notes.append(said)

    striker, rate = test.striker or Striker(), loading_rate(test)
    if striker.mass:
        assume(hits, "masses", (striker.mass,), "the mass of the striker")
    if "masses" in hits:
        if striker.velocity:
            low, high = (factor * striker.velocity for factor in FASTER)
            assume(hits, "velocity", (low, high), f"velocities from {low:.3g} to {high:.3g} m/s")
        elif "velocity" not in hits:
            raise InputError('[striker] velocity is missing; give it like "0.5 to 6 m/s".')
    w, strikes = test.displacement, "masses" in hits
    slow = not strikes and rate is not None and w is not None
    if machine or slow:
        most = 0.5 if w is None else float(w.max()) / test.specimen.height
        low, high = FARTHER[0] * most, min(FARTHER[1] * most, 0.9)
        assume(machine, "strain", (low, high), f"strains from {low:.2g} to {high:.2g}")
        near = 0.1 if rate is None or strikes else rate
        low, high = (factor * near for factor in RATE_RANGE)
        assume(machine, "rate", (low, high), f"strain rates from {low:.3g} to {high:.3g} 1/s")
    if relaxing and slow and test.time is not None:
        lasts = LONG_HOLD * float(test.time[-1] - test.time[0])
        assume(machine, "hold", lasts, f"a hold of {engineering(lasts, 's')}")
    if strikes and test.time is not None:
        rate = 1.0 / float(np.median(np.diff(test.time)))
        assume(record, "rate", rate, f"{engineering(rate, 'Hz')} sampling")
    noise, small = record.setdefault("noise", {}), 1e-3 * test.specimen.height
    usual = {"stress": 0.01 * float(np.ptp(test.stress))}
    for channel, unit in (("stress", "Pa"), ("displacement", "m")):
        level = test.noise.of(channel)
        sigma = level.sigma if level and level.sigma else usual.get(channel, small)
        assume(noise, channel, sigma, f"noise of {engineering(sigma, unit)} ({channel})")
    own: dict[str, Any] = {"cycles": max(len(test.cycles), 1), "interior": bool(test.interior)}
    for name, table in stated.items():
        own |= {_FIELDS.get((name, key), key): value for key, value in table.items()}
    return Rig(**own, notes=tuple(notes))


def beyond(rig: Rig, springs: int) -> Iterator[tuple[str, Rig]]:
    """Yield more capable rigs, each with the name of what it adds."""
    free = replace(rig, force=math.inf, displacement=math.inf)
    if free != rig:
        yield "a rig with higher limits", free
    if rig.masses:
        high = rig.velocity[1], 3.0 * rig.velocity[1]
        yield "a faster or heavier striker", replace(free, velocity=high)
        if springs > 1 and not rig.interior:
            yield "the displacement of an interior mass", replace(rig, interior=True)
    if not rig.rates[0] > 0.0:
        slow: Any = {"strain": (0.5, 0.8), "rates": (0.01, 1.0), "masses": (), "sampling": None}
        yield "a testing machine with slow cycles", replace(rig, **slow)
    else:
        wide = 0.01 * rig.rates[0], 100.0 * rig.rates[1]
        yield "a wider range of strain rates", replace(rig, rates=wide)
        deep = rig.strain[1], max(rig.strain[1], 0.85)
        yield "a larger strain", replace(free, strain=deep)
    quiet = {channel: 0.1 * sigma for channel, sigma in rig.noise.items()}
    yield "sensors with a tenth of the noise", replace(rig, noise=quiet)
