"""One bistable spring turned by hand over a measured loop: what moves when a slider moves.

`turn` is the computation and needs no display. `LoopPicture` draws it, and draws again only what
moved. `Turner` joins both to the sliders of a notebook; it alone needs ipywidgets.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.api import FitResult
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.report.plots import BLUE, GREY, STYLE, VERMILION
from foamfit.springs.spring import BistableSpring

Array = NDArray[np.float64]

MPA = 1e6
NAMES = ("k0", "eps_a", "kh_plus", "dsigma", "kc", "eps_c", "kh_minus")  # in the order of the loop
STIFFNESSES = ("k0", "kh_plus", "kc", "kh_minus")
SMOOTH = 200  # samples, each way, of the loop without the noise of the measured strain
ROOM = 0.1  # about the measured loop, as a share of it
WIDTH, HEIGHT = 560, 400  # of the picture in a notebook, px
SHARPNESS = 1.5  # its own pixels for each of them
ROUGH = np.array([0.2, 0.6, 0.4, 0.5, 0.0])  # where the points are taken to lie at first
BESIDE = {  # where the name of a point stands, in typographic points from it
    "A1": (-5, 6, "right"), "C1": (-6, 4, "right"), "C2": (7, -4, "left"), "A2": (6, -8, "left"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Turned:
    """What one setting of the parameters gives.

    Attributes
    ----------
    spring : BistableSpring or None
        None where the setting is not admissible.
    stress : (n,) array or None
        Pa, along the measured strain; None where there is no answer.
    misfit : float or None
        RMS of simulated minus measured over the measured range.
    trouble : str
        Why there is no answer, in one sentence; "" where there is one.
    """

    spring: BistableSpring | None
    stress: Array | None
    misfit: float | None
    trouble: str = ""


def turn(strain: Array, measured: Array, values: Mapping[str, float]) -> Turned:
    """Compute the stress of a bistable spring along a measured strain.

    Parameters
    ----------
    strain, measured : (n,) arrays
        The measured loop: strain, and stress in Pa.
    values : mapping
        k0, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus in SI.

    Returns
    -------
    Turned
        Values that are not admissible raise nothing: `trouble` is the sentence that says why.
    """
    spring = None
    try:
        spring = BistableSpring(**values)
        stress = spring.stress(strain)
    except (InputError, SimulationError) as error:
        return Turned(spring, None, None, str(error))
    misfit = math.sqrt(float(np.mean((stress - measured) ** 2))) / float(np.ptp(measured))
    return Turned(spring, stress, misfit)


def points(spring: BistableSpring) -> dict[str, tuple[float, float]]:
    """Return strain and stress (Pa) of A1, C1, C2 and, where branch e meets branch a, of A2."""
    found = {
        "A1": (spring.eps_a, spring.sigma_a),
        "C1": (spring.eps_hat_c, spring.sigma_hat_c),
        "C2": (spring.eps_c, spring.sigma_c),
    }
    if spring.eps_hat_a is not None and spring.sigma_hat_a is not None:
        found["A2"] = (spring.eps_hat_a, spring.sigma_hat_a)
    return found


def loop_of(measurement: Measurement) -> tuple[Array, Array]:
    """Return strain and stress (Pa) of a test.

    Raises
    ------
    InputError
        If the test has not both.
    """
    if measurement.stress is None or measurement.displacement is None:
        raise InputError(
            f"{measurement.name}: a loop needs a force or stress column, and a displacement or "
            "strain column"
        )
    return measurement.displacement / measurement.specimen.height, measurement.stress


class LoopPicture:
    """A measured loop with a spring over it, of which only the spring is drawn again.

    The spring is drawn along a smooth history up to the largest measured strain and back to A2 or
    the left edge.

    Parameters
    ----------
    strain, measured : (n,) arrays
        The measured loop: strain, and stress in Pa.
    title : str
        Above it.
    """

    def __init__(self, strain: Array, measured: Array, title: str = "") -> None:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        left, right = _limits(strain)
        largest = float(strain.max())
        up, down = np.linspace(0.0, largest, SMOOTH), np.linspace(largest, left, SMOOTH)
        self._history = np.concatenate((up, down[1:]))
        style = STYLE | {"font.size": 9, "axes.labelsize": 9, "axes.titlesize": 9}
        with matplotlib.rc_context(style | {"xtick.labelsize": 8, "ytick.labelsize": 8}):
            size = (WIDTH / 100, HEIGHT / 100)
            self.figure = Figure(figsize=size, dpi=100 * SHARPNESS, layout="constrained")
            self._canvas: Any = FigureCanvasAgg(self.figure)  # matplotlib types it in part
            self._ax = ax = self.figure.subplots()
            ax.set_title(title, loc="left", weight="bold", parse_math=False)
            ax.set_xlabel("strain (–)")
            ax.set_ylabel("stress (MPa)")
            ax.set_xlim(left, right)
            ax.set_ylim(_limits(measured / MPA))
            ax.plot(strain, measured / MPA, "o", ms=2.8, mfc="white", mec=GREY, mew=0.5)
            (self._loop,) = ax.plot([], [], color=VERMILION, lw=1.6)
            (self._dots,) = ax.plot([], [], "o", ms=5, color="black", zorder=5)
            self._names = {
                name: ax.annotate(
                    name, (0.0, 0.0), (dx, dy), textcoords="offset points", ha=side, va="center"
                )
                for name, (dx, dy, side) in BESIDE.items()
            }  # fmt: skip
            self._misfit = ax.text(
                0.02, 0.98, "", transform=ax.transAxes, va="top", color=BLUE, weight="bold"
            )
        self._moving = (self._loop, self._dots, self._misfit, *self._names.values())
        self._still: Any = None

    def show(self, turned: Turned) -> None:
        """Put a spring into the lines; where there is no answer the last one stays, pale."""
        spring = turned.spring
        for artist in self._moving:
            artist.set_alpha(0.25 if turned.trouble else 1.0)
        if spring is None or turned.misfit is None:
            self._misfit.set_text("")
            return
        # It goes no farther than the measured strain, along which there is an answer.
        self._loop.set_data(self._history, spring.stress(self._history) / MPA)
        places = {name: (x, y / MPA) for name, (x, y) in points(spring).items()}
        self._dots.set_data(*zip(*places.values(), strict=True))
        for name, annotation in self._names.items():
            annotation.set_visible(name in places)
            annotation.xy = places.get(name, (0.0, 0.0))
        self._misfit.set_text(f"misfit {turned.misfit:.1%} of the range")

    def png(self) -> bytes:
        """Return the picture, its still part drawn once and kept."""
        from matplotlib.image import imsave

        if self._still is None:
            for artist in self._moving:
                artist.set_animated(True)
            self._canvas.draw()
            self._still = self._canvas.copy_from_bbox(self.figure.bbox)
            for artist in self._moving:  # else they would be missing in a figure that is saved
                artist.set_animated(False)
        self._canvas.restore_region(self._still)
        for artist in self._moving:
            self._ax.draw_artist(artist)
        pixels = np.asarray(self._canvas.buffer_rgba())
        buffer = io.BytesIO()
        imsave(buffer, pixels, format="png", pil_kwargs={"compress_level": 1})  # the time goes here
        return buffer.getvalue()


def _limits(values: Array) -> tuple[float, float]:
    room = ROOM * float(np.ptp(values))
    return float(values.min()) - 0.7 * room, float(values.max()) + room


class Turner:
    """Sliders for the seven parameters, the picture that follows them, and two buttons.

    Parameters
    ----------
    measurement : Measurement
        The test; it needs stress and displacement.
    start : BistableSpring, optional
        Where the sliders stand at first and after "reset"; by default a rough guess from the test.

    Attributes
    ----------
    panel : ipywidgets.VBox
        What to display.
    sliders : dict
        By parameter; stiffness and stress in MPa, stiffness on a logarithmic scale.
    turned : Turned
        What the sliders give.
    result : FitResult or None
        Of the last "fit from here".

    Raises
    ------
    InputError
        If the test has not both stress and displacement.
    """

    def __init__(self, measurement: Measurement, start: BistableSpring | None = None) -> None:
        import ipywidgets

        self.measurement = measurement
        self.strain, self.measured = loop_of(measurement)
        self.start = _values(start) if start is not None else rough_guess(measurement)
        self.picture = LoopPicture(self.strain, self.measured, measurement.name)
        self.result: FitResult | None = None
        self.sliders = {name: self._slider(name) for name in NAMES}
        for slider in self.sliders.values():
            slider.observe(self._moved, names="value")
        wide = ipywidgets.Layout(width="auto")
        reset = ipywidgets.Button(description="reset", icon="undo", layout=wide)
        fit = ipywidgets.Button(
            description="fit from here", icon="crosshairs", button_style="primary", layout=wide
        )
        reset.on_click(lambda _: self.reset())
        fit.on_click(lambda _: self.fit_from_here())
        self.buttons = {"reset": reset, "fit from here": fit}
        self.image = ipywidgets.Image(
            format="png", width=WIDTH, height=HEIGHT, layout=ipywidgets.Layout(flex="0 0 auto")
        )
        self._sentence = ipywidgets.HTML()
        controls = ipywidgets.VBox(
            [*self.sliders.values(), ipywidgets.HBox([reset, fit])],
            layout=ipywidgets.Layout(flex="0 0 auto"),
        )
        row = ipywidgets.HBox(
            [controls, self.image],
            layout=ipywidgets.Layout(flex_flow="row wrap", align_items="center"),
        )
        self.panel = ipywidgets.VBox([row, self._sentence])
        self._silent, self._fitted = False, ""
        self.turned = self.update()

    @property
    def values(self) -> dict[str, float]:
        """What the sliders say, in SI."""
        return {name: slider.value * _unit(name) for name, slider in self.sliders.items()}

    @property
    def sentence(self) -> str:
        """What stands below the picture: what is not admissible, or how the last fit went."""
        return self.turned.trouble or self._fitted

    def set(self, values: Mapping[str, float]) -> None:
        """Move sliders to values in SI, wider than they were made where need be; draws once."""
        self._silent = True
        try:
            for name, value in values.items():
                _widen(self.sliders[name], value / _unit(name), name in STIFFNESSES)
                self.sliders[name].value = value / _unit(name)
        finally:
            self._silent = False
        self.update()

    def reset(self) -> None:
        """Move the sliders back to where they started."""
        self._fitted = ""
        self.set(self.start)

    def update(self) -> Turned:
        """Compute and draw what the sliders say."""
        self.turned = turn(self.strain, self.measured, self.values)
        self.picture.show(self.turned)
        self.image.value = self.picture.png()
        self._say()
        return self.turned

    def fit_from_here(self) -> None:
        """Fit the spring, without a dashpot, from where the sliders stand; move them to the fit."""
        from foamfit.api import fit
        from foamfit.fitting.problem import make_params

        if self.turned.trouble:
            return  # it is said already
        self.buttons["fit from here"].disabled = True
        self._say("Fitting …")
        try:
            params = make_params(self.measurement, "bistable")
            for name, value in self.values.items():
                params[f"s1_{name}"].value = value
            params["s1_eta"].set(value=0.0, vary=False)
            result = fit(self.measurement, model="bistable", params=params)
        except (InputError, SimulationError) as error:
            self._say(f"No fit: {error}")
            return
        finally:
            self.buttons["fit from here"].disabled = False
        self.result = result
        took = f"Fitted in the {result.drive} drive in {result.runtime_s:.1f} s."
        self._fitted = " ".join((took, *result.warnings))
        self.set(_values(result.bistable_springs["s1"]))

    def _slider(self, name: str) -> Any:
        import ipywidgets

        value = self.start[name] / _unit(name)
        common = {
            "description": name + (" (MPa)" if _unit(name) == MPA else ""),
            "style": {"description_width": "105px"},
            "layout": ipywidgets.Layout(width="320px"),
        }
        if name in STIFFNESSES:
            middle = math.log10(max(value, 1e-6))
            return ipywidgets.FloatLogSlider(
                value=value, min=middle - 1.5, max=middle + 1.5, step=0.002,
                readout_format=".4g", **common,
            )  # fmt: skip
        if name == "dsigma":
            low, high = min(-0.3 * float(self.measured.max()) / MPA, 1.5 * value), 0.0
        else:
            low, high = 0.0, max(1.2 * float(self.strain.max()), 1.2 * value)
        return ipywidgets.FloatSlider(
            value=value, min=low, max=high, step=(high - low) / 2000, readout_format=".4f", **common
        )

    def _moved(self, _: object) -> None:
        if not self._silent:
            self.update()

    def _say(self, passing: str = "") -> None:
        from html import escape

        colour = VERMILION if self.turned.trouble else "inherit"
        said = escape(passing or self.sentence)
        self._sentence.value = f'<span style="color: {colour}">{said}</span>'


def _unit(name: str) -> float:
    return 1.0 if name.startswith("eps") else MPA


def _values(spring: BistableSpring) -> dict[str, float]:
    return {name: getattr(spring, name) for name in NAMES}


def rough_guess(measurement: Measurement) -> dict[str, float]:
    """Read a spring off the loop as the fit does for its starts, the points only roughly placed."""
    from foamfit.fitting.box import Scales
    from foamfit.fitting.search import Loop, read_spring, smooth_loop
    from foamfit.springs.parameters import BISTABLE_NAMES

    strain, stress = loop_of(smooth_loop(measurement))
    spring = read_spring(Loop(strain, stress), ROUGH, Scales.of(measurement))
    values = dict(zip(BISTABLE_NAMES, map(float, spring), strict=True))
    return {name: values[name] for name in NAMES}


def _widen(slider: Any, value: float, logarithmic: bool) -> None:
    if logarithmic:
        value = math.log10(max(value, 1e-6))
    slider.min = min(slider.min, value)
    slider.max = max(slider.max, value)
