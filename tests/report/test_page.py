"""The report as a page: what it shows and hides, and what the terminal shows of a result."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fabricated
from conftest import run, without_pictures, write_csv
from foamfit.report.plots import figures_of
from foamfit.report.render import readable
from foamfit.report.summary import render_report, summary_text


class Page(HTMLParser):
    """Parser that collects the references, tags and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.text, self.shown, self.folded = "", "", 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in ("meta", "img", "source"):
            self.open.append(tag)
        names = ("src", "href", "srcset", "action", "data", "poster")
        self.references += [value or "" for name, value in attrs if name in names]
        self.folded += tag == "details"

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        self.folded -= tag == "details"

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += " " + data
            # In a folded section only the outermost summary is visible.
            titles = self.folded == 1 and "summary" in self.open
            self.shown += " " + data if not self.folded or titles else ""

    @property
    def words(self) -> str:
        return " ".join(self.text.split())


def page(**changed: Any) -> Page:
    return Page(render_report(fabricated.result(**changed), fabricated.no_figures()))


def test_the_page_needs_nothing_else() -> None:
    text = render_report(fabricated.result(), figures_of(fabricated.result()))
    whole = Page(text)
    assert whole.open == []  # every tag is closed, in order
    assert len(whole.references) == 1  # the figure of the fit
    assert all(ref.startswith("data:image/svg+xml;base64,") for ref in whole.references)
    assert not re.search(r"@import|url\(|<link|<script", text)
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)


def test_text_from_files_is_escaped() -> None:
    evil = "<script>alert('x')</script> & \"co\""
    result = fabricated.result()
    changed = {
        "measurement": replace(result.measurement, name=evil, notes=(evil,), motion=evil),
        "warnings": (evil,),
        "parameters": {evil: fabricated.estimate("s1_k0", 1.0, why=evil, state=evil, unit=evil)},
        "energy": {evil: 1.0, "sentences": [evil]},
        "visited": {"s1": (evil,)},
    }
    whole = page(**changed)
    assert "script" not in whole.tags
    assert whole.text.count(evil) >= 8
    assert evil not in render_report(fabricated.result(**changed), fabricated.no_figures())


def test_misfit_figure_parameters_and_warnings_come_first_and_the_rest_is_folded() -> None:
    text = render_report(fabricated.result(), fabricated.no_figures())
    shown = " ".join(Page(text).shown.split())
    order = ["warnings Misfit stress-time 1.2 % , displacement-time 0.4 %", "Parameters", "s1_k0",
             "s1_kh_minus is not determined: branch e was never reached.",
             "Misfits and statistics"]  # fmt: skip
    assert [shown.index(one) for one in order] == sorted(shown.index(one) for one in order)
    assert text.index("Misfit\n") < text.index("<img") < text.index("<h2>Parameters")
    assert "Journal of Applied Mechanics" not in shown
    assert "Warnings" not in page(warnings=(), status="ok").words
    assert shown.count("No acceptable fit was found") == 0
    assert "No acceptable fit was found" in page(status="failed").shown


def test_the_page_says_what_was_found() -> None:
    words = page().words
    for said in (
        "bistable model, impact drive · reconstruction, not a measurement",
        "SHA-256 5d41402abc4b2a76",
        "stress-time 1.2 % displacement-time 0.4 % stress-strain none",
        "s1_kc k c,1 82.50 ± 0.99 MPa 80.56 to 84.44 weak its interval is wider than half",
        "s1_kh_minus k h−,1 2.300 MPa – not determined branch e was never reached",
        "σ a stress at A1, where snapping starts 895.3 kPa",
        "The striker brings 0.0107 J. The loop takes less. striker kinetic J 0.01072",
        "The force was divided by the area 19.6 mm².",
        "starts 16 simulations 4210 run time 21.4 s",
    ):
        assert said in words


@pytest.mark.parametrize(
    ("value", "stderr", "unit", "expected"),
    [
        (5.5e6, 12.3e3, "Pa", ("5.500 ± 0.012", "MPa")),
        (5.5e6, 0.0996e6, "Pa", ("5.50 ± 0.10", "MPa")),
        (-179070.0, 2148.0, "Pa", ("−179.1 ± 2.1", "kPa")),
        (12345.6, 148.0, "Pa s", ("12350 ± 150", "Pa·s")),
        (0.0, 300.0, "Pa·s", ("0 ± 300", "Pa·s")),
        (5.5e6, 1e-6, "Pa", ("5.500000 ± 1.0e-12", "MPa")),
        (5.5e6, None, "Pa", ("5.500", "MPa")),
        (float("nan"), 1.0, "Pa", ("–", "Pa")),
    ],
)
def test_value_and_uncertainty_are_rounded_together(
    value: float, stderr: float | None, unit: str, expected: tuple[str, str]
) -> None:
    ci95 = None if stderr is None else (value - stderr, value + stderr)
    shown = readable(
        "s1_k0", fabricated.estimate("s1_k0", value, stderr=stderr, ci95=ci95, unit=unit)
    )
    assert (shown.with_error, shown.unit) == expected


@pytest.mark.parametrize("long", ["word " * 60, "word " * 6])
def test_many_parameters_and_warnings_are_still_one_screen(long: str) -> None:
    """Undetermined and record parameters take one line each; surplus warnings are only counted."""
    one = fabricated.chain_result().parameters
    zeros = {name: fabricated.estimate(name, 1.0) for name in ("contact_time", "stress_zero")}
    more = {
        f"s3{name[2:]}": replace(p, state="not determined", why="so")
        for name, p in one.items()
        if name.startswith("s2")
    }
    warnings = tuple(f"{i} {long}" for i in range(9))
    result = fabricated.result(warnings=warnings, parameters=one | more | zeros)
    text = summary_text(result)
    assert len(text.splitlines()) == 22
    assert max(map(len, text.splitlines())) <= 80
    assert re.search(r"\nnot determined: s2_kh_minus .*s3_k0, s3_kc", text)
    assert {name for name in one if f"\n{name} " in text} == {*one} - {"s2_eta", "s2_kh_minus"}
    assert "\nwarning: 0 word word" in text
    assert re.search(r"\nand \d more warnings: see the report, or --verbose\n", text)


def test_the_report_has_the_budget_as_table_and_picture() -> None:
    budget = fabricated.budget(area=0.02, contact_and_zero=0.01)
    one = fabricated.result()
    estimates = {
        name: replace(p, systematic=0.02 * abs(p.value)) for name, p in one.parameters.items()
    }
    result = replace(one, budget=budget, parameters=estimates)
    text = render_report(result, fabricated.no_figures())
    page = text[text.index("Uncertainty budget") :]
    head, row = (part.split("</tr>")[0] for part in page.split("<tr>")[1:3])
    assert head.count("<th") == 6  # corner, three sources, combined, bars
    assert "mass" not in head
    for share in ("1 %", "2 %", "2.4 %"):  # √(1 + 1 + 4)
        assert f">{share}<" in row
    widths = [float(bar.split("%")[0]) for bar in row.split("width: ")[1:]]
    assert widths == pytest.approx([100 / 6, 100 / 6, 400 / 6], abs=0.1)  # shares of variance
    assert "± 0.11" in text  # 2 % of k0 = 5.5 MPa
    assert "Systematic is one standard deviation" in text


def test_what_check_finds_wrong_stands_before_all_other_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Force in meganewtons, strain for another height, a loop of simple power laws."""
    without_pictures(monkeypatch)
    t = np.linspace(0.0, 2.4, 241)
    w = np.minimum(t, 2.4 - t)
    head = "time (s),force (MN),strain (%),displacement (mm)"
    toml = (
        '[specimen]\nheight = "10 mm"\narea = "100 mm^2"\n'
        '[striker]\nmass = "1 kg"\nvelocity = "1 m/s"\n[noise]\nstress = "1 Pa"\n'
    )
    force = 1e2 * w ** np.where(t < 1.2, 1, 2)
    path = write_csv(tmp_path / "test.csv", head, t, force, 12 * w, w, fmt="%.6f", toml=toml)
    call = ["fit", path, "--model", "linear", "--drive", "displacement", "--starts", "2"]
    out = run(*call, "--out", tmp_path / "out", code=(0, 2))
    fit = json.loads((tmp_path / "out" / "fit.json").read_text())
    asked = [text.startswith("Check:") for text in fit["warnings"]]
    assert fit["status"] != "ok"
    assert sum(asked) > 3
    assert asked == sorted(asked, reverse=True)
    assert not all(asked)
    shown = " ".join(out.stdout.split())
    for warning, on_input in zip(fit["warnings"], asked, strict=True):
        assert not on_input or f"warning: {warning[7:]}"[:60] in shown
