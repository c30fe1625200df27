"""A comparison as a text and as a CSV."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from foamfit.files import csv_bytes, write_file
from foamfit.report.comparison import Comparison, Pair, Row
from foamfit.report.readable import readable
from foamfit.results import ParameterEstimate
from foamfit.springs.published import published
from foamfit.text import aligned, signed, significant, wrapped

ZETA = "ζ = η/(2 H √(ρ k_c)) with ρ = m/(A H), m, A and H of the paper's striker and specimen"


def comparison_text(comparison: Comparison) -> str:
    """Return a comparison as aligned text, at most 100 columns wide, no newline at the end."""
    reference, last = "reference", "The deviation is in standard errors (s.e.) of both fits."
    if comparison.with_published:
        reference = "published"
        last = (
            "Published numbers carry no uncertainty and are taken as exact; s.e. = standard errors."
        )
    parts = ["\n".join(_pair_lines(pair, reference)) for pair in comparison.pairs]
    return "\n\n".join([*parts, last])


def _pair_lines(pair: Pair, reference: str) -> Iterator[str]:
    yield from wrapped(f"{pair.test}: {pair.model}, {pair.drive} drive ({pair.status})")
    yield from wrapped(f"beside {pair.reference}")
    yield ""
    titles = ("parameter", "unit", "fitted", reference, "deviation", "", "state")
    yield from aligned([titles, *map(_cells, pair.rows)], right=(4, 5))
    lines = list(pair.remarks)
    whole = {remark[:-1].casefold() for remark in pair.remarks}
    apart = dict[str, list[str]]()
    for row in pair.rows:
        if row.remark and row.remark.casefold() not in whole:
            apart.setdefault(row.remark, []).append(row.label)
    lines += [f"{', '.join(labels)}: {remark}." for remark, labels in apart.items()]
    if any(row.name == "ζ" for row in pair.rows):
        lines.append(f"{ZETA}.{_damping_ratio(pair)}")
    yield from ["", *(part for line in lines for part in wrapped(line))] if lines else []


def _damping_ratio(pair: Pair) -> str:
    """Say whether the paper's damping ratio follows from its table."""
    item = published[pair.reference.removeprefix("published ")]
    ratio = item.damping_ratio_by_formula()
    if ratio is None or item.damping_ratio is None:
        return ""
    agrees = math.isclose(ratio, item.damping_ratio, rel_tol=2e-3)
    rest = "as the paper says" if agrees else f"where the paper says {item.damping_ratio:g}"
    return f" The published η gives {ratio:.3g}, {rest}."


def _cells(row: Row) -> tuple[str, ...]:
    off = "not compared" if row.remark and row.reference is not None else None
    values = _with_error(row.value, row.stderr), _with_error(row.reference, row.reference_stderr)
    deviation = off or _signed(row.percent, " %"), _signed(row.standard_errors, " s.e.")
    return (row.label, row.unit or "–", *values, *deviation, row.state)


def _signed(value: float | None, unit: str) -> str:
    return "" if value is None else signed(value, 0 if abs(value) >= 99.5 else 1) + unit


def _with_error(value: float | None, stderr: float | None) -> str:
    """Return a number with its error, rounded to two digits of the error; "–" for none."""
    if value is None:
        return "–"
    if stderr is None:
        return f"{value:.4g}".replace("-", "−")
    if max(abs(value), stderr) >= 1e5:
        return f"{significant(value, 3)} ± {significant(stderr)}".replace("-", "−")
    return readable("", ParameterEstimate(value, stderr, None, "", True, "", "")).with_error


def write_csv(comparison: Comparison, path: str | Path) -> None:
    """Write a comparison as a table, one parameter of one result per line."""
    head = (
        "test", "model", "drive", "reference", "spring", "parameter", "unit", "value", "stderr",
        "state", "reference_value", "reference_stderr", "percent", "standard_errors", "remark",
    )  # fmt: skip
    rows = (
        (
            pair.test, pair.model, pair.drive, pair.reference, row.spring or "", row.name,
            row.unit, row.value, row.stderr, row.state, row.reference,
            row.reference_stderr, row.percent, row.standard_errors, row.remark,
        )
        for pair in comparison.pairs for row in pair.rows
    )  # fmt: skip
    write_file(path, csv_bytes((head, *rows)))
