"""One bistable spring turned by hand over a measured loop, with the sliders of a notebook."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from foamfit import api
from foamfit.api import FitResult
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.report.figures import GREY, STYLE, VERMILION, image
from foamfit.springs.spring import BistableSpring

Array = NDArray[np.float64]
MPA = 1e6
# Of each parameter in the order of the loop: the unit of its slider.
UNITS = {
    "k0": MPA, "eps_a": 1.0, "kh_plus": MPA, "dsigma": MPA, "kc": MPA, "eps_c": 1.0, "kh_minus": MPA
}  # fmt: skip
POINTS = {"A1": ("eps_a", "sigma_a"), "C1": ("eps_hat_c", "sigma_hat_c"),
          "C2": ("eps_c", "sigma_c"), "A2": ("eps_hat_a", "sigma_hat_a")}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Turned:
    """Stress (Pa) along the measured strain and its misfit over range, or why there is none."""

    spring: BistableSpring | None
    stress: Array | None
    misfit: float | None
    trouble: str = ""


def turn(strain: Array, measured: Array, values: Mapping[str, Any]) -> Turned:
    """Compute the stress of a bistable spring with values in SI along a measured strain."""
    spring = None
    try:
        spring = BistableSpring(**values)
        stress = spring.stress(strain)
    except (InputError, SimulationError) as error:
        return Turned(spring, None, None, str(error))
    misfit = math.sqrt(float(np.mean((stress - measured) ** 2))) / float(np.ptp(measured))
    return Turned(spring, stress, misfit)


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


def plot_loop(measurement: Measurement, turned: Turned) -> Figure:
    """Draw the measured loop and, where it is admissible, the spring with its points."""
    strain, measured = loop_of(measurement)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 3.6))
        ax = figure.add_axes((0.11, 0.12, 0.86, 0.8))
        ax.set_title(measurement.name, loc="left", weight="bold", parse_math=False)
        ax.set(xlabel="strain (–)", ylabel="stress (MPa)")
        ax.plot(strain, measured / MPA, "o", ms=2.6, mfc="white", mec=GREY, mew=0.5)
        spring, told = turned.spring, "not admissible"
        if spring is not None and turned.misfit is not None:
            there = np.linspace(0.0, strain.max(), 200)
            path = np.concatenate((there, there[::-1]))
            ax.plot(path, spring.stress(path) / MPA, color=VERMILION, lw=1.4)
            for point, (x, y) in POINTS.items():
                if getattr(spring, x) is not None:  # A2 is missing where e and a do not meet
                    at = (getattr(spring, x), getattr(spring, y) / MPA)
                    ax.annotate(point, at, (6, -7), textcoords="offset points")
                    ax.plot(*at, "o", ms=4, color="black")
            told = f"misfit {turned.misfit:.1%} of the range"
        ax.text(0.02, 0.97, told, transform=ax.transAxes, va="top", weight="bold")
    return figure


class Turner:
    """Sliders for the seven parameters (moduli in MPa), their picture, "reset", "fit from here".

    Display `panel`. `turned` is what the sliders give, `sentence` what stands below the picture,
    `result` the last fit. They start at `start`, by default at a rough guess from the test.
    """

    def __init__(self, measurement: Measurement, start: BistableSpring | None = None) -> None:
        import ipywidgets as widgets

        self.measurement = measurement
        self.result: FitResult | None = None
        self.strain, self.measured = loop_of(measurement)
        self.start = {n: getattr(start, n) for n in UNITS} if start else rough_guess(measurement)
        self.sliders: dict[str, Any] = {}
        for name, unit in UNITS.items():
            value = self.start[name] / unit
            low, high = sorted((0.0, 4.0 * value or -0.1))
            self.sliders[name] = widgets.FloatSlider(
                value, min=low, max=high, step=(high - low) / 4000, readout_format=".4g",
                description=name if unit == 1.0 else f"{name} (MPa)",
                style={"description_width": "105px"},
            )  # fmt: skip
            self.sliders[name].observe(lambda _: self.update(), names="value")
        self.buttons = {n: widgets.Button(description=n) for n in ("reset", "fit from here")}
        self.buttons["reset"].on_click(lambda _: self.reset())
        self.buttons["fit from here"].on_click(lambda _: self.fit_from_here())
        self.image, self._below = widgets.Image(format="png"), widgets.Label()
        left = widgets.VBox([*self.sliders.values(), widgets.HBox(list(self.buttons.values()))])
        self.panel = widgets.VBox([widgets.HBox([left, self.image]), self._below])
        self.update()

    @property
    def values(self) -> dict[str, float]:
        """What the sliders say, in SI."""
        return {name: slider.value * UNITS[name] for name, slider in self.sliders.items()}

    @property
    def sentence(self) -> str:
        """What stands below the picture: what is not admissible, or how the last fit went."""
        return str(self._below.value)

    def set(self, values: Mapping[str, float]) -> None:
        """Move sliders to values in SI, beyond their ends where need be."""
        for name, value in values.items():
            slider, new = self.sliders[name], value / UNITS[name]
            slider.min, slider.max = min(slider.min, new), max(slider.max, new)
            slider.value = new

    def reset(self) -> None:
        """Move the sliders back to where they started."""
        self.set(self.start)

    def update(self) -> Turned:
        """Compute and draw what the sliders say."""
        self.turned = turn(self.strain, self.measured, self.values)
        self.image.value = image(plot_loop(self.measurement, self.turned), "png", 100)
        self._below.value = self.turned.trouble
        return self.turned

    def fit_from_here(self) -> None:
        """Fit the spring, without a dashpot, from where the sliders stand; move them to the fit."""
        from foamfit.fitting.problem import make_params

        if self.turned.trouble:
            return  # it is said already
        self.buttons["fit from here"].disabled, self._below.value = True, "Fitting …"
        try:
            params = make_params(self.measurement, "bistable")
            for name, value in self.values.items():
                params[f"s1_{name}"].value = value
            params["s1_eta"].set(value=0.0, vary=False)
            self.result = result = api.fit(self.measurement, model="bistable", params=params)
            self.set({name: getattr(result.bistable_springs["s1"], name) for name in UNITS})
            took = f"Fitted in the {result.drive} drive in {result.runtime_s:.1f} s."
            self._below.value = " ".join((took, *result.warnings))
        except (InputError, SimulationError) as error:
            self._below.value = f"No fit: {error}"
        finally:
            self.buttons["fit from here"].disabled = False
