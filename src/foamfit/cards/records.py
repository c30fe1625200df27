"""The records of the fitted tests: what a card is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.report.folder import load_result
from foamfit.results import Fit
from foamfit.study.joint_result import JointData

_COLUMNS = (
    *("time (s)", "measured stress (Pa)", "measured displacement (m)"),
    *("fitted stress (Pa)", "fitted displacement (m)", "stress along measured displacement (Pa)"),
)


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
    def of(cls, where: str, content: Mapping[str, Any], columns: Sequence[Array | None]) -> Record:
        """Make it of the content of fit.json and `_COLUMNS`; `where` is for messages.

        Zeros of the channels that were fitted are taken off.
        """

        def zero(channel: str) -> float:
            name = f"{channel}_zero"
            found = content["parameters"].get(name)
            return found["value"] - content["data"]["origins"].get(name, 0.0) if found else 0.0

        time, stress, displacement, pressed, simulated, along = columns
        specimen, moved = (
            content.get("specimen"),
            simulated if displacement is None else displacement,
        )
        if specimen is None or stress is None or moved is None:
            lack = "height of the specimen" if specimen is None else "measured loop"
            raise InputError(f"{where} has no {lack}, which a card needs; fit the test again")
        height, mass, off = specimen["height"], specimen["mass"], content["misfit"]
        impact = content["drive"] == "impact"
        fitted = pressed if impact else along
        strain, motion = (
            (one - zero("displacement")) / height
            for one in (moved, simulated if impact and simulated is not None else moved)
        )
        if time is None:  # the law depends on none
            time = np.cumsum(np.abs(np.diff(motion, prepend=motion[0])) + 1e-9)
        return cls(
            rate=content["data"].get("rate"),
            time=time,
            strain=strain,
            stress=stress - zero("stress"),
            motion=motion,
            fitted=(stress if fitted is None else fitted) - zero("stress"),
            misfit=off["stress_time" if impact else "stress_strain"],
            density=None if mass is None else mass / (height * specimen["area"]),
        )


def read_records(result: object) -> list[Record]:
    """Return the records of the fitted tests of a result of `fit` or `joint`, or of its folder."""
    if isinstance(result, JointData):
        return [record for one in result.test_fits() for record in read_records(one.fit())]
    if isinstance(result, Fit):
        c = result.curves
        measured = (c.time, c.measured_stress, c.measured_displacement)
        columns = (*measured, c.stress, c.displacement, c.stress_along)
        return [Record.of(result.measurement.name, result.to_json_dict(), columns)]
    if not isinstance(result, str | Path):
        raise InputError(f"a card is made of a result of fit or joint, not of {result!r}")
    folder = Path(result) if Path(result).is_dir() else Path(result).parent
    study = folder / "joint.json"
    names = load_result(study)["tests"] if study.is_file() else [""]
    return [_read(folder / name) for name in names]


def _read(folder: Path) -> Record:
    """The record of the test in a folder."""
    path = folder / "curves.csv"
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from None
    columns = [table[name].to_numpy(float) if name in table else None for name in _COLUMNS]
    return Record.of(str(folder), load_result(folder), columns)
