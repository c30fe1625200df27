from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fabricated
import foamfit as ff
from foamfit.api import FitResult
from foamfit.errors import InputError
from foamfit.report.figures import images, save
from foamfit.report.plots import origin_word, plot_fit, plot_response, plot_snapping
from foamfit.results import Switch


def with_curves(result: FitResult, **changed: Any) -> FitResult:
    return replace(result, curves=replace(result.curves, **changed))


def panels(result: FitResult) -> list[Any]:
    """Return the panels of a fit without the residual panels."""
    return [ax for ax in plot_fit(result).axes if not ax.get_label().endswith("residual")]


def texts(ax: Any) -> list[str]:
    return [text.get_text() for text in ax.texts]


def line(ax: Any, label: str) -> Any:
    return next(line for line in ax.lines if line.get_label() == label)


def test_three_panels_with_units() -> None:
    figure = plot_fit(fabricated.result())
    stress, motion, loop, *residuals = figure.axes
    assert [ax.get_ylabel() for ax in (stress, motion, loop)] == [
        "stress (MPa)", "displacement (µm)", "stress (MPa)",
    ]  # fmt: skip
    assert len(residuals) == 2  # the misfit of the loop is None
    for below in residuals:
        assert (below.get_xlabel(), below.get_ylabel()) == ("time (µs)", "residual\n(% of range)")
    assert loop.get_xlabel() == "strain (–)"
    assert figure.get_figwidth() == 7.0
    curves = fabricated.result().curves
    np.testing.assert_allclose(line(stress, "fitted").get_ydata(), curves.stress / 1e6)
    np.testing.assert_allclose(line(motion, "fitted").get_xdata() / 1e6, curves.time)
    strain = curves.measured_displacement / fabricated.HEIGHT
    np.testing.assert_allclose(line(loop, "springs along measured strain").get_xdata(), strain)


def test_masses_inside_are_drawn_with_the_top() -> None:
    time = fabricated.result().curves.time
    measured, fitted = 1e-4 * np.sin(time / time[-1]), 1.1e-4 * np.sin(time / time[-1])
    result = with_curves(fabricated.chain_result(), interior={1: (measured, fitted)})
    figure = plot_fit(result)
    displacement_time, residuals = figure.axes[1], figure.axes[-1]
    np.testing.assert_allclose(line(displacement_time, "mass 1").get_ydata(), fitted * 1e6)
    points = line(displacement_time, "_measured, mass 1")
    expected = np.interp(points.get_xdata() / 1e6, time, measured * 1e6)
    np.testing.assert_allclose(points.get_ydata(), expected, atol=1e-9)
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["measured", "fitted", "mass 1", "springs along measured strain"]
    colours = [one.get_color() for one in residuals.lines[:2]]
    assert colours[1] == line(displacement_time, "mass 1").get_color() != colours[0]
    without = with_curves(result, time=None)
    assert [ax.get_xlabel() for ax in panels(without)] == ["strain (–)"]


def test_switches_and_branches_are_named() -> None:
    *in_time, loop = panels(fabricated.result())
    for ax in in_time:
        assert texts(ax) == ["A1", "C1", "C2", "A2"]
    assert set(texts(loop)) == {"A1", "C1", "C2", "A2", "a", "d", "c", "e"}


@pytest.mark.parametrize("later", [0.0, 15e-6])
def test_names_of_springs_that_switch_together_do_not_overprint(later: float) -> None:
    result = fabricated.chain_result()
    curves, switches = result.curves, list(result.switches)
    for switch in result.switches:
        at = int(np.argmin(np.abs(curves.time - switch.time - later)))
        place = (curves.time[at], curves.displacement[at], curves.stress[at])
        switches.append(Switch(1, switch.source, switch.target, *map(float, place)))
    figure = plot_fit(replace(result, switches=tuple(switches)))
    images(figure, "png", dpi=100)
    for ax in figure.axes[:3]:
        assert len(ax.texts) == 8
        boxes = [text.get_window_extent() for text in ax.texts]
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


@pytest.mark.parametrize(
    ("missing", "labels"),
    [
        (["time"], ["strain (–)"]),
        (["measured_displacement", "displacement", "stress_along"], ["time (µs)"]),
        (["measured_stress", "stress", "stress_along"], ["time (µs)"]),
        (["measured_stress", "stress", "stress_along", "time"], []),
    ],
)
def test_a_panel_without_curves_is_left_out(missing: list[str], labels: list[str]) -> None:
    result = with_curves(fabricated.result(), **dict.fromkeys(missing))
    figure = plot_fit(result)
    assert [ax.get_xlabel() for ax in figure.axes if ax.axison and ax.get_xlabel()] == labels
    assert images(figure, "png")[0]


def test_the_origin_is_visible_even_if_only_a_note_tells_it() -> None:
    measurement = fabricated.result().measurement
    noted = replace(measurement, name="foam " * 40, notes=("This is a reconstruction.",))
    result = fabricated.result(measurement=noted)
    assert "reconstruction" in plot_fit(result).get_suptitle()
    plain = replace(measurement, name="foam-1", notes=())
    assert origin_word(fabricated.result(measurement=plain)) is None
    assert (
        origin_word(fabricated.result(measurement=replace(plain, name="Synthetic 3")))
        == "synthetic"
    )


def test_a_name_is_no_formula_and_may_be_in_any_script() -> None:
    measurement = replace(fabricated.result().measurement, name=r"$\frac{1$ 測試")
    assert images(plot_fit(fabricated.result(measurement=measurement)), "png")[0]


def test_a_figure_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    for name, words in (("fit.docx", r"not 'fit\.docx'"), ("none/fit.png", "cannot be written")):
        with pytest.raises(InputError, match=words):
            save(plot_fit(fabricated.result()), tmp_path / name)


@pytest.mark.parametrize("name", ["foam-1/model-1", "foam-1/model-3"])
def test_a_response_has_three_panels(name: str, tmp_path: Path) -> None:
    chain = ff.published[name].chain
    time = np.linspace(0.0, 1.2e-3, 301)
    response = ff.simulate(chain, ff.Impact(7e-3, 2.0), time)
    figure = plot_response(response, tmp_path / "response.png")
    assert (tmp_path / "response.png").read_bytes().startswith(b"\x89PNG")
    stress, motion, loop = figure.axes
    assert [ax.get_xlabel() for ax in figure.axes] == ["time (ms)"] * 2 + ["overall strain (–)"]
    assert (stress.get_ylabel(), motion.get_ylabel()) == ("base stress (MPa)", "displacement (µm)")
    assert np.allclose(stress.lines[0].get_ydata(), response.base_stress / 1e6)
    labelled = [str(line.get_label()) for line in motion.lines[: len(chain.springs)]]
    assert labelled == [*(f"node {i}" for i in range(1, len(chain.springs))), "top"]
    assert np.allclose(
        motion.lines[len(chain.springs) - 1].get_ydata(), 1e6 * response.displacement[-1]
    )
    key = [text.get_text() for text in figure.legends[0].get_texts()]
    assert set(key) == {*labelled, "end of contact"}
    # After contact the striker flies freely, so the stress-strain curve ends there.
    assert response.contact_end is not None
    assert len(loop.lines[0].get_xdata()) == int(np.sum(time <= response.contact_end))


def test_a_prescribed_motion_is_not_drawn_and_residuals_stand_below_large_curves() -> None:
    result = fabricated.microscale_result()
    figure = plot_fit(result, width="two, untitled")
    loop, stress_time, *below = figure.axes
    assert [ax.get_xlabel() for ax in figure.axes] == ["", "", "strain (–)", "time (s)"]
    c = result.curves
    off = 100 * (c.stress - c.measured_stress) / np.ptp(c.measured_stress)
    for above, strip in zip((loop, stress_time), below, strict=True):
        np.testing.assert_allclose(strip.lines[0].get_ydata(), off)
        assert strip.get_xlim() == above.get_xlim()
    figure.draw_without_rendering()
    sizes = [ax.get_position().size for ax in figure.axes]
    assert np.prod(sizes[0]) > 1.3 * np.prod(sizes[1]) > 2.0 * np.prod(sizes[2])
    assert figure.get_suptitle() == ""
    assert "shoe foam" in plot_fit(result).get_suptitle()


def test_a_microscale_loop_has_its_branches_and_medians() -> None:
    result = fabricated.microscale_result()
    loop, stress_time, _, _ = plot_fit(result).axes
    assert texts(stress_time) == ["σ₊", "σ₋"]
    assert texts(loop) == ["a", "c", "σ₊", "σ₋", "snap-through", "held", "snap-back"]
    marks = [line.get_xydata() for line in loop.lines if line.get_color() == "black"]
    for (strain, stress), median, up in zip(
        np.concatenate(marks), (106.0, 79.0), (True, False), strict=True
    ):
        assert stress == pytest.approx(median, rel=0.02)
        way = [0.0, strain] if up else [0.0, 0.6, strain]
        assert float(fabricated.MICRO.stress(way)[-1]) / 1e3 == pytest.approx(stress)
    limits = loop.get_ylim()
    assert limits[1] < 1.2 * np.max(result.curves.stress) / 1e3  # branch a extends much higher
    equilibrium = line(loop, "equilibrium")
    np.testing.assert_allclose(equilibrium.get_ydata(), result.curves.stress / 1e3)


def test_the_fraction_snapped_is_drawn_over_time_and_in_pictures_of_the_foam() -> None:
    result = fabricated.microscale_result()
    figure = plot_snapping(result)
    assert figure is not None
    strip, below = figure.axes
    fraction = result.snapping["s1"].fraction
    np.testing.assert_allclose(line(below, "snapped").get_ydata(), 100 * fraction)
    np.testing.assert_allclose(
        line(below, "ever snapped").get_ydata(), 100 * np.maximum.accumulate(fraction)
    )
    whole, shaded = strip.patches[6:8]  # the fourth of seven stages, at maximum strain
    assert whole.get_height() == pytest.approx(0.4, abs=0.004)  # height at 60 % strain
    assert shaded.get_height() / whole.get_height() == pytest.approx(fraction.max(), 0.01)
    assert plot_snapping(fabricated.result()) is None
