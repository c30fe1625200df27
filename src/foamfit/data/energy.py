"""Check the balances of energy and momentum of a test, and describe it.

The energy of the striker per volume of foam, m v²/(2 A H), must equal the work of the stress up to
the largest strain. The impulse of the force must equal the striker's change of momentum.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from foamfit.arrays import Array
from foamfit.data.calibration import Contradiction, balance, contradictions
from foamfit.data.measurement import INTEGRATED, Measurement, Striker, interior_node
from foamfit.data.noise import line_at, noise_level
from foamfit.data.zeros import CONTRADICTED
from foamfit.text import engineering, labelled, listed, percent


@dataclass(frozen=True)
class EnergyAudit:
    """Energy and momentum of one test; a value is None if the data for it are missing."""

    striker_energy: float | None = None  #: kinetic, at contact, per volume of foam, J/m³
    absorbed_energy: float | None = None  #: ∫σ dε up to the largest strain, J/m³
    dissipated_energy: float | None = None  #: ∫σ dε over the whole history, J/m³
    dissipated_fraction: float | None = None  #: of the absorbed energy
    absorbed_over_striker: float | None = None  #: ratio of energies
    rebound_velocity: float | None = None  #: of the top at the end of contact, m/s
    impulse: float | None = None  #: ∫F dt over contact, N·s
    momentum_change: float | None = None  #: m (v_in + v_out), N·s
    impulse_ratio: float | None = None  #: impulse over change of momentum
    motion: str | None = None  #: source of the displacement
    missing: tuple[str, ...] = ()  #: a sentence for each quantity that could not be computed
    contradictions: tuple[Contradiction, ...] = ()  #: numbers that the record contradicts
    damping: float | None = None  #: η of an onsite damper that the striker's motion shows, Pa·s

    def as_dict(self) -> dict[str, float | str | None]:
        """Return the audit as plain values; `missing` and `warnings` are joined to one text."""
        texts = {"missing": " ".join(self.missing), "warnings": " ".join(self.warnings())}
        plain = asdict(self) | texts
        del plain["contradictions"]
        return plain

    def warnings(self) -> list[str]:
        """Return one sentence for each contradiction and each balance that does not close."""
        wrong = [f"Check: {one.says}." for one in self.contradictions]
        return wrong + self.energy_warnings() + self.loop_warnings()

    def energy_warnings(self) -> list[str]:
        """Return a sentence if the foam absorbs another energy than the striker brings."""
        found, taken = [], self.absorbed_over_striker
        if self.damping is not None:  # which takes up energy
            return []
        if taken is not None and taken > 1.05:
            found.append(
                f"Check: the foam absorbs {taken:.2f} times the energy that the striker brings, "
                "which is impossible; mass, velocity, force and motion do not agree."
            )
        elif taken is not None and taken < 0.9:
            found.append(
                f"Check: the foam absorbs only {taken:.2f} of the energy that the striker brings; "
                "mass, velocity, force and motion do not agree, or the record ends too early."
            )
        return found

    def loop_warnings(self) -> list[str]:
        """Return a sentence if the loop gives out energy."""
        if self.dissipated_fraction is None or self.dissipated_fraction >= -0.02:
            return []
        return [
            "Check: the loop gives out more energy than it takes up; either the record runs "
            "backwards, or force and motion are swapped."
        ]

    def sentences(self) -> list[str]:
        """Return the results, the warnings and the missing quantities, one sentence each."""
        ratio, share, results = self.absorbed_over_striker, self.dissipated_fraction, list[str]()
        if self.striker_energy is not None:
            results.append(f"The striker brings {engineering(self.striker_energy, 'J/m³')}.")
        if self.absorbed_energy is not None:
            more = "" if ratio is None else f", {ratio:.2f} of what the striker brings"
            taken = engineering(self.absorbed_energy, "J/m³")
            results.append(f"The foam absorbs {taken} up to the largest strain{more}.")
        if self.dissipated_energy is not None and share is not None:
            lost = engineering(self.dissipated_energy, "J/m³")
            results.append(f"It dissipates {lost}, {percent(share)} of that.")
        if self.rebound_velocity is not None:
            results.append(f"The striker leaves at {self.rebound_velocity:.3g} m/s.")
        if self.impulse is not None and self.momentum_change is not None:
            results.append(
                f"The impulse of the force is {self.impulse:.4g} N·s, the striker's change of "
                f"momentum {self.momentum_change:.4g} N·s (ratio {self.impulse_ratio:.2f})."
            )
        if self.damping is not None:
            results.append(
                "The striker's motion shows an onsite damper, "
                f"η = {engineering(self.damping, 'Pa·s')}, whose force the sensor does not see."
            )
        return [*results, *self.warnings(), *self.missing]


def audit(test: Measurement) -> EnergyAudit:
    """Check the balances of energy and momentum of a test."""
    striker, specimen, missing = test.striker or Striker(), test.specimen, list[str]()
    stress, w, time = test.stress, test.displacement, test.time
    brought = absorbed = dissipated = None
    if striker.mass and striker.velocity:
        brought = striker.mass * striker.velocity**2 / (2 * specimen.area * specimen.height)
    else:
        missing.append("The striker's energy needs its mass and velocity.")
    unloaded = stress is not None and float(stress[-3:].mean()) < 0.1 * float(stress.max())
    if stress is not None and w is not None:
        strain = w / specimen.height
        top, largest = largest_motion(w, time)
        # Before the first sample, stress and strain rise linearly from zero.
        before = 0.5 * float(max(stress[0], 0.0) * max(strain[0], 0.0))
        absorbed = before + float(np.trapezoid(stress[: top + 1], strain[: top + 1]))
        # The integral ends at a noisy strain; correct it to the smoothed largest strain.
        absorbed += float(stress[top]) * (largest / specimen.height - float(strain[top]))
        if brought is not None and striker.mass:
            weight = striker.mass * (striker.gravity or 0.0)
            brought += weight * largest / (specimen.area * specimen.height)
        dissipated = before + float(np.trapezoid(stress, strain)) if unloaded else None
    if absorbed is None:
        missing.append("The absorbed energy needs stress and displacement.")
    elif dissipated is None:
        missing.append("The dissipated energy needs the unloading.")
    impulse, rebound, change = _momentum(test, unloaded)
    shown = balance(test)
    if test.motion == INTEGRATED:
        missing.append(
            "The motion was integrated from the force, so the balances are not independent."
        )
    elif change is None:
        missing.append("The balance of momentum needs an impact of known mass with its rebound.")
    return EnergyAudit(
        striker_energy=brought,
        absorbed_energy=absorbed,
        dissipated_energy=dissipated,
        dissipated_fraction=dissipated / absorbed if dissipated is not None and absorbed else None,
        absorbed_over_striker=absorbed / brought if absorbed is not None and brought else None,
        rebound_velocity=rebound,
        impulse=impulse,
        momentum_change=change,
        impulse_ratio=impulse / change if impulse is not None and change else None,
        motion=test.motion,
        missing=tuple(missing),
        contradictions=contradictions(test, shown),
        damping=None if shown.damping is None else shown.damping[0],
    )


def _momentum(test: Measurement, unloaded: bool) -> tuple[float | None, float | None, float | None]:
    """Return impulse of the force, N·s, rebound velocity, m/s, and change of momentum, N·s.

    The change of momentum includes the impulse of the weight of a falling striker.
    """
    striker, stress, w, time = test.striker, test.stress, test.displacement, test.time
    if striker is None or time is None or stress is None:
        return None, None, None
    lead = 0.5 * stress[0] * max(time[0], 0.0)
    impulse = test.specimen.area * float(np.trapezoid(stress, time) + lead)
    if w is None or not unloaded:
        return impulse, None, None
    # A gauge at rest again after contact no longer follows the striker.
    shown = np.flatnonzero(test.sampled.get("displacement", np.ones(len(w), dtype=bool)))
    last = shown[-max(5, len(shown) // 20) :]
    rebound = -line_at(time[last], w[last], time[last[-1]])[1]
    if not (striker.mass and striker.velocity) or test.motion == INTEGRATED:
        return impulse, rebound, None
    fall = (striker.gravity or 0.0) * float(time[-1])
    return impulse, rebound, striker.mass * (striker.velocity + rebound + fall)


def largest_motion(displacement: Array, time: Array | None = None) -> tuple[int, float]:
    """Return the sample of the largest displacement, and the displacement there without noise.

    The largest sample is biased by noise, so a quartic is fitted to the samples near the maximum.
    """
    floor = displacement.max() - 8.0 * noise_level(displacement)
    near = np.flatnonzero(displacement >= floor)
    region = np.arange(near[0], near[-1] + 1)
    if len(region) < 12:
        top = int(np.argmax(displacement))
        return top, float(displacement[top])
    x = region.astype(np.float64) if time is None else time[region]
    x = 2.0 * (x - x[0]) / (x[-1] - x[0]) - 1.0
    turn = np.polyval(np.polyfit(x, displacement[region], 4), x)
    top = int(np.argmax(turn))
    return int(region[top]), float(turn[top])


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
