"""Fitted parameters beside the published ones, or beside those of another fit.

Everything is shown as the paper's tables show it: stiffness of branch a in MPa, the other slopes as
ratios to it, the stress drop as a ratio to σ_a. Where the difference of two numbers would mean
nothing, there is a sentence instead of a percentage.
"""

from __future__ import annotations

import csv
import io
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from foamfit.errors import InputError
from foamfit.files import write_file
from foamfit.report.folder import load_result
from foamfit.report.readable import readable
from foamfit.results import Fit, ParameterEstimate
from foamfit.springs.model import Model
from foamfit.springs.parameters import BISTABLE_NAMES, LINEAR_NAMES
from foamfit.springs.published import MM, MPA, PublishedSet
from foamfit.springs.published import published as published_sets
from foamfit.springs.spring import LinearSpring

Result = Fit | Mapping[str, Any] | str | Path

# What is read of a result, and of each of its parameters.
CONTENT = {"test": str, "model": str, "drive": str, "status": str, "parameters": Mapping}
_NUMBER = int | float | None
ESTIMATE = {
    "value": _NUMBER, "stderr": _NUMBER, "unit": str, "vary": bool, "state": str, "why": str,
}  # fmt: skip

WIDTH = 100
NOTHING = 3.0  # standard error over value past which a difference says nothing
WORST_FIRST = ("not determined", "weak", "determined", "fixed")
ETA_PUBLISHED = (
    "the published η is numerical, it sets how the paper's relaxation under a held stress "
    "converges; an identified η is a viscosity in real time"
)
ETA_DRIVES = "η means something else in another drive"
INDEPENDENT = (
    "There is no correlation in fit.json: the errors of the ratios take the parameters as "
    "independent."
)
PAPER_DRIVE = (
    "The paper drove its model by the measured stress, this fit by the {drive}: the springs' "
    "parameters mean the same in both, the damping does not."
)
VAGUE = "its standard error is many times its value, so the test says nothing of it"
INPUT = (
    "The measured {channel} is the input of this fit: its noise can bias the parameters, which the "
    "standard errors do not count."
)
ZETA = "ζ = η/(2 H √(ρ k_c)) with ρ = m/(A H), m, A and H of the paper's striker and specimen"


@dataclass(frozen=True)
class Row:
    """One parameter in the paper's unit: fitted, and what it is compared with.

    Attributes
    ----------
    spring : int
        1 at the base; 0 for what belongs to the chain.
    name, unit : str
        For example "k_h+/k0" and "" or "k0" and "MPa".
    value, stderr : float or None
        Fitted; None where there is none.
    state : str
        "determined", "weak", "not determined" or "fixed"; of a ratio, the worst of its parts.
    reference, reference_stderr : float or None
        Published (then without uncertainty) or fitted by the reference.
    remark : str
        Why the two are not compared; "" where they are.
    """

    spring: int
    name: str
    unit: str
    value: float | None
    stderr: float | None
    state: str
    reference: float | None
    reference_stderr: float | None
    remark: str

    @property
    def label(self) -> str:
        """Name with its spring, for example "s2 k0"."""
        return f"s{self.spring} {self.name}" if self.spring else self.name

    @property
    def lost(self) -> bool:
        """Whether there is a reference, but the test says nothing of the parameter."""
        nothing = self.state == "not determined" or self.remark == VAGUE
        return nothing and self.reference is not None

    @property
    def difference(self) -> float | None:
        """Fitted minus reference, in the row's unit; None where it means nothing."""
        if self.remark or self.value is None or self.reference is None:
            return None
        return self.value - self.reference

    @property
    def percent(self) -> float | None:
        """The difference in percent of the reference."""
        if self.difference is None or not self.reference:
            return None
        return 100.0 * self.difference / abs(self.reference)

    @property
    def standard_errors(self) -> float | None:
        """The difference in standard errors, those of both sides taken as independent."""
        spread = math.hypot(self.stderr or 0.0, self.reference_stderr or 0.0)
        return None if self.difference is None or spread == 0.0 else self.difference / spread


@dataclass(frozen=True)
class Section:
    """One result beside its reference."""

    test: str
    model: str
    drive: str
    status: str
    reference: str
    rows: tuple[Row, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """Results beside the published sets that they belong to, or beside the first of them."""

    sections: tuple[Section, ...]
    with_published: bool


@dataclass(frozen=True)
class _Side:
    """The parameters of one side of a comparison: of a fit, or published."""

    label: str
    kinds: tuple[str, ...]
    estimates: Mapping[str, ParameterEstimate]
    correlation: Mapping[tuple[str, str], float]
    drive: str = ""
    status: str = ""
    stopped: str | None = None
    test: str = ""
    sha: str = ""
    source: PublishedSet | None = None


@dataclass(frozen=True)
class _Value:
    value: float
    stderr: float | None
    state: str
    why: str


def compare(results: Sequence[Result], published: str | None = None) -> Comparison:
    """Put fits beside what was published, or beside each other.

    Parameters
    ----------
    results : sequence of Fit, path or mapping
        Fits, result folders, or what `load_result` gives.
    published : str, optional
        A published set to put all of them beside. Without it, each result goes beside the set that
        its test names, for example "foam-1/model-3"; where a test names none, the results are put
        beside the first of them.

    Raises
    ------
    InputError
        If a result cannot be read, the set is unknown, or there is nothing to compare with.
    """
    names = ", ".join(published_sets)
    if published is not None and published not in published_sets:
        raise InputError(f"there is no published set '{published}'; there are {names}")
    sides = [_side(result) for result in results]
    if not sides:
        raise InputError("nothing to compare; give at least one result folder")
    belongs = [published or recognised(side.test) for side in sides]
    found = [name for name in belongs if name is not None]
    if len(found) == len(sides):
        pairs = zip(sides, [_published_side(name) for name in found], strict=True)
        return Comparison(tuple(_section(one, other) for one, other in pairs), with_published=True)
    if len(sides) == 1:
        raise InputError(
            f"the test '{sides[0].test}' names no published set; choose one by --published "
            f"({names}), or give a second result"
        )
    return Comparison(tuple(_section(side, sides[0]) for side in sides[1:]), with_published=False)


def recognised(test: str) -> str | None:
    """Return the published set that the name of a test contains, if there is one."""
    plain = _plain(test)
    for name in sorted(published_sets, key=len, reverse=True):
        if re.search(rf"(?<![a-z0-9]){_plain(name)}(?![0-9a-z])", plain):
            return name
    return None


def _plain(text: str) -> str:
    return re.sub(r"[\s/_-]+", "-", text.casefold())


# ------------------------------------------------------------------------------- the two sides


def _side(result: Result) -> _Side:
    if isinstance(result, Fit):
        content: Mapping[str, Any] = result.to_json_dict()
    else:
        content = result if isinstance(result, Mapping) else load_result(result)
    where = str(result) if isinstance(result, str | Path) else "the result"
    given = _whole(content, CONTENT, where)
    test, model, drive = given["test"], given["model"], given["drive"]
    return _Side(
        label=f"{test}: {model}, {drive} drive",
        kinds=Model.parse(model).kinds,
        estimates={name: _read_estimate(p, where, name) for name, p in given["parameters"].items()},
        correlation=_correlation(given.get("correlation"), where),
        drive=drive,
        status=given["status"],
        stopped=given.get("stopped"),
        test=test,
        sha=str(given.get("data_sha256", "")),
    )


def _whole(content: Any, wanted: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    """Return what a result holds if it holds all that is wanted, each of its kind."""
    given = content if isinstance(content, Mapping) else {}
    for key, kind in wanted.items():
        fine = key in given and isinstance(given[key], kind)
        if not fine or (kind is _NUMBER and isinstance(given[key], bool)):
            fault = f"cannot be {str(given[key])[:40]!r}" if key in given else "is missing"
            raise InputError(f"{where} is no whole result of a fit: '{key}' {fault}; fit again")
    return given


def _read_estimate(content: Mapping[str, Any], where: str, name: str) -> ParameterEstimate:
    """Read one parameter of a result."""
    p = _whole(content, ESTIMATE, f"{where}: {name}")
    value = math.nan if p["value"] is None else float(p["value"])
    return ParameterEstimate(value, p["stderr"], None, p["unit"], p["vary"], p["state"], p["why"])


def _correlation(content: Any, where: str) -> dict[tuple[str, str], float]:
    if content is None:
        return {}
    try:
        return {
            (str(one), str(other)): float(value)
            for one, row in zip(content["names"], content["matrix"], strict=True)
            for other, value in zip(content["names"], row, strict=True)
            if value is not None
        }
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{where} is no whole result of a fit: 'correlation' must have names and a square "
            "matrix of numbers; fit again"
        ) from None


def _published_side(name: str) -> _Side:
    item = published_sets[name]
    estimates: dict[str, ParameterEstimate] = {}
    kinds = []
    for i, spring in enumerate(item.chain.springs, start=1):
        if isinstance(spring, LinearSpring):
            kinds.append("unilateral" if spring.unilateral else "linear")
        else:
            kinds.append("bistable")
        values = {short: getattr(spring, short) for short in _names(kinds[-1]) if short != "eta"}
        values["height"] = item.chain.heights[i - 1]
        for short, value in values.items():
            estimates[f"s{i}_{short}"] = _exact(value)
    if item.eta is not None:
        estimates["site_eta"] = _exact(item.eta)
    return _Side(f"published {name}", tuple(kinds), estimates, {}, source=item)


def _names(kind: str) -> tuple[str, ...]:
    return BISTABLE_NAMES if kind == "bistable" else LINEAR_NAMES


def _exact(value: float) -> ParameterEstimate:
    return ParameterEstimate(value, None, None, "", False, "published", "")


# ---------------------------------------------------------------- the quantities of the tables


@dataclass(frozen=True)
class _Quantity:
    """A number of the paper's tables as a function of the parameters of one spring."""

    name: str
    unit: str
    parts: tuple[str, ...]
    formula: Callable[..., Any]  # of floats; also of complex numbers, for its derivatives


def _ratio(part: Any, k0: Any) -> Any:
    return part / k0


def _drop(dsigma: Any, k0: Any, eps_a: Any) -> Any:
    return dsigma * (1.0 - eps_a) / (k0 * eps_a)


def _same(value: Any) -> Any:
    return value


_K0 = _Quantity("k0", "MPa", ("k0",), lambda k0: k0 / MPA)
_H = _Quantity("h", "mm", ("height",), lambda h: h / MM)
_ETA = _Quantity("η", "Pa·s", ("eta",), _same)
TABLES = {
    "bistable": (
        _K0,
        _Quantity("Δσ/σ_a", "", ("dsigma", "k0", "eps_a"), _drop),
        _ETA,
        _Quantity("ε_a", "", ("eps_a",), _same),
        _Quantity("ε_c", "", ("eps_c",), _same),
        _H,
        _Quantity("k_h+/k0", "", ("kh_plus", "k0"), _ratio),
        _Quantity("k_h−/k0", "", ("kh_minus", "k0"), _ratio),
        _Quantity("k_c/k0", "", ("kc", "k0"), _ratio),
    ),
    "linear": (_K0, _ETA, _H),
}


def _evaluate(side: _Side, names: Sequence[str], formula: Callable[..., Any]) -> _Value | None:
    """Return a function of parameters with its error; None where a side lacks a parameter."""
    if not names or any(name not in side.estimates for name in names):
        return None
    parts = [side.estimates[name] for name in names]
    at = [part.value for part in parts]
    try:
        value = float(formula(*at))
    except (ZeroDivisionError, ValueError):
        return None
    state = min((part.state for part in parts), key=_rank)
    why = next(part.why for part in parts if part.state == state)
    if not any(part.stderr for part in parts) or state == "not determined":
        return _Value(value, None, state, why)
    # Derivatives by a complex step: exact, and the formula is written once.
    errors = [
        (part.stderr or 0.0)
        * (formula(*(x + 1e-30j * (i == j) for j, x in enumerate(at))).imag / 1e-30)
        for i, part in enumerate(parts)
    ]
    variance = sum(
        a * b * (1.0 if one == other else side.correlation.get((one, other), 0.0))
        for one, a in zip(names, errors, strict=True)
        for other, b in zip(names, errors, strict=True)
    )
    return _Value(value, math.sqrt(max(variance, 0.0)) or None, state, why)


def _rank(state: str) -> int:
    return WORST_FIRST.index(state) if state in WORST_FIRST else len(WORST_FIRST)


# ---------------------------------------------------------------------- one result, row by row


def _section(side: _Side, other: _Side) -> Section:
    nothing = _incomparable(side, other)
    rows = [*_spring_rows(side, other, nothing), *_damping_rows(side, other, nothing)]
    remarks = [nothing[0].upper() + nothing[1:] + "."] if nothing else []
    remarks += [
        f"{one.label} was stopped by {one.stopped}: its numbers are the best until then, not the "
        "end of a fit."
        for one in (side, other)
        if one.stopped
    ]
    if not nothing:
        if other.source is not None and side.drive != "stress":
            remarks.append(PAPER_DRIVE.format(drive=side.drive))
        if side.drive in ("stress", "displacement"):
            remarks.append(INPUT.format(channel=side.drive))
        if side.kinds != other.kinds:
            remarks.append(
                f"A {'+'.join(side.kinds)} stands beside a {'+'.join(other.kinds)}: a unilateral "
                "spring is a linear one that bears no tension."
            )
        if side.sha and side.sha == other.sha:
            remarks.append(
                "Both fits are to the same data, so their errors are not independent, and the "
                "deviations in standard errors are only a guide."
            )
        fits = [one for one in (side, other) if one.source is None]
        if any(not one.correlation for one in fits) and any("/" in row.name for row in rows):
            remarks.append(INDEPENDENT)
    return Section(
        side.test, "+".join(side.kinds), side.drive, _status(side), other.label,
        tuple(rows), tuple(remarks),
    )  # fmt: skip


def _status(side: _Side) -> str:
    return f"{side.status}, stopped by {side.stopped}" if side.stopped else side.status


def _incomparable(side: _Side, other: _Side) -> str:
    """Return why no parameter can be compared, "" if some can."""
    if _families(side) != _families(other):
        return (
            f"the springs differ ({'+'.join(side.kinds)} and {'+'.join(other.kinds)}), so their "
            "parameters do not mean the same"
        )
    for one in (side, other):
        if one.status == "failed":
            return f"{one.label} found no acceptable fit, so its numbers mean nothing"
    return ""


def _families(side: _Side) -> tuple[str, ...]:
    return tuple(_family(kind) for kind in side.kinds)


def _family(kind: str) -> str:
    return "bistable" if kind == "bistable" else "linear"


def _spring_rows(side: _Side, other: _Side, nothing: str) -> Iterator[Row]:
    chain = len(side.kinds) > 1
    for i, kind in enumerate(side.kinds, start=1):
        alike = i <= len(other.kinds) and _family(other.kinds[i - 1]) == _family(kind)
        for quantity in TABLES[_family(kind)]:
            if quantity is _ETA and not chain:
                continue  # of one spring, it stands with the onsite damper
            names = [f"s{i}_{part}" for part in quantity.parts]
            value = _evaluate(side, names, quantity.formula)
            reference = _evaluate(other, names, quantity.formula) if alike else None
            silent = quantity is _ETA and value is not None and value.state == "fixed"
            if value is None or (silent and value.value == 0.0 and reference is None):
                continue
            remark = nothing or _remark(value, reference, quantity is _ETA, side, other)
            yield _row(i if chain else 0, quantity.name, quantity.unit, value, reference, remark)


def _damping_rows(side: _Side, other: _Side, nothing: str) -> Iterator[Row]:
    """Give the damping of the striker's motion, and its ratio as the paper defines it."""
    one_spring = len(side.kinds) == 1
    names = ["site_eta", "s1_eta"] if one_spring else ["site_eta"]
    names = [name for name in names if name in side.estimates]
    reference = _evaluate(other, [n for n in names if n in other.estimates], _total)
    value = _evaluate(side, names, _total) if names else None
    if value is None:
        return
    if other.source is None and value.value == 0.0 and not (reference and reference.value):
        return
    if other.source is not None:
        reference = _evaluate(other, ["site_eta"], _same)
    remark = nothing or _remark(value, reference, True, side, other)
    yield _row(0, "η" if one_spring else "site η", "Pa·s", value, reference, remark)
    if other.source is None:
        return
    item, soft = other.source, [i for i, k in enumerate(side.kinds, 1) if k == "bistable"]
    if len(soft) != 1 or nothing:
        return
    # ρ H = m/A, so that 2 H √(ρ k_c) = 2 √(m H k_c/A).
    inertia = item.striker_mass * item.chain.height / item.chain.area
    ratio = _evaluate(
        side,
        [*names, f"s{soft[0]}_kc"],
        lambda *at: _total(*at[:-1]) / (2.0 * (inertia * at[-1]) ** 0.5),
    )
    if ratio is not None:
        # ζ is η over a root: it is known as well as η is, unless k_c is not known at all.
        if ratio.state != "not determined" or value.state == "fixed":
            ratio = replace(ratio, state=value.state, why=value.why)
        published = None if item.damping_ratio is None else _Value(item.damping_ratio, None, "", "")
        lost = ratio.state == "not determined" != value.state
        remark = f"not determined: {ratio.why}" if lost and not remark else remark
        yield _row(0, "ζ", "", ratio, published, remark)


def _total(*etas: Any) -> Any:
    return sum(etas)


def _row(
    spring: int, name: str, unit: str, value: _Value, reference: _Value | None, remark: str
) -> Row:
    return Row(
        spring=spring,
        name=name,
        unit=unit,
        value=value.value,
        stderr=value.stderr,
        state=value.state,
        reference=None if reference is None else reference.value,
        reference_stderr=None if reference is None else reference.stderr,
        remark=remark,
    )


def _remark(value: _Value, reference: _Value | None, eta: bool, side: _Side, other: _Side) -> str:
    """Return why two numbers are not compared, "" if they are."""
    if value.state == "not determined":
        return f"not determined: {value.why}"
    if reference is not None and reference.state == "not determined":
        return f"not determined in {other.label}: {reference.why}"
    if eta and other.source is not None:
        return ETA_PUBLISHED if other.source.eta is not None else "the published model has no η"
    if eta and side.drive != other.drive:
        return ETA_DRIVES
    if value.state == "fixed":
        return f"not identified, {value.why or 'held fixed'}"
    if value.stderr is not None and reference is not None:
        size = max(abs(value.value), abs(reference.value))
        if value.stderr > NOTHING * size:
            return VAGUE
    return ""


# ------------------------------------------------------------------------------------ as text


def comparison_text(comparison: Comparison) -> str:
    """Return a comparison as aligned text, at most 100 columns wide, no newline at the end."""
    parts = []
    for section in comparison.sections:
        parts.append("\n".join(_section_lines(section, comparison.with_published)))
    if comparison.with_published:
        parts.append(
            "Published numbers carry no uncertainty and are taken as exact; s.e. = standard errors."
        )
    else:
        parts.append("The deviation is in standard errors (s.e.) of both fits.")
    return "\n\n".join(parts)


def _section_lines(section: Section, with_published: bool) -> Iterator[str]:
    head = f"{section.test}: {section.model}, {section.drive} drive ({section.status})"
    yield from textwrap.wrap(head, WIDTH, subsequent_indent="  ")
    yield from textwrap.wrap(f"beside {section.reference}", WIDTH, subsequent_indent="  ")
    yield ""
    titles = ("parameter", "unit", "fitted", "published" if with_published else "reference")
    table: list[tuple[str, ...]] = [(*titles, "deviation", "", "state")]
    table += [_cells(row) for row in section.rows]
    widths = [max(len(cells[i]) for cells in table) for i in range(len(table[0]))]
    for cells in table:
        aligned = [
            cell.rjust(width) if i in (4, 5) and cells is not table[0] else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        yield "  ".join(aligned).rstrip()
    yield from _remark_lines(section)


def _remark_lines(section: Section) -> Iterator[str]:
    lines = [*section.remarks]
    whole = {remark[:-1].casefold() for remark in section.remarks}
    apart = [row for row in section.rows if row.remark and row.remark.casefold() not in whole]
    order = {row.remark: i for i, row in reversed(list(enumerate(apart)))}
    for remark, rows in groupby(
        sorted(apart, key=lambda r: order[r.remark]), key=lambda r: r.remark
    ):
        lines.append(f"{', '.join(row.label for row in rows)}: {remark}.")
    if any(row.name == "ζ" for row in section.rows):
        lines.append(f"{ZETA}.{_paper_disagrees(section)}")
    if lines:
        yield ""
    for line in lines:
        yield from textwrap.wrap(line, WIDTH, subsequent_indent="  ")


def _paper_disagrees(section: Section) -> str:
    """Say so where the paper's damping ratio does not follow from its table."""
    item = published_sets.get(section.reference.removeprefix("published "))
    ratio = None if item is None else item.damping_ratio_by_formula()
    if item is None or ratio is None or item.damping_ratio is None:
        return ""
    if math.isclose(ratio, item.damping_ratio, rel_tol=2e-3):
        return f" The published η gives {ratio:.3g}, as the paper says."
    return f" The published η gives {ratio:.3g}, where the paper says {item.damping_ratio:g}."


def _cells(row: Row) -> tuple[str, ...]:
    percent, errors = row.percent, row.standard_errors
    state = row.state
    return (
        row.label,
        row.unit or "–",
        with_error(row.value, row.stderr),
        with_error(row.reference, row.reference_stderr),
        "not compared" if row.remark and row.reference is not None else _signed(percent, " %"),
        _signed(errors, " s.e."),
        state,
    )


def _signed(value: float | None, unit: str) -> str:
    if value is None:
        return ""
    decimals = 0 if abs(value) >= 99.5 else 1
    shown = f"{value:+.{decimals}f}"
    shown = shown[1:] if float(shown) == 0.0 else shown.replace("-", "−")
    return f"{shown}{unit}"


def with_error(value: float | None, stderr: float | None) -> str:
    """Return a number with its error, rounded to two digits of the error; "–" for none."""
    if value is None:
        return "–"
    if stderr is None:
        return f"{value:.4g}".replace("-", "−")
    if max(abs(value), stderr) >= 1e5:
        return f"{value:.3g} ± {stderr:.2g}".replace("-", "−")
    return readable("", ParameterEstimate(value, stderr, None, "", True, "", "")).with_error


def write_csv(comparison: Comparison, path: str | Path) -> None:
    """Write a comparison as a table, one parameter of one result per line.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    head = (
        "test", "model", "drive", "reference", "spring", "parameter", "unit", "value", "stderr",
        "state", "reference_value", "reference_stderr", "percent", "standard_errors", "remark",
    )  # fmt: skip
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for s in comparison.sections:
        for row in s.rows:
            writer.writerow((
                s.test, s.model, s.drive, s.reference, row.spring or "", row.name,
                row.unit, row.value, row.stderr, row.state, row.reference,
                row.reference_stderr, row.percent, row.standard_errors, row.remark,
            ))  # fmt: skip
    write_file(path, text.getvalue().encode(errors="replace"))
