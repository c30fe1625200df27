"""Describe a test: its input, preparation, energy balance, and quantities without a ±."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from foamfit.data.energy import EnergyAudit, largest_motion, noise_sentences
from foamfit.data.measurement import UNITS, Measurement, Striker
from foamfit.data.zeros import CONTRADICTED
from foamfit.report.render import sentences
from foamfit.text import labelled

# Effect of 1 % of a quantity in an impact and in a slow test (None: no effect), largest first.
EFFECTS = {
    "velocity": ("2 % of the striker's energy and 1 % of its momentum", None),
    "striker_mass": ("1 % of both", None),
    "area": ("1 % of every stress", "1 % of every stress and stiffness"),
    "height": ("1 % of every strain", "1 % of every strain, and so of the stiffnesses"),
}


def describe(test: Measurement, audit: EnergyAudit) -> str:
    """Describe a test for the terminal."""
    channels, time = test.channels(), test.time
    told = any(one.quantity == "velocity" for one in audit.contradictions)
    peaks = dict[str, tuple[float, float | None]]()
    for name, values in channels.items():
        top, size = int(np.argmax(values)), float(values.max())
        if name != "stress":
            top, size = largest_motion(values, time)
        peaks[name] = size, None if time is None else float(time[top])
    lines = sentences(
        "described",
        test=test,
        audit=audit,
        spreads=defaultdict(float, test.uncertainties),
        count=max(map(len, channels.values())),
        step=None if time is None else float(np.median(np.diff(time))),
        peaks=peaks,
        units=UNITS,
        noises=noise_sentences(test),
        notes=[note for note in test.notes if not (told and CONTRADICTED in note)],
        remedies=[
            f"[{where}] {line}" for one in audit.contradictions for where, line in one.lines[:1]
        ],
        exact=taken_for_exact(test),
    )
    return labelled((label, text) for label, _, text in (line.partition("¦") for line in lines))


def taken_for_exact(test: Measurement) -> dict[str, str]:
    """Return the quantities without a ± in the TOML and the effect of 1 %, largest first."""
    striker, effects = test.striker or Striker(), dict[str, str]()
    impact = test.time is not None and striker.mass and striker.velocity
    for name, (of_impact, of_slow) in EFFECTS.items():
        effect = of_impact if impact else of_slow
        if name == "striker_mass" and test.braked:
            effect = EFFECTS["area"][0]
        if effect and name not in test.uncertainties:
            effects[name.replace("_", " ")] = effect
    return effects
