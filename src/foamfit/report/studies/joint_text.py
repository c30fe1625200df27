"""A joint fit in words: what the command prints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from foamfit.report.readable import readable_unit
from foamfit.springs.parameters import NUISANCE
from foamfit.text import aligned, number, percent, wrapped

if TYPE_CHECKING:
    from foamfit.study.joint_result import JointData, JointParameter

MOST_ROWS = 60  # of the table of tests


def joint_text(found: JointData) -> str:
    """Return what the command prints of a joint fit."""
    study = found.study
    law = f"{study.model} with relaxation" if study.relaxation else study.model
    lines = [f"{study.name}: {law}: {len(found.tests)} tests together: {found.status}", ""]
    lines += aligned(parameter_rows(found))
    lines += ["", *aligned(test_rows(found)[: MOST_ROWS + 1])]
    for name in dict.fromkeys(one.parameter for one in found.evidence):
        rows = [["", name, "numbers", "BIC"]]
        for one in found.evidence:
            if one.parameter == name:
                mark = "*" if one.chosen else ""
                rows.append([mark, one.kind, str(one.n_vary), f"{one.bic:.1f}"])
        lines += ["", *aligned(rows)]
    for sentence in found.sentences:
        lines += ["", *wrapped(sentence)]
    for warning in found.warnings:
        lines += ["", *wrapped(f"warning: {warning}")]
    return "\n".join(lines)


def parameter_rows(found: JointData) -> list[list[str]]:
    """Table of the parameters, the header first."""
    ranged = any(one.range for one in found.parameters.values())
    span = ["range"] if ranged else []
    rows = [["parameter", "", "value", "95 % interval", *span, "", "between tests"]]
    for name, one in found.parameters.items():
        if one.kind == "fixed" and one.value == 0.0:
            continue
        ends = "" if one.ci95 is None else in_unit(one.ci95, one.unit)
        span = [in_unit(one.range, one.unit) if one.range else ""] if ranged else []
        # The median of what is of one record alone says nothing.
        value = "" if name in NUISANCE else in_unit((one.value,), one.unit)
        rows.append([name, one.kind, value, ends, *span,
                     one.state or "", between(one)])  # fmt: skip
    return rows


def between(one: JointParameter) -> str:
    """What a parameter does from test to test."""
    if one.kind == "scatter" and one.scatter is not None and one.scatter_ci95 is not None:
        low, high = one.scatter_ci95
        return f"scatters by {percent(one.scatter)} ({percent(low)} to {percent(high)})"
    if one.b is not None:
        ends = "" if one.b_ci95 is None else f" ({one.b_ci95[0]:.3g} to {one.b_ci95[1]:.3g})"
        return f"b = {one.b:.3g}{ends}"
    if one.kind == "own" and one.tests:
        values = [at.value for at in one.tests.values()]
        return in_unit((min(values), max(values)), one.unit)
    return ""


def in_unit(values: Sequence[float], unit: str) -> str:
    """Write one value, or the ends of an interval, in the unit in which they read well."""
    factor, name = readable_unit(max(map(abs, values)), unit)
    return f"{' to '.join(number(value / factor) for value in values)} {name}".rstrip()


def test_rows(found: JointData) -> list[list[str]]:
    """Table of the tests, the header first."""
    curves = [
        name for name in ("stress_time", "displacement_time", "stress_strain")
        if any(one.get(name) is not None for one in found.fit.found.misfits)
    ]  # fmt: skip
    rows = [["test", "rate (1/s)", *(c.replace("_", "-") for c in curves), "share of χ²"]]
    for t, name in enumerate(found.tests):
        rate, off = found.rates[t], found.fit.found.misfits[t]
        cells = ["–" if (m := off.get(curve)) is None else percent(m) for curve in curves]
        rows.append([name, "–" if rate is None else f"{rate:.3g}", *cells,
                     percent(found.shares[t])])  # fmt: skip
    return rows
