"""The records of the fitted tests, with which a card is compared, and the picture of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.cards.curves import Curves
from foamfit.data.rate import loading_rate
from foamfit.errors import InputError
from foamfit.report import figures
from foamfit.report.figures import BLUE, VERMILION
from foamfit.report.readable import readable_unit
from foamfit.results import Fit
from foamfit.saved import SavedJoint, load
from foamfit.study.joint_result import JointResult
from foamfit.text import percent, significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES: dict[str, Any] = {
    "measured": {"color": "0.65", "linewidth": 1.8},
    "fitted": {"color": BLUE, "linewidth": 0.9},
    "card": {"color": VERMILION, "linewidth": 1.0, "linestyle": (0, (5, 1.2))},
}
WIDTH, HEIGHT = 2.7, 2.9  # of a panel, inches
MOST = 3  # records that are drawn: the slowest, the middle and the fastest


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
    if isinstance(result, JointResult):
        return [Record.of(one()) for one in result.test_fits()]
    if isinstance(result, SavedJoint):
        return [Record.of(one) for one in result.results.values()]
    if isinstance(result, Fit):
        return [Record.of(result)]
    raise InputError(f"a card is made of a result of fit or joint, not of {result!r}")


def draw(
    name: str, misfit: Mapping[str, float | None], records: Sequence[Record], curves: Curves
) -> Figure:
    """Draw the records with law and card along them, and the loading curves to their ends."""
    known = {name: value for name, value in misfit.items() if value is not None}
    told = ", ".join(f"{name} {percent(value)}" for name, value in known.items())
    shown = sorted(records, key=lambda one: one.rate or 0.0)
    if len(shown) > MOST:
        shown = [shown[0], shown[len(shown) // 2], shown[-1]]
    width = WIDTH * (len(shown) + 1)
    title = figures.title_lines(width, name, f"misfit: {told}")
    factor, unit = readable_unit(max(float(one.stress.max()) for one in shown), "Pa")
    with figures.drawing(width, HEIGHT, title) as figure:
        axes = figure.subplots(1, len(shown) + 1)
        for ax, one in zip(axes, shown, strict=False):
            loops = ((one.strain, one.stress), (one.motion, one.fitted), (one.motion, one.card))
            drawn = {
                name: ax.plot(strain, stress / factor, **style)[0]
                for (name, style), (strain, stress) in zip(STYLES.items(), loops, strict=True)
            }
            rate = "rate not known" if one.rate is None else f"{significant(one.rate, 3)} 1/s"
            ax.set(title=rate, xlabel="strain", ylabel=f"stress ({unit})")
        ax, inside = axes[-1], curves.measured
        factor, unit = readable_unit(float(curves.stress.max()), "Pa")
        shades = np.linspace(1.0, 0.4, len(curves.rates))[::-1]
        for shade, stress in zip(shades, curves.stress / factor, strict=True):
            style: Any = {"color": VERMILION, "alpha": float(shade), "linewidth": 1.0}
            ax.plot(curves.strain[:inside], stress[:inside], **style)
            ax.plot(curves.strain[inside - 1 :], stress[inside - 1 :], linestyle=":", **style)
        ax.set(title="loading; dotted: extrapolated", xlabel="strain", ylabel=f"stress ({unit})")
        figures.legend_below(figure, drawn)
    return figure
