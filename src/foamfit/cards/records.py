"""The records of the fitted tests: what a card is compared with."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from foamfit.arrays import Array
from foamfit.data.rate import loading_rate
from foamfit.errors import InputError
from foamfit.results import Fit
from foamfit.saved import SavedJoint, load
from foamfit.study.joint_result import JointData


@dataclass(frozen=True, eq=False)
class Record:
    """The record of a fitted test, SI, with the stress that the card has along its motion."""

    rate: float | None  # mean on loading
    time: Array
    strain: Array  # measured; fitted where the test has only the force
    stress: Array  # measured
    motion: Array  # strain that law and card follow: fitted of an impact, else measured
    fitted: Array  # stress of the fit along `motion`
    misfit: float | None  # of the fit
    density: float | None
    card: Array = field(default_factory=lambda: np.empty(0))

    @property
    def misfit_of_card(self) -> float:
        """RMS of card minus measured over the measured range."""
        return float(np.sqrt(np.mean((self.card - self.stress) ** 2)) / np.ptp(self.stress))

    @classmethod
    def of(cls, result: Fit) -> Record:
        """Make it of a fit; zeros of the channels that were fitted are taken off."""
        test, c, impact = result.measurement, result.curves, result.drive == "impact"

        def zero(channel: str) -> float:
            name = f"{channel}_zero"
            found = result.parameters.get(name)
            return found.value - test.origins.get(name, 0.0) if found else 0.0

        measured, specimen = c.measured_displacement, test.specimen
        moved = c.displacement if measured is None else measured
        if c.measured_stress is None or moved is None:
            raise InputError(f"{test.name} has no measured loop, which a card needs")
        fitted = c.stress if impact else c.stress_along
        strain, motion = (
            (one - zero("displacement")) / specimen.height
            for one in (moved, c.displacement if impact and c.displacement is not None else moved)
        )
        # Without a time, the law depends on none.
        steps = np.abs(np.diff(motion, prepend=motion[0])) + 1e-9
        mass, volume = specimen.mass, specimen.height * specimen.area
        return cls(
            rate=loading_rate(test),
            time=np.cumsum(steps) if c.time is None else c.time,
            strain=strain,
            stress=c.measured_stress - zero("stress"),
            motion=motion,
            fitted=(c.measured_stress if fitted is None else fitted) - zero("stress"),
            misfit=result.misfit["stress_time" if impact else "stress_strain"],
            density=None if mass is None else mass / volume,
        )


def read_records(result: object) -> list[Record]:
    """Return the records of the fitted tests of a result of `fit` or `joint`, or of its folder."""
    if isinstance(result, str | Path):
        path = Path(result)
        return read_records(load(path if path.is_dir() else path.parent))
    if isinstance(result, JointData):
        return [Record.of(one()) for one in result.test_fits()]
    if isinstance(result, SavedJoint):
        return [Record.of(one) for one in result.results.values()]
    if isinstance(result, Fit):
        return [Record.of(result)]
    raise InputError(f"a card is made of a result of fit or joint, not of {result!r}")
