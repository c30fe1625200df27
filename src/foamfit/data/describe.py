"""Text of `foamfit check` on a test."""

from __future__ import annotations

import numpy as np

from foamfit.data.energy import EnergyAudit, largest_motion
from foamfit.data.measurement import Measurement, Striker, interior_node
from foamfit.data.zeros import CONTRADICTED
from foamfit.text import engineering, labelled, listed, percent

# Effect of 1 % of a quantity in an impact and in a slow test (None: no effect), largest first.
EFFECTS = {
    "velocity": ("2 % of the striker's energy and 1 % of its momentum", None),
    "striker_mass": ("1 % of both", None),
    "area": ("1 % of every stress", "1 % of every stress and stiffness"),
    "height": ("1 % of every strain", "1 % of every strain, and so of the stiffnesses"),
}


def describe(test: Measurement, audit: EnergyAudit) -> str:
    """Describe a test: its input, preparation, energy balance, and quantities without a ±."""
    found = audit.contradictions
    told = any(one.quantity == "velocity" for one in found)
    lines = [
        ("test", [test.name]),
        ("file", [str(test.path or "none")]),
        *_given(test),
        ("rows", test.rows.sentences()),
        *_measured(test),
        ("noise", noise_sentences(test)),
        ("done", [note for note in test.notes if not (told and CONTRADICTED in note)]),
        ("energy", audit.sentences()),
        ("settle", [f"[{table}] {line}" for one in found for table, line in one.lines[:1]]),
    ]
    effects = {name.replace("_", " "): effect for name, effect in taken_for_exact(test).items()}
    if effects:
        shares = ", ".join(f"1 % of the {name} is {effect}" for name, effect in effects.items())
        sentences = [
            f"The TOML states no ± of {listed(effects)}, which therefore count as exact.",
            f"The ± of the {next(iter(effects))} would probably matter most: {shares}.",
        ]
        lines.append(("exact", sentences))
    return labelled(lines)


def taken_for_exact(test: Measurement) -> dict[str, str]:
    """Return the quantities without a ± in the TOML and the effect of 1 %, largest first."""
    striker, effects = test.striker or Striker(), dict[str, str]()
    impact = test.time is not None and striker.mass and striker.velocity
    for name, (of_impact, of_slow) in EFFECTS.items():
        effect = of_impact if impact else of_slow
        if name == "striker_mass" and test.braked:
            effect = EFFECTS["area"][0]
        if effect and name not in test.uncertainties:
            effects[name] = effect
    return effects


def noise_sentences(measurement: Measurement) -> list[str]:
    """Return a sentence per channel: standard deviation of the noise, and its source."""
    sentences = []
    for channel, values in measurement.channels().items():
        level = measurement.noise.of(channel)
        if level is not None:
            sigma = engineering(level.sigma, "Pa" if channel == "stress" else "m")
            share = percent(level.sigma / (float(np.ptp(values)) or 1.0))
            slow = f", correlated over {level.time:.1f} samples" if level.time >= 1.05 else ""
            sentences.append(f"{channel} {sigma} ({share} of its range), {level.how}{slow}.")
    return sentences


def _given(test: Measurement) -> list[tuple[str, list[str]]]:
    """Return the lines on specimen and striker, with the ± of each quantity if given."""
    spread, s, striker = test.uncertainties, test.specimen, test.striker

    def with_spread(value: float, unit: str, name: str, scale: float = 1.0) -> str:
        sigma = scale * spread.get(name, 0.0)
        return engineering(scale * value, unit) + (f" ± {engineering(sigma, unit)}" * bool(sigma))

    area = f"{s.area * 1e6:.4g}" + (f" ± {spread['area'] * 1e6:.2g}" if "area" in spread else "")
    specimen = f"height {with_spread(s.height, 'm', 'height')}, area {area} mm²"
    if s.mass:
        density = s.mass / (s.area * s.height)
        specimen += f", mass {with_spread(s.mass, 'g', 'specimen_mass', 1e3)} ({density:.4g} kg/m³)"
    if s.heights:
        springs = [with_spread(h, "m", f"height_{i}") for i, h in enumerate(s.heights, 1)]
        specimen += f", springs from the base {' + '.join(springs)}"
    if striker is None:
        return [("specimen", [specimen]), ("striker", ["none given"])]
    end = f" ± {spread['velocity']:.2g}" if "velocity" in spread else ""
    end += " m/s" + ", falling" * bool(striker.gravity)
    velocity = f"{striker.velocity:.4g}{end}" if striker.velocity else "velocity unknown"
    mass = with_spread(striker.mass, "g", "striker_mass", 1e3) if striker.mass else "mass unknown"
    return [("specimen", [specimen]), ("striker", [f"{mass}, {velocity}"])]


def _measured(test: Measurement) -> list[tuple[str, list[str]]]:
    """Return the lines on the number of samples and on the peak of each channel."""
    channels, time = test.channels(), test.time
    text = f"{max(map(len, channels.values()))} of "
    if time is None:
        text += f"{', '.join(channels)}; no time, so only slow drives make sense"
    else:
        step, end = float(np.median(np.diff(time))), float(time[-1])
        first = engineering(float(time[0]), "s") if time[0] < 0.0 else "time zero"
        text += f"{', '.join(['time', *channels])}, every {engineering(step, 's')} from {first} to "
        text += engineering(end, "s")
    lines = [("samples", [text])]
    for name, values in channels.items():
        node, source = interior_node(name), ""
        if name == "stress":
            top, label, peak = int(np.argmax(values)), name, engineering(float(values.max()), "Pa")
        else:
            top, w = largest_motion(values, time)
            label, peak = f"mass {node}", engineering(w, "m")
            if node is None:
                label, peak = "strain", f"{w / test.specimen.height:.4g} ({peak})"
                source = f", {test.motion}"
        moment = "" if time is None else f" at {engineering(float(time[top]), 's')}"
        lines.append((label, [f"peak {peak}{moment}{source}"]))
    return lines
