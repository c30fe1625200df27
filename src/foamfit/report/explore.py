"""One bistable spring over a measured loop: what the sliders of a notebook draw."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.report.figures import GREY, STYLE, VERMILION
from foamfit.springs.spring import BistableSpring

MPA = 1e6
# Of each parameter in the order of the loop: the unit in which it reads well.
UNITS = {
    "k0": MPA, "eps_a": 1.0, "kh_plus": MPA, "dsigma": MPA, "kc": MPA, "eps_c": 1.0, "kh_minus": MPA
}  # fmt: skip
POINTS = {"A1": ("eps_a", "sigma_a"), "C1": ("eps_hat_c", "sigma_hat_c"),
          "C2": ("eps_c", "sigma_c"), "A2": ("eps_hat_a", "sigma_hat_a")}  # fmt: skip


def loop_of(measurement: Measurement) -> tuple[Array, Array]:
    """Return strain and stress (Pa) of a test; InputError if it has not both."""
    if measurement.stress is None or measurement.displacement is None:
        raise InputError(f"{measurement.name}: a loop needs a force or stress column, and a "
                         "displacement or strain column")  # fmt: skip
    return measurement.displacement / measurement.specimen.height, measurement.stress


def rough_guess(measurement: Measurement) -> dict[str, float]:
    """Read a spring off the loop as the fit does for its starts, its points at typical places."""
    from foamfit.fitting.box import Scales
    from foamfit.fitting.search import Loop, read_spring, smooth_loop

    loop, places = Loop(*loop_of(smooth_loop(measurement))), np.array([0.2, 0.6, 0.4, 0.5, 0.0])
    seven = read_spring(loop, places, Scales.of(measurement)).tolist()[:7]
    return {name: getattr(BistableSpring(*seven), name) for name in UNITS}


def plot_loop(measurement: Measurement, values: Mapping[str, float]) -> Figure:
    """Draw the measured loop, and the spring of the values (SI) or why there is none."""
    strain, measured = loop_of(measurement)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 3.6))
        ax = figure.add_axes((0.11, 0.12, 0.86, 0.8))
        ax.set_title(measurement.name, loc="left", weight="bold", parse_math=False)
        ax.set(xlabel="strain (–)", ylabel="stress (MPa)")
        ax.plot(strain, measured / MPA, "o", ms=2.6, mfc="white", mec=GREY, mew=0.5)
        try:
            spring = BistableSpring(**dict[str, Any](values))
            off = math.sqrt(float(np.mean((spring.stress(strain) - measured) ** 2)))
            told = f"misfit {off / float(np.ptp(measured)):.1%} of the range"
            there = np.linspace(0.0, strain.max(), 200)
            path = np.concatenate((there, there[::-1]))
            ax.plot(path, spring.stress(path) / MPA, color=VERMILION, lw=1.4)
            for point, (x, y) in POINTS.items():
                if getattr(spring, x) is not None:  # A2 is missing where e and a do not meet
                    at = (getattr(spring, x), getattr(spring, y) / MPA)
                    ax.annotate(point, at, (6, -7), textcoords="offset points")
                    ax.plot(*at, "o", ms=4, color="black")
        except (InputError, SimulationError) as error:
            told = textwrap.fill(str(error), 70)
        ax.text(0.02, 0.97, told, transform=ax.transAxes, va="top", weight="bold")
    return figure
