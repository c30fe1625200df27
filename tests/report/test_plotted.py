"""Beside every figure that is written there is a table of what is plotted in it."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.image import imread

import fabricated
from drawn import figures, insight, with_outliers
from foamfit.errors import InputError
from foamfit.report.figures import HEAD, MOST_POINTS, drawing, image, plotted
from foamfit.report.identifiability_plots import plot_insight
from foamfit.report.page import render_report
from foamfit.report.plots import plot_fit, plot_residuals


def series(figure: Figure) -> dict[tuple[str, str], np.ndarray]:
    """The places (n, 2) of each series of each panel, as the table has them."""
    head, *rows = plotted(figure)
    assert head == HEAD
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for panel, name, _, _, x, y in rows:
        at = tuple(np.nan if cell == "" else float(cell) for cell in (x, y))
        found.setdefault((panel, name), []).append(at)
    return {key: np.array(places) for key, places in found.items()}


def test_what_is_drawn_stands_in_the_table_in_the_units_of_the_axes() -> None:
    result = with_outliers(fabricated.result())
    found, c = series(plot_fit(result)), result.curves
    np.testing.assert_allclose(
        found["stress-time", "fitted"], np.column_stack((c.time * 1e6, c.stress / 1e6)), rtol=1e-5
    )
    np.testing.assert_allclose(
        found["displacement-time", "measured, all samples"][:, 1],
        c.measured_displacement * 1e6,
        rtol=1e-5,
    )
    assert ("stress-strain", "springs along measured strain") in found
    crossed = found["stress-time", "outlier, not fitted"]
    np.testing.assert_allclose(crossed[0], [c.time[100] * 1e6, 2.0], rtol=1e-5)
    for switch, point in zip(result.switches, ("A1", "C1", "C2", "A2"), strict=True):
        at = found["stress-strain", point][0]
        strain = switch.displacement / fabricated.HEIGHT
        np.testing.assert_allclose(at, [strain, switch.stress / 1e6], rtol=1e-5, atol=1e-12)
    letters = {name.split()[-1] for panel, name in found if name.startswith("on branch")}
    assert letters == {"a", "d", "c", "e"}
    _, *rows = plotted(plot_fit(result))
    assert {row[2:4] for row in rows if row[0] == "stress-time"} == {("time (µs)", "stress (MPa)")}


def test_a_microscale_law_is_in_the_table() -> None:
    found = series(plot_fit(fabricated.microscale_result()))
    names = {name for panel, name in found if panel == "stress-strain"}
    assert {"branch a", "branch c", "equilibrium", "σ₊", "σ₋"} <= names
    branch = found["stress-strain", "branch a"]
    stress = 1e3 * branch[:, 1]
    np.testing.assert_allclose(branch[:, 0], stress / (fabricated.MICRO.k0 + stress), rtol=1e-4)


def test_every_line_band_and_mark_is_a_series() -> None:
    """Only lines across a panel, and what a legend alone shows, are decoration."""
    for name, figure in figures():
        for ax in figure.axes:
            drawn = [*ax.lines, *(c for c in ax.collections if isinstance(c, LineCollection))]
            drawn += [c for c in ax.collections if isinstance(c, PolyCollection)]
            for artist in drawn:
                across = not all(artist.get_transform().contains_branch_seperately(ax.transData))
                stem = len(getattr(artist, "get_xdata", list)()) == 2 and name == "comparison"
                unnamed = str(artist.get_label()).startswith("_child")
                assert not unnamed or across or stem, (name, ax.get_label(), artist)


def test_sensitivities_are_in_their_own_unit() -> None:
    figure = plot_insight(insight())
    _, *rows = plotted(figure)
    for curve in insight().curves:
        panel = curve.replace("_", "-")
        drawn = [float(row[5]) for row in rows if row[:2] == (panel, "s1_k0")]
        np.testing.assert_allclose(drawn, 0.01 * insight().along("s1_k0", curve), rtol=1e-5)
    cells = [row for row in rows if row[0].startswith("correlation")]
    of = {(row[1], row[4]): float(row[5]) for row in cells}
    i, j = insight().names.index("s1_kc"), insight().names.index("s1_k0")
    assert of["s1_kc", "s1_k0"] == pytest.approx(insight().correlation[i, j], rel=1e-5)
    edges = [row for row in rows if row[:2] == ("stress-time", "branch d")]
    section = next(one for one in insight().sections if one.branches == "d")
    assert float(edges[0][4]) == pytest.approx(1e6 * insight().clock[section.start], rel=1e-4)
    assert edges[0][5] == ""  # it is there from top to bottom


def test_a_long_line_is_drawn_through_what_can_be_seen() -> None:
    n = 100_000
    x = np.linspace(0.0, 1.0, n)
    y = np.sin(40.0 * x)
    y[[33_333, 77_777]] = 3.0, -2.0
    pictures = []
    for limit in (MOST_POINTS, n):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("foamfit.report.figures.MOST_POINTS", limit)
            with drawing(3.0, 2.0) as figure:
                ax = figure.subplots()
                (line,) = ax.plot(x, y, lw=0.9, label="y")
        pictures.append(image(figure, "png", 100))
        kept = line.get_xydata()
        assert len(kept) == (n if limit == n else pytest.approx(2000, abs=1000))
        assert {3.0, -2.0} <= set(kept[:, 1])
    thin, whole = (imread(io.BytesIO(png))[..., :3] for png in pictures)
    assert np.mean(np.abs(thin - whole) > 0.1) < 0.002


def test_a_folder_has_the_data_of_each_figure_and_the_page_names_them(tmp_path: Path) -> None:
    folder = fabricated.microscale_result().save(tmp_path / "r")
    for name in ("fit", "residuals"):
        with (folder / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert set(rows[0]) == set(HEAD)
        assert {row["series"] for row in rows} & {"fitted", "fitted − measured"}
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.count("<figcaption>Data: ") == page.count("<figure") == 2
    for name in ("fit.csv", "curves.csv", "residuals.csv"):
        assert name in page
    assert "<figcaption>" not in render_report(fabricated.result())


def test_residuals_are_in_the_table() -> None:
    result = fabricated.result()
    found, c = series(plot_residuals(result)), result.curves
    off = 100.0 * (c.stress - c.measured_stress) / np.ptp(c.measured_stress)
    drawn = found["stress-time: fitted − measured", "fitted − measured"]
    np.testing.assert_allclose(drawn[:, 1], off, rtol=1e-4, atol=1e-4)


def test_no_measured_data_are_lost_to_the_table_of_a_figure(tmp_path: Path) -> None:
    (tmp_path / "TEST.csv").write_text("time (ms),force (N)\n0,1\n")
    with pytest.raises(InputError, match=r"TEST\.csv stands where .* name the figure otherwise"):
        plot_fit(fabricated.result(), tmp_path / "TEST.png")
    assert [path.name for path in tmp_path.iterdir()] == ["TEST.csv"]
    for _ in range(2):  # its own table may be replaced
        plot_fit(fabricated.result(), tmp_path / "fit.png")
    assert (tmp_path / "fit.csv").read_text(encoding="utf-8").startswith(",".join(HEAD))
