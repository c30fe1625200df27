"""Comparison of fits with published values and with each other: values, errors, omissions."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fabricated
import foamfit as ff
from conftest import NAMES, run
from foamfit.api import FitResult
from foamfit.errors import InputError
from foamfit.report.comparison import (
    Comparison,
    Pair,
    Row,
    compare,
    comparison_text,
    plot_comparison,
    recognised,
)
from foamfit.results import Correlation
from foamfit.springs import laws


def published_fit(
    name: str = "foam-1/model-1", *, off: float = 0.0, test: str = "", **changed: Any
) -> FitResult:
    """Return a result with all values `off` standard errors (1 %) from the published ones."""
    item = ff.published[name]
    made = {}
    for i, spring in enumerate(item.chain.springs, start=1):
        shorts = NAMES if isinstance(spring, ff.BistableSpring) else ("k0",)
        for short in shorts:
            value = getattr(spring, short)
            stderr = 0.01 * abs(value)
            shifted = value + off * stderr
            made[f"s{i}_{short}"] = fabricated.estimate(f"s{i}_{short}", shifted, stderr=stderr)
        if len(item.chain.springs) > 1:
            height = item.chain.heights[i - 1]
            made[f"s{i}_height"] = fabricated.estimate(
                f"s{i}_height", height, stderr=None, vary=False, state="fixed", why="held fixed"
            )
    made["s1_eta"] = fabricated.estimate("s1_eta", 12.0, stderr=3.0)
    made["site_eta"] = fabricated.estimate(
        "site_eta", 0.0, stderr=None, vary=False, state="fixed", why="held fixed"
    )
    base = fabricated.result()
    measurement = replace(base.measurement, name=test or f"VACNT {name}", data_sha256=test or name)
    given = {"model": item.model, "parameters": made, "measurement": measurement, "status": "ok"}
    return replace(base, **(given | changed))


def with_parameter(result: FitResult, name: str, **changed: Any) -> FitResult:
    changed_one = replace(result.parameters[name], **changed)
    return replace(result, parameters=result.parameters | {name: changed_one})


def only(comparison: Comparison) -> Pair:
    (section,) = comparison.pairs
    return section


def row(section: Pair, label: str) -> Row:
    return next(row for row in section.rows if row.label == label)


def stated(row: Row) -> float:
    assert row.reference is not None
    return row.reference.value


@pytest.mark.parametrize("name", list(ff.published))
def test_the_published_values_are_shown_in_the_units_of_the_paper(name: str) -> None:
    section = only(compare([published_fit(name)]))
    table = {
        "foam-1/model-1": (5.50, -0.20, 0.14, 0.31, 2.60, 0.450, 15),
        "foam-1/model-2": (5.50, -0.20, 0.14, 0.31, 2.60, 0.425, 15),
        "foam-1/model-3": (2, -0.32, 0.35, 0.71, 3.40, 0.525, 30),
        "foam-2": (5.75, -0.80, 0.40, 0.70, 6.00, 0.200, 40),
    }[name]
    spring = "" if name in ("foam-1/model-1", "foam-1/model-2") else "s2 "
    for label, value in zip(
        ("k0", "Δσ/σ_a", "ε_a", "ε_c", "k_h+/k0", "k_h−/k0", "k_c/k0"), table, strict=True
    ):
        found = row(section, spring + label)
        assert found.fitted.value == pytest.approx(value)
        assert stated(found) == pytest.approx(value)
        assert found.percent == pytest.approx(0.0, abs=1e-9)
    if spring:
        assert stated(row(section, "s1 k0")) == pytest.approx(60 if name != "foam-2" else 250)
        assert stated(row(section, "s2 h")) == pytest.approx(0.49 if name != "foam-2" else 0.756)


def test_independent_errors_of_a_ratio_add_in_squares_and_the_text_says_so() -> None:
    result = published_fit()
    section = only(compare([result]))
    assert row(section, "k_c/k0").fitted.stderr == pytest.approx(15 * math.hypot(0.01, 0.01))
    # Δσ (1 - ε_a)/(k0 ε_a): the relative error of ε_a is multiplied by 1/(1 - ε_a)
    drop = 0.2 * math.sqrt(0.01**2 + 0.01**2 + (0.01 / 0.86) ** 2)
    assert row(section, "Δσ/σ_a").fitted.stderr == pytest.approx(drop)
    assert "fit.json contains no correlations" in comparison_text(compare([result]))


@pytest.mark.parametrize("rho", [-0.8, 0.5, 0.99])
def test_the_correlation_enters_the_error_of_a_ratio(rho: float) -> None:
    names = ("s1_kc", "s1_k0")
    correlation = Correlation(names, np.array([[1.0, rho], [rho, 1.0]]), np.array([5.0, 7.0]))
    result = published_fit(correlation=correlation)
    comparison = compare([result])
    expected = 15 * 0.01 * math.sqrt(2 - 2 * rho)
    assert row(only(comparison), "k_c/k0").fitted.stderr == pytest.approx(expected)
    assert "no correlation" not in comparison_text(comparison)
    content = json.loads(json.dumps(result.to_json_dict()))
    matrix, stderr = [[1.0, rho], [rho, 1.0]], [5.0, 7.0]
    assert content["correlation"] == {"names": list(names), "matrix": matrix, "stderr": stderr}
    assert compare([content]) == comparison


def test_what_is_not_determined_has_no_deviation_also_in_a_ratio() -> None:
    lost = with_parameter(
        published_fit(), "s1_kh_minus", stderr=None, state="not determined",
        why="branch e of spring 1 was never reached",
    )  # fmt: skip
    found = row(only(compare([lost])), "k_h−/k0")
    assert found.fitted.state == "not determined"
    assert (found.percent, found.standard_errors) == (None, None)
    text = comparison_text(compare([lost]))
    assert "k_h−/k0: not determined: branch e of spring 1 was never reached." in text
    weak = with_parameter(published_fit(), "s1_k0", state="weak")
    section = only(compare([weak]))
    assert {row(section, name).fitted.state for name in ("k0", "k_c/k0", "Δσ/σ_a")} == {"weak"}
    assert row(section, "ε_a").fitted.state == "determined"


def test_the_published_damping_is_answered_in_words() -> None:
    text = comparison_text(compare([published_fit("foam-1/model-2")]))
    section = only(compare([published_fit("foam-1/model-2")]))
    eta, zeta = row(section, "η"), row(section, "ζ")
    assert (eta.fitted.value, stated(eta), eta.percent) == (12.0, 1e4, None)
    # damping ratio of 12 Pa s by the formula that gives 0.845 for the published 1e4 Pa s
    ratio = ff.published["foam-1/model-2"].damping_ratio_by_formula()
    assert zeta.fitted.value == pytest.approx(ratio * 12.0 / 1e4)
    assert zeta.fitted.stderr == pytest.approx(zeta.fitted.value * math.hypot(0.25, 0.005))
    assert (stated(zeta), zeta.percent) == (0.894, None)
    assert "a physical viscosity" in " ".join(text.split())
    assert "gives 0.845, but the paper states 0.894" in " ".join(text.split())


def test_other_springs_are_not_compared() -> None:
    result = published_fit("foam-1/model-3", off=1.0)
    comparison = compare([result], published="foam-1/model-1")
    assert all(r.percent is None for r in only(comparison).rows)
    text = comparison_text(comparison)
    assert "The springs differ (linear+bistable and bistable)" in text
    assert "%" not in text.split("Published numbers")[0]


@pytest.mark.parametrize(
    ("test", "name"),
    [
        ("VACNT foam-1/model-3 at 2.0 m/s (reconstruction)", "foam-1/model-3"),
        ("VACNT foam-2 at 4.5 m/s", "foam-2"),
        ("VACNT foam-1", None),
        ("my foam-2b", None),
        ("shoe", None),
    ],
)
def test_a_test_is_recognised_by_its_name(test: str, name: str | None) -> None:
    assert recognised(test) == name


def test_unknown_tests_are_compared_with_the_first() -> None:
    one, two = published_fit(test="monday"), published_fit(test="tuesday", off=3.0)
    section = only(compare([one, two]))
    assert section.other.label.startswith("monday")
    found = row(section, "k0")
    expected = 0.03 / math.hypot(0.01, 0.01)  # both errors are 1 %
    assert found.standard_errors == pytest.approx(expected)
    assert row(section, "η").percent == pytest.approx(0.0)
    assert "same data" not in comparison_text(compare([one, two]))
    assert "same data" in comparison_text(compare([one, one]))
    other_drive = replace(two, drive="displacement")
    assert row(only(compare([one, other_drive])), "η").percent is None


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(ff.InputError, match=r"names no published set.*foam-1/model-1.*foam-2"):
        compare([published_fit(test="shoe")])
    with pytest.raises(ff.InputError, match=r"no published set 'foam-3'.*foam-1/model-1"):
        compare([published_fit()], published="foam-3")
    with pytest.raises(ff.InputError, match="at least one"):
        compare([])
    with pytest.raises(ff.InputError, match="cannot be read back"):
        compare([{"schema": 1, "test": "foam-2"}])


def test_the_figure_has_a_panel_for_each_parameter_and_a_row_for_each_result(
    tmp_path: Path,
) -> None:
    one = published_fit(off=2.0)
    lost = with_parameter(one, "s1_kc", state="not determined", stderr=None)
    comparison = compare([replace(one, drive="stress"), lost, published_fit("foam-2", off=5.0)])
    figure = plot_comparison(comparison, tmp_path / "c.png")
    assert (tmp_path / "c.png").stat().st_size > 10_000
    panels = {ax.get_label(): ax for ax in figure.axes if ax.axison}
    rows = {r.label: r for r in comparison.pairs[0].rows}
    assert {"k0", "k_c/k0", "s1 k0", "s2 ε_a"} <= set(panels)
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == [
        "foam-1/model-1, stress", "foam-1/model-1, impact", "foam-2, impact",
    ]  # fmt: skip
    points = {line.get_label(): line.get_xydata() for line in panels["k_c/k0"].lines}
    value = rows["k_c/k0"].fitted.value
    np.testing.assert_allclose(points["determined"], [(value, 0)])
    np.testing.assert_allclose(points["not determined"], [(value, 1)])
    drawn = {one.get_label(): one for one in panels["k0"].collections}
    ends = np.array(drawn["95 % interval"].get_segments())[:, :, 0]
    middle = rows["k0"].fitted.value
    half = 1.96 * rows["k0"].fitted.stderr
    np.testing.assert_allclose(ends, 2 * [(middle - half, middle + half)])
    assert drawn["published"].get_segments()[0][0, 0] == pytest.approx(5.5)
    key = [text.get_text() for text in figure.legends[0].get_texts()]
    assert key == ["determined", "not determined", "published", "95 % interval"]


def test_the_command_prints_and_draws(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "fit.json").write_text(json.dumps(published_fit().to_json_dict()))
    one, plot = (str(tmp_path / name) for name in ("one", "c.svg"))
    done = run("compare", one, "--plot", plot)
    assert "compared with published foam-1/model-1" in done.stdout
    assert Path(plot).is_file()


def test_microscale_fits_stand_beside_each_other() -> None:
    one = fabricated.microscale_result()
    stiffer = {
        name: replace(p, value=1.1 * p.value) if p.vary else p for name, p in one.parameters.items()
    }
    pair = compare([one, replace(one, parameters=stiffer)]).pairs[0]
    labels = ["k0", "k_c", "ε_*", "σ₊", "s₊", "σ₋", "s₋", "g_1", "τ_1"]
    assert [row.label for row in pair.rows] == labels
    assert [row.percent for row in pair.rows] == [pytest.approx(10.0)] * 9
    assert pair.side.law == "microscale with relaxation"
    rows = {row.label: row for row in pair.rows}
    assert (stated(rows["σ₊"]), rows["σ₊"].unit) == (pytest.approx(0.106), "MPa")
    assert (stated(rows["τ_1"]), rows["τ_1"].unit) == (0.25, "s")
    heads = [ax.get_title() for ax in plot_comparison(compare([one, one])).axes if ax.axison]
    assert heads[-2:] == ["$g_{1}$", "$τ_{1}$ (ms)"]
    assert "$σ_{+}$ (MPa)" in heads


def test_no_published_set_has_microscale_springs() -> None:
    one = fabricated.microscale_result()
    named = replace(one.measurement, name="VACNT foam-1/model-1")
    one = replace(one, measurement=named)
    assert compare([one, one]).reference == "reference"  # although a published set has this name
    told = comparison_text(compare([one], "foam-1/model-1"))
    assert "The published sets have no microscale springs, so there are no" in told
    with pytest.raises(InputError, match="no published set has microscale springs; give a second"):
        compare([one])


def test_a_law_of_ones_own_is_compared_parameter_by_parameter(monkeypatch) -> None:
    params = (ff.Param("k", ("k", "1"), "Pa"), ff.Param("limit", ("z", "m")))
    law = replace(laws.law("linear"), kind="own", params=params, compared=(), hysteretic=True)
    monkeypatch.setitem(laws._LAWS, "own", law)
    made = {
        "s1_k": fabricated.estimate("s1_k", 2e6),
        "s1_limit": fabricated.estimate("s1_limit", 0.1),
    }
    one = replace(fabricated.result(), model="own", parameters=made)
    pair = only(compare([one, one]))
    assert [(row.label, row.unit, row.fitted.value) for row in pair.rows] == [
        ("k_1", "MPa", pytest.approx(2.0)),
        ("z_m", "", pytest.approx(0.1)),
    ]
