"""The figure and the page of a joint fit."""

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

import foamfit as ff
from conftest import AREA, HEIGHT
from foamfit.data.measurement import Measurement, Noise, Specimen
from foamfit.fitting.problem import make_problem
from foamfit.fitting.together import Links, Together
from foamfit.parts import ParameterEstimate
from foamfit.report.figures import images
from foamfit.study.joint_fit import fit_jointly
from foamfit.study.joint_result import (
    Alternative,
    JointResult,
    JointTest,
    joint_page,
    plot_joint,
    result_of,
)
from foamfit.study.study_file import Study

RATES = (0.01, 0.1, 1.0)
KINDS = {
    "s1_k0": "shared", "s1_kc": "scatter", "s1_eps_star": "shared", "s1_sigma_plus": "log rate",
    "s1_spread_plus": "own", "s1_sigma_minus": "shared", "s1_spread_minus": "shared",
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> JointResult:
    """Fit three loops jointly, starting at the true values; one test name contains HTML."""
    up = np.linspace(0.0, 0.5, 50)
    strain, names = np.concatenate([up, up[::-1][1:]]), ("first", "second", "<i>third</i>")
    problems, vectors, x = [], [], np.log(np.array(RATES) / 0.1)
    for i, name in enumerate(names):
        spring = ff.MicroscaleSpring(
            k0=5.5e5, kc=4e5 * (0.9, 1.0, 1.15)[i], eps_star=0.3, spread_plus=0.4,
            sigma_plus=1.1e5 * (1.0 + 0.05 * x[i]), sigma_minus=7e4, spread_minus=0.6,
        )  # fmt: skip
        stress = spring.stress(strain)
        stress = stress + 400.0 * np.random.default_rng(i).standard_normal(stress.size)
        test = Measurement(
            name=name, path=None, data_sha256="", time=np.arange(99.0), stress=stress,
            displacement=strain * HEIGHT, specimen=Specimen(HEIGHT, AREA),
            noise=Noise(stress=400.0), motion="measured",
        )  # fmt: skip
        one = make_problem(test, "microscale", None, None, None, interior_mass=False)
        values = one.vector()
        for short in KINDS:
            values[one.index[short]] = getattr(spring, short[3:])
        problems.append(one)
        vectors.append(values)
    fit = fit_jointly(problems, Links(KINDS, x), [vectors])
    here = tmp_path_factory.mktemp("study") / "study.toml"
    study = Study(
        here, "a & b", tuple((name, here, None) for name in names), "microscale", 0,
        "displacement", KINDS, {}, 0, None, None,
    )  # fmt: skip
    evidence = (
        Alternative("s1_sigma_plus", "log rate", True, 10.0, 13, 300.0),
        Alternative("s1_sigma_plus", "own", False, 14.0, 14, 299.0),
    )
    files, alone = dict.fromkeys(names, here), Together.of_own_fits(problems, vectors)
    about = {"rate0": 0.1, "evidence": evidence, "refused": {}, "runtime_s": 1.0}
    made = result_of(study, files, RATES, fit, alone, {}, **about)
    words = {"warnings": ("x.csv is left out: it holds <nothing>.",), "sentences": ("Said.",)}
    return replace(made, status="warnings", **words)


@pytest.fixture(scope="module")
def page(found, tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("joint")
    (folder / "<i>third</i>").mkdir(parents=True)
    (folder / "<i>third</i>" / "report.html").write_text("")
    return joint_page(found, folder, b"<svg/>")


def test_the_page_needs_nothing_else_and_escapes_names(page):
    assert not re.search(r'(src|href)="(?!data:|[^"]*report\.html)', page)
    assert "<i>third</i>" not in page
    assert "a &amp; b" in page
    assert "it holds &lt;nothing&gt;." in page
    assert 'href="%3Ci%3Ethird%3C/i%3E/report.html"' in page


def test_the_page_has_every_parameter_and_test(found, page):
    for name, one in found.parameters.items():
        assert (f"<code>{name}</code>" in page) == (one.kind != "fixed")
    body = page.split('<table class="sortable">')[1]
    assert body.count("<tr>") == 1 + 3
    # values of individual tests have the unit in the heading
    value = found.parameters["s1_kc"].tests["first"].value
    assert re.search(rf'data-v="{value / 1e3:.0f}(\.\d)?">', body)
    assert re.search(r"b = 0\.0\d+ \(0\.0\d+ to 0\.0\d+\)", page)
    assert page.count("<td>log rate</td>") == 2  # in the parameter and evidence tables
    for line in found.text().splitlines()[3:8]:  # the terminal rounds as the page does
        assert [end for end in re.findall(r"\S+ to \S+", line) if end not in page] == []


def test_the_picture_has_the_loops_and_the_law_of_rate(found):
    figure = plot_joint(found)
    loops = figure.subfigs[0].axes[0]
    assert [line.get_label() for line in loops.lines][1::2] == [
        "first, 0.01/s", "second, 0.1/s", "<i>third</i>, 1/s",
    ]  # fmt: skip
    panel = next(ax for ax in figure.subfigs[1].axes if ax.get_label() == "s1_sigma_plus")
    assert panel.get_xlabel().startswith("log rate, b = 0.0")
    law = next(line for line in panel.lines if line.get_label() == "common").get_xdata()
    assert law[-1] / law[0] == pytest.approx((1 + 0.05 * 2.303) / (1 - 0.05 * 2.303), rel=0.02)
    assert images(figure, "png", dpi=50)[0].startswith(b"\x89PNG")


def test_parameters_stand_side_by_side(found):
    figure = plot_joint(found)
    axes = figure.subfigs[1].axes
    panels = {ax.get_label(): ax for ax in axes if ax.axison}
    assert list(panels) == [name for name in found.parameters if name in KINDS]
    assert [text.get_text() for text in axes[0].get_yticklabels()] == [
        "first, 0.01/s", "second, 0.1/s", "<i>third</i>, 1/s",
    ]  # fmt: skip
    key = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"determined", "95 % interval", "common", "spread between specimens"} <= set(key)
    points = next(line for line in panels["s1_kc"].lines if line.get_label() == "determined")
    kc = [found.parameters["s1_kc"].tests[test].value / 1e3 for test in found.tests]
    assert points.get_xdata().tolist() == kc
    assert points.get_ydata().tolist() == [0, 1, 2]
    low, high = panels["s1_k0"].get_xlim()
    assert low < found.parameters["s1_k0"].value / 1e3 < high
    lost = {
        t: replace(one, value=1e9, state="not determined", ci95=None) if t == "second" else one
        for t, one in found.parameters["s1_kc"].tests.items()
    }
    kc = replace(found.parameters["s1_kc"], tests=lost)
    figure = plot_joint(replace(found, parameters={"s1_kc": kc}), width="one")
    assert figure.get_figwidth() == 3.25
    assert figure.subfigs[1].axes[0].get_xlim()[1] < 1e3
    assert "beyond the panel" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_result_in_python_draws_its_loops(found):
    assert repr(found).startswith("a & b: microscale · 3 tests together · status warnings")
    assert len(found.plot(Figure().subplots()).lines) == 6


def test_the_table_has_the_common_values_alone_if_no_test_has_values_of_its_own():
    shared = ParameterEstimate(5.5e5, state="determined", kind="shared")
    tests = dict.fromkeys(("first", "second"), JointTest())
    table = JointResult("study", "linear", tests, {"s1_k0": shared}).table()
    assert table.index.to_list() == [("", "s1_k0")]
