"""Check the balances of energy and momentum of a test.

The energy of the striker per volume of foam, m v²/(2 A H), must equal the work of the stress up to
the largest strain. The impulse of the force must equal the striker's change of momentum.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from foamfit.arrays import Array
from foamfit.data.calibration import Contradiction, balance, contradictions
from foamfit.data.measurement import INTEGRATED, UNITS, Measurement, Striker
from foamfit.data.noise import noise_level
from foamfit.text import engineering, percent, times

_OTHER_CYCLE = 0.95  # a motion falls below this share of its maximum between two cycles


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
        return {k: v for k, v in (asdict(self) | texts).items() if k != "contradictions"}

    def warnings(self) -> list[str]:
        """Return one sentence for each contradiction and each balance that does not close."""
        wrong = [f"Check: {one.says}." for one in self.contradictions]
        return wrong + self.energy_warnings() + self.loop_warnings()

    def energy_warnings(self) -> list[str]:
        """Return a sentence if the foam absorbs another energy than the striker brings."""
        taken, brought = self.absorbed_over_striker, "the energy that the striker brings"
        if taken is None or 0.9 <= taken <= 1.05 or self.damping is not None:  # that takes it up
            return []
        if taken > 1.05:
            how = f"{times(taken)} times {brought}, which is impossible"
            wrong = "mass, velocity, force and motion do not agree"
        else:
            how = f"only {times(taken)} of {brought}"
            wrong = "mass, velocity, force and motion do not agree, or the record ends too early"
        return [f"Check: the foam absorbs {how}; {wrong}."]

    def loop_warnings(self) -> list[str]:
        """Return a sentence if the loop gives out energy."""
        if self.dissipated_fraction is None or self.dissipated_fraction >= -0.02:
            return []
        why = "either the record runs backwards, or force and motion are swapped"
        return [f"Check: the loop gives out more energy than it takes up; {why}."]

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
            # The warning of a contradiction has the ratio that the motion shows.
            how = f"ratio {self.impulse_ratio:.2f}"
            how = "by the velocity given" if self.contradictions else how
            results.append(
                f"The impulse of the force is {self.impulse:.4g} N·s, the striker's change of "
                f"momentum {self.momentum_change:.4g} N·s ({how})."
            )
        if self.damping is not None:
            by = f"an onsite damper, η = {engineering(self.damping, 'Pa·s')}"
            results += [f"The striker's motion shows {by}, whose force the sensor does not see."]
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
    unloaded = float(stress[-3:].mean()) < 0.1 * float(stress.max())
    if w is not None:
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
        missing.append("The absorbed energy needs a displacement.")
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
        striker_energy=brought, absorbed_energy=absorbed, dissipated_energy=dissipated,
        dissipated_fraction=dissipated / absorbed if dissipated is not None and absorbed else None,
        absorbed_over_striker=absorbed / brought if absorbed is not None and brought else None,
        rebound_velocity=rebound, impulse=impulse, momentum_change=change,
        impulse_ratio=impulse / change if impulse is not None and change else None,
        motion=test.motion, missing=tuple(missing), contradictions=contradictions(test, shown),
        damping=None if shown.damping is None else shown.damping[0],
    )  # fmt: skip


def _momentum(test: Measurement, unloaded: bool) -> tuple[float | None, float | None, float | None]:
    """Return impulse of the force, N·s, rebound velocity, m/s, and change of momentum, N·s.

    The change of momentum includes the impulse of the weight of a falling striker.
    """
    striker, stress, w, time = test.striker, test.stress, test.displacement, test.time
    if striker is None or time is None:
        return None, None, None
    lead = 0.5 * stress[0] * max(time[0], 0.0)
    impulse = test.specimen.area * float(np.trapezoid(stress, time) + lead)
    if w is None or not unloaded:
        return impulse, None, None
    # A gauge at rest again after contact no longer follows the striker.
    shown = np.flatnonzero(test.sampled.get("displacement", np.ones(len(w), dtype=bool)))
    last = shown[-max(5, len(shown) // 20) :]
    rebound = -float(np.polyfit(time[last] - time[last[-1]], w[last], 1)[0])
    if not (striker.mass and striker.velocity) or test.motion == INTEGRATED:
        return impulse, rebound, None
    fall = (striker.gravity or 0.0) * float(time[-1])
    return impulse, rebound, striker.mass * (striker.velocity + rebound + fall)


def largest_motion(displacement: Array, time: Array | None = None) -> tuple[int, float]:
    """Return the sample of the largest displacement, and the displacement there without noise.

    The largest sample is biased by noise, so a quartic is fitted to the samples near the maximum.
    """
    floor = displacement.max() - 8.0 * noise_level(displacement)
    below = displacement < min(floor, _OTHER_CYCLE * displacement.max())
    between = np.concatenate(([-1], np.flatnonzero(below), [displacement.size]))
    at = int(np.searchsorted(between, np.argmax(displacement)))
    start, end = between[at - 1] + 1, between[at]
    near = start + np.flatnonzero(displacement[start:end] >= floor)
    region = np.arange(near[0], near[-1] + 1)
    if len(region) < 12:
        top = int(np.argmax(displacement))
        return top, float(displacement[top])
    x = region.astype(np.float64) if time is None else time[region]
    x = 2.0 * (x - x[0]) / (x[-1] - x[0]) - 1.0
    turn = np.polyval(np.polyfit(x, displacement[region], 4), x)
    top = int(np.argmax(turn))
    return int(region[top]), float(turn[top])


def noise_sentences(measurement: Measurement) -> list[str]:
    """Return a sentence per channel: standard deviation of the noise, and its source."""
    sentences = []
    for channel, values in measurement.channels().items():
        level = measurement.noise.of(channel)
        if level is not None:
            sigma = engineering(level.sigma, UNITS.get(channel, "m"))
            share = percent(level.sigma / (float(np.ptp(values)) or 1.0))
            slow = f", correlated over {level.time:.1f} samples" if level.time >= 1.05 else ""
            sentences.append(f"{channel} {sigma} ({share} of its range), {level.how}{slow}.")
    return sentences
