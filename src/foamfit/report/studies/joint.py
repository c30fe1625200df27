"""A joint fit: what the command prints, its page, and its folder with one folder per test."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foamfit.report.figures import TWO, image
from foamfit.report.folder import save_whole, write_json, write_result
from foamfit.report.plotted import table
from foamfit.report.readable import Readable, in_unit, readable, readable_unit, symbol
from foamfit.report.render import page, words
from foamfit.report.studies.joint_plot import plot_joint
from foamfit.results import ParameterEstimate, law_in_words
from foamfit.springs.parameters import NUISANCE
from foamfit.text import percent
from foamfit.trust.covariance import RULE

if TYPE_CHECKING:
    from foamfit.study.joint_result import JointData, JointParameter, TestFit

CURVES = {"stress_strain": "loop", "stress_time": "σ(t)", "displacement_time": "u(t)"}
DPI = 180  # of the picture
MOST_ROWS = 60  # of the table of tests on the terminal


def save_joint(
    found: JointData,
    folder: str | Path,
    each: Callable[..., Iterable[Any]] = map,
    *,
    reports: bool = True,
    width: str = TWO,
) -> Path:
    """Write the folder whole, replacing an older result at the end; returns it.

    `each` maps a function over the tests, as `map` does; `width` is that of the figures. Where the
    reports fail, joint.json is written all the same, and RuntimeError says so.
    """
    failed = list[Exception]()

    def write(fresh: Path) -> None:
        write_json(fresh / "joint.json", found.to_json_dict())
        try:
            show(fresh)
        except OSError:
            raise
        except Exception as error:
            failed.append(error)

    def show(fresh: Path) -> None:
        folders = [fresh / name for name in found.tests]
        # Where other processes make the folders, the picture of all is drawn beside them.
        n = len(folders)
        made = each(_write_test, found.test_fits(), folders, [reports] * n, [width] * n)
        figure = plot_joint(found, width=width)
        png = image(figure, "png", DPI)
        (fresh / "joint.png").write_bytes(png)
        (fresh / "joint.csv").write_bytes(table(figure))
        if width != TWO:  # the page is as wide as two columns
            png = image(plot_joint(found), "png", DPI)
        text = joint_page(found, png, linked=reports)
        (fresh / "joint.html").write_text(text, encoding="utf-8", errors="replace")
        for _ in made:
            pass

    save_whole(folder, write)
    if failed:
        raise RuntimeError(
            f"{failed[0]!r}; {Path(folder) / 'joint.json'} is written, but not all reports"
        ) from failed[0]
    return Path(folder)


def _write_test(one: TestFit, folder: Path, reports: bool, width: str) -> None:
    folder.mkdir()
    write_result(one.fit(), folder, pages=reports, width=width)


def joint_text(found: JointData) -> str:
    """Return what the command prints of a joint fit."""
    evidence = {
        name: [["*" if o.chosen else "", o.kind, str(o.n_vary), f"{o.bic:.1f}"] for o in tried]
        for name, tried in _evidence(found).items()
    }
    return words(
        "joint",
        found=found,
        law=law_in_words(found.study.model, found.study.relaxation),
        parameters=_parameter_rows(found),
        tests=_test_rows(found)[: MOST_ROWS + 1],
        evidence=evidence,
    )


def joint_page(found: JointData, picture: bytes, *, linked: bool = True) -> str:
    """Return the page; `picture` is a PNG, `linked` says whether each test has a report."""
    each = []
    for name, one in found.parameters.items():
        if one.tests and one.kind != "fixed":
            size = max(abs(at.value) for at in one.tests.values())
            each.append((one, "".join(symbol(name)), *readable_unit(size, one.unit)))
    noise = {}
    for name in CURVES:
        if levels := [one[name]["sigma"] for one in found.noise if name in one]:
            noise[name] = readable_unit(max(levels), "m" if name.startswith("displ") else "Pa")
    return page(
        "joint",
        found=found,
        law=law_in_words(found.study.model, found.study.relaxation),
        version=version("foamfit"),
        picture=base64.b64encode(picture).decode("ascii"),
        parameters=[
            (one, _readable(name, one), between(one))
            for name, one in found.parameters.items()
            if name not in NUISANCE and (one.kind != "fixed" or one.value)
        ],
        rule=RULE,
        ranged=any(one.range for one in found.parameters.values()),
        evidence=_evidence(found),
        curves={name: CURVES[name] for name in _compared(found, CURVES)},
        of_curve=CURVES,
        noise=noise,
        each=each,
        linked=linked,
    )


def _readable(name: str, one: JointParameter) -> Readable:
    shared = ("value", "stderr", "ci95", "unit", "range")
    given: dict[str, Any] = {key: getattr(one, key) for key in shared}
    state, why = one.state or "", one.why or ""
    return readable(name, ParameterEstimate(**given, vary=True, state=state, why=why))


def _evidence(found: JointData) -> dict[str, list[Any]]:
    """The kinds that were tried, by parameter."""
    names = dict.fromkeys(one.parameter for one in found.evidence)
    return {name: [one for one in found.evidence if one.parameter == name] for name in names}


def _compared(found: JointData, curves: Iterable[str]) -> list[str]:
    """The curves that some test has."""
    every = found.fit.found.misfits
    return [name for name in curves if any(one.get(name) is not None for one in every)]


def _parameter_rows(found: JointData) -> list[list[str]]:
    """Table of the parameters, the header first."""
    ranged = any(one.range for one in found.parameters.values())
    span = ["range"] if ranged else []
    rows = [["parameter", "", "value", "95 % interval", *span, "", "between tests"]]
    for name, one in found.parameters.items():
        if one.kind == "fixed" and one.value == 0.0:
            continue
        # The median of what is of one record alone says nothing.
        value = "" if name in NUISANCE else in_unit((one.value,), one.unit)
        ends = [in_unit(end or (), one.unit) for end in (one.ci95, one.range)[: 1 + ranged]]
        rows.append([name, one.kind, value, *ends, one.state or "", between(one)])
    return rows


def between(one: JointParameter) -> str:
    """What a parameter does from test to test."""
    if one.kind == "scatter" and one.scatter is not None and one.scatter_ci95 is not None:
        low, high = one.scatter_ci95
        return f"scatters by {percent(one.scatter)} ({percent(low)} to {percent(high)})"
    if one.b is not None:
        ends = "" if one.b_ci95 is None else f" ({one.b_ci95[0]:.3g} to {one.b_ci95[1]:.3g})"
        return f"b = {one.b:.3g}{ends}"
    values = [at.value for at in (one.tests or {}).values()] if one.kind == "own" else []
    return in_unit((min(values), max(values)), one.unit) if values else ""


def _test_rows(found: JointData) -> list[list[str]]:
    """Table of the tests, the header first."""
    curves = _compared(found, ("stress_time", "displacement_time", "stress_strain"))
    rows = [["test", "rate (1/s)", *(c.replace("_", "-") for c in curves), "share of χ²"]]
    tests = zip(found.tests, found.rates, found.fit.found.misfits, found.shares, strict=True)
    for name, rate, off, share in tests:
        shown = ["–" if (m := off.get(curve)) is None else percent(m) for curve in curves]
        rows.append([name, "–" if rate is None else f"{rate:.3g}", *shown, percent(share)])
    return rows
