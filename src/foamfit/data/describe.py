"""What `foamfit check` prints of a test."""

from __future__ import annotations

import numpy as np

from foamfit.data.energy import EnergyAudit, largest_motion
from foamfit.data.measurement import Measurement, Specimen, Striker, interior_node
from foamfit.text import engineering, labelled, listed, percent

# What 1 % of a quantity does: in an impact, and in a slow test (None: it does not enter there).
# What does most stands first.
EFFECTS = {
    "velocity": ("2 % of the striker's energy and 1 % of its momentum", None),
    "striker_mass": ("1 % of both", None),
    "area": ("1 % of every stress", "1 % of every stress and stiffness"),
    "height": ("1 % of every strain", "1 % of every strain, and so of the stiffnesses"),
}


def describe(test: Measurement, audit: EnergyAudit, *, exact: bool = True) -> str:
    """Write what was read of a test, what was done to it, and its energy and momentum.

    With `exact` also which quantities have no ±.
    """
    lines = [
        ("test", [test.name]),
        ("file", [str(test.path or "none")]),
        ("specimen", [_specimen(test.specimen, test.uncertainties)]),
        ("striker", [_striker(test.striker, test.uncertainties)]),
        ("rows", test.rows.sentences()),
        ("samples", [_samples(test)]),
        *_peaks(test),
        ("noise", noise_sentences(test)),
        ("done", test.notes),
        ("energy", audit.sentences()),
        ("exact", _exact_sentences(test) if exact else []),
    ]
    return labelled(lines)


def taken_for_exact(test: Measurement) -> dict[str, str]:
    """Quantities of the TOML that have no ±, and what 1 % of each does, the most telling first.

    A slow test has no use for a striker, unless its mass made the stress.
    """
    striker, effects = test.striker or Striker(), dict[str, str]()
    impact = test.time is not None and striker.mass and striker.velocity
    for name, (of_impact, of_slow) in EFFECTS.items():
        effect = of_impact if impact else of_slow
        if name == "striker_mass" and test.braked:
            effect = EFFECTS["area"][0]
        if effect and name not in test.uncertainties:
            effects[name] = effect
    return effects


def _exact_sentences(test: Measurement) -> list[str]:
    """Say which ± the TOML lacks, and which of them would matter most."""
    effects = {name.replace("_", " "): effect for name, effect in taken_for_exact(test).items()}
    if not effects:
        return []
    told = ", ".join(f"1 % of the {name} is {effect}" for name, effect in effects.items())
    return [
        f"The TOML states no ± of {listed(effects)}, which therefore count as exact.",
        f"The ± of the {next(iter(effects))} would probably matter most: {told}. "
        "With --model check says what each does to the parameters.",
    ]


def noise_sentences(measurement: Measurement) -> list[str]:
    """Say of each channel what its noise is, one standard deviation, and how it is known."""
    sentences = []
    for channel, values in measurement.channels().items():
        level = measurement.noise.of(channel)
        if level is not None:
            sigma = engineering(level.sigma, "Pa" if channel == "stress" else "m")
            share = percent(level.sigma / (float(np.ptp(values)) or 1.0))
            slow = f", correlated over {level.time:.1f} samples" if level.time >= 1.05 else ""
            sentences.append(f"{channel} {sigma} ({share} of its range), {level.how}{slow}.")
    return sentences


def _specimen(s: Specimen, spread: dict[str, float]) -> str:
    area = f"{s.area * 1e6:.4g}"
    area += f" ± {spread['area'] * 1e6:.2g}" if "area" in spread else ""
    text = f"height {_uncertain(s.height, 'm', spread.get('height'))}, area {area} mm²"
    if s.mass:
        density = s.mass / (s.area * s.height)
        mass = _uncertain(s.mass * 1e3, "g", spread.get("specimen_mass", 0.0) * 1e3)
        text += f", mass {mass} ({density:.4g} kg/m³)"
    if s.heights:
        springs = [
            _uncertain(h, "m", spread.get(f"height_{i}")) for i, h in enumerate(s.heights, 1)
        ]
        text += f", springs from the base {' + '.join(springs)}"
    return text


def _striker(s: Striker | None, spread: dict[str, float]) -> str:
    if s is None:
        return "none given"
    mass = "mass unknown"
    if s.mass:
        mass = _uncertain(s.mass * 1e3, "g", spread.get("striker_mass", 0.0) * 1e3)
    if not s.velocity:
        return f"{mass}, velocity unknown"
    own = f" ± {spread['velocity']:.2g}" if "velocity" in spread else ""
    return f"{mass}, {s.velocity:.4g}{own} m/s"


def _uncertain(value: float, unit: str, sigma: float | None) -> str:
    """Write a quantity with its standard deviation, if it has one."""
    return engineering(value, unit) + (f" ± {engineering(sigma, unit)}" if sigma else "")


def _samples(test: Measurement) -> str:
    channels, time = test.channels(), test.time
    present = ", ".join(([] if time is None else ["time"]) + list(channels))
    text = f"{max(map(len, channels.values()))} of {present}"
    if time is None:
        return f"{text}; no time, so only slow drives make sense"
    step, end = float(np.median(np.diff(time))), float(time[-1])
    first = engineering(float(time[0]), "s") if time[0] < 0.0 else "time zero"
    return f"{text}, every {engineering(step, 's')} from {first} to {engineering(end, 's')}"


def _peaks(test: Measurement) -> list[tuple[str, list[str]]]:
    """The largest value of each channel, and when it is reached."""
    lines = []
    for name, values in test.channels().items():
        node = interior_node(name)
        if name == "stress":
            top, label, text = int(np.argmax(values)), name, engineering(float(values.max()), "Pa")
        else:
            top, w = largest_motion(values, test.time)
            label, text = f"mass {node}", engineering(w, "m")
            if node is None:
                label, text = "strain", f"{w / test.specimen.height:.4g} ({text})"
        source = f", {test.motion}" if label == "strain" else ""
        moment = "" if test.time is None else f" at {engineering(float(test.time[top]), 's')}"
        lines.append((label, [f"peak {text}{moment}{source}"]))
    return lines
