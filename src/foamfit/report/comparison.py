"""Fitted parameters beside the published ones, or beside those of another fit.

Everything is shown as the paper's tables show it: stiffness of branch a in MPa, the other slopes as
ratios to it, the stress drop as a ratio to σ_a.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from foamfit.errors import InputError
from foamfit.report.sides import Result, Side, published_side, side_of
from foamfit.results import law_in_words
from foamfit.springs import laws
from foamfit.springs.published import MM, MPA
from foamfit.springs.published import published as published_sets

NOTHING = 3.0  # standard error over value past which a difference means nothing
WORST_FIRST = ("not determined", "weak", "determined", "fixed")
ETA_PUBLISHED = (
    "the published η is numerical, it sets how the paper's relaxation under a held stress "
    "converges; an identified η is a viscosity in real time"
)
VAGUE = "its standard error is many times its value, so the test does not determine it"


@dataclass(frozen=True)
class Row:
    """One parameter in the paper's unit ("k_h+/k0", "" or "k0", "MPa"), and its reference.

    `spring` is 1 at the base, 0 for what belongs to the chain; the state of a ratio is the worst of
    its parts. A published `reference` has no standard error. `remark` says why the two are not
    compared; it is "" where they are.
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
        """Whether there is a reference, but the test does not determine the parameter."""
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
class Pair:
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

    pairs: tuple[Pair, ...]
    with_published: bool


@dataclass(frozen=True)
class _Value:
    value: float | None = None
    stderr: float | None = None
    state: str = ""
    why: str = ""


def compare(results: Sequence[Result], published: str | None = None) -> Comparison:
    """Put fits, result folders or what `load_result` gives beside what was published.

    Without `published`, each goes beside the set that its test names, for example "foam-1/model-3";
    where a test names none, all are put beside the first of them. InputError if a result cannot be
    read, the set is unknown, or there is nothing to compare with.
    """
    names = ", ".join(published_sets)
    if published is not None and published not in published_sets:
        raise InputError(f"there is no published set '{published}'; there are {names}")
    sides = [side_of(result) for result in results]
    if not sides:
        raise InputError("nothing to compare; give at least one result folder")
    belongs = [published or _published_of(side) for side in sides]
    found = [name for name in belongs if name is not None]
    if len(found) == len(sides):
        pairs = zip(sides, [published_side(name) for name in found], strict=True)
        return Comparison(tuple(_pair(one, other) for one, other in pairs), with_published=True)
    if len(sides) == 1:
        raise InputError(
            "no published set has microscale springs; give a second result to compare with"
            if "microscale" in sides[0].kinds
            else f"the test '{sides[0].test}' names no published set; choose one by --published "
            f"({names}), or give a second result"
        )
    return Comparison(tuple(_pair(side, sides[0]) for side in sides[1:]), with_published=False)


def _published_of(side: Side) -> str | None:
    """Return the published set that a result goes beside: none if it has microscale springs."""
    return None if "microscale" in side.kinds else recognised(side.test)


def recognised(test: str) -> str | None:
    """Return the published set that the name of a test contains, if there is one."""
    plain = _plain(test)
    for name in sorted(published_sets, key=len, reverse=True):
        if re.search(rf"(?<![a-z0-9]){_plain(name)}(?![0-9a-z])", plain):
            return name
    return None


def _plain(text: str) -> str:
    return re.sub(r"[\s/_-]+", "-", text.casefold())


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


def _total(*parts: Any) -> Any:
    return sum(parts)


_ETA = _Quantity("η", "Pa·s", ("eta",), _total)
_K0 = _Quantity("k0", "MPa", ("k0",), lambda k0: k0 / MPA)
_HEIGHT = _Quantity("h", "mm", ("height",), lambda h: h / MM)
TABLE = (  # of a linear spring, those whose parameters it has
    _K0,
    _Quantity("Δσ/σ_a", "", ("dsigma", "k0", "eps_a"), _drop),
    _ETA,
    _Quantity("ε_a", "", ("eps_a",), _total),
    _Quantity("ε_c", "", ("eps_c",), _total),
    _HEIGHT,
    _Quantity("k_h+/k0", "", ("kh_plus", "k0"), _ratio),
    _Quantity("k_h−/k0", "", ("kh_minus", "k0"), _ratio),
    _Quantity("k_c/k0", "", ("kc", "k0"), _ratio),
)
OF_MICROSCALE = (  # which the paper's tables do not have
    _K0,
    _Quantity("k_c", "MPa", ("kc",), lambda kc: kc / MPA),
    _ETA,
    _Quantity("ε_*", "", ("eps_star",), _total),
    _Quantity("σ₊", "MPa", ("sigma_plus",), lambda sigma: sigma / MPA),
    _Quantity("s₊", "", ("spread_plus",), _total),
    _Quantity("σ₋", "MPa", ("sigma_minus",), lambda sigma: sigma / MPA),
    _Quantity("s₋", "", ("spread_minus",), _total),
    _HEIGHT,
)


def _quantities(kind: str, relaxation: int) -> tuple[_Quantity, ...]:
    """Return the rows of a kind of spring; a linear spring leaves out what it does not have."""
    table = OF_MICROSCALE if kind == "microscale" else TABLE
    if not laws.law(kind).hysteretic:
        return table
    terms = [
        _Quantity(f"{symbol}_{k}", unit, (f"{short}{k}",), _total)
        for k in range(1, relaxation + 1)
        for symbol, unit, short in (("g", "", "g"), ("τ", "s", "tau"))
    ]
    return (*table, *terms)


def _evaluate(side: Side, names: Sequence[str], formula: Callable[..., Any]) -> _Value | None:
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
    errors = {  # derivatives by a complex step: exact, and the formula is written once
        names[i]: (part.stderr or 0.0)
        * (formula(*(x + 1e-30j * (i == j) for j, x in enumerate(at))).imag / 1e-30)
        for i, part in enumerate(parts)
    }
    variance = sum(
        a * b * (1.0 if one == other else side.correlation.get((one, other), 0.0))
        for one, a in errors.items()
        for other, b in errors.items()
    )
    return _Value(value, math.sqrt(max(variance, 0.0)) or None, state, why)


def _rank(state: str) -> int:
    return WORST_FIRST.index(state) if state in WORST_FIRST else len(WORST_FIRST)


# ---------------------------------------------------------------------- one result, row by row


def _pair(side: Side, other: Side) -> Pair:
    nothing = _incomparable(side, other)
    rows = (*_spring_rows(side, other, nothing), *_damping_rows(side, other, nothing))
    remarks = [nothing[0].upper() + nothing[1:] + "."] if nothing else []
    remarks += [
        f"{one.label} was stopped by {one.stopped}: its numbers are the best until then, not the "
        "end of a fit."
        for one in (side, other)
        if one.stopped
    ]
    if not nothing:
        remarks += _remarks(side, other, any("/" in row.name for row in rows))
    status = f"{side.status}, stopped by {side.stopped}" if side.stopped else side.status
    kinds = law_in_words("+".join(side.kinds), side.relaxation)
    return Pair(side.test, kinds, side.drive, status, other.label, rows, tuple(remarks))


def _remarks(side: Side, other: Side, ratios: bool) -> Iterator[str]:
    """Say what is to be known of a comparison as a whole."""
    if other.source is not None and side.drive != "stress":
        yield (
            f"The paper drove its model by the measured stress, this fit by the {side.drive}: the "
            "springs' parameters mean the same in both, the damping does not."
        )
    if side.drive in ("stress", "displacement"):
        yield (
            f"The measured {side.drive} is the input of this fit: its noise can bias the "
            "parameters, which the standard errors do not count."
        )
    if (side.relaxation > 0) != (other.relaxation > 0):
        yield (
            "Only one of the two laws relaxes: in the other one the springs' parameters take up "
            "what relaxes."
        )
    if side.kinds != other.kinds:
        yield (
            f"A {'+'.join(side.kinds)} stands beside a {'+'.join(other.kinds)}: a unilateral "
            "spring is a linear one that bears no tension."
        )
    if side.sha and side.sha == other.sha:
        yield (
            "Both fits are to the same data, so their errors are not independent, and the "
            "deviations in standard errors are only a guide."
        )
    if ratios and any(one.source is None and not one.correlation for one in (side, other)):
        yield (
            "There is no correlation in fit.json: the errors of the ratios take the parameters as "
            "independent."
        )


def _incomparable(side: Side, other: Side) -> str:
    """Return why no parameter can be compared, "" if some can."""
    if other.source is not None and "microscale" in side.kinds:
        return (
            "the published sets have no microscale springs, so there is nothing to compare these "
            "parameters with"
        )
    if [*map(_family, side.kinds)] != [*map(_family, other.kinds)]:
        return (
            f"the springs differ ({'+'.join(side.kinds)} and {'+'.join(other.kinds)}), so their "
            "parameters do not mean the same"
        )
    failed = next((one.label for one in (side, other) if one.status == "failed"), None)
    return f"{failed} found no acceptable fit, so its numbers mean nothing" if failed else ""


def _family(kind: str) -> str:
    return kind if laws.law(kind).hysteretic else "linear"


def _spring_rows(side: Side, other: Side, nothing: str) -> Iterator[Row]:
    several = len(side.kinds) > 1
    for i, kind in enumerate(side.kinds, start=1):
        alike = i <= len(other.kinds) and _family(other.kinds[i - 1]) == _family(kind)
        for quantity in _quantities(kind, side.relaxation):
            eta = quantity is _ETA
            if eta and not several:
                continue  # of one spring, it stands with the onsite damper
            names = [f"s{i}_{part}" for part in quantity.parts]
            value = _evaluate(side, names, quantity.formula)
            reference = _evaluate(other, names, quantity.formula) if alike else None
            if value is None or (
                eta and reference is None and (value.state, value.value) == ("fixed", 0.0)
            ):
                continue
            remark = nothing or _remark(value, reference, eta, side, other)
            yield _row(i if several else 0, quantity.name, quantity.unit, value, reference, remark)


def _damping_rows(side: Side, other: Side, nothing: str) -> Iterator[Row]:
    """Give the damping of the striker's motion, and its ratio as the paper defines it."""
    one_spring, item = len(side.kinds) == 1, other.source
    names = [n for n in ("site_eta", "s1_eta")[: 1 + one_spring] if n in side.estimates]
    theirs = [n for n in names if n in other.estimates] if item is None else ["site_eta"]
    value, reference = _evaluate(side, names, _total), _evaluate(other, theirs, _total)
    if value is None:
        return
    if item is None and value.value == 0.0 and not (reference and reference.value):
        return
    remark = nothing or _remark(value, reference, True, side, other)
    yield _row(0, "η" if one_spring else "site η", "Pa·s", value, reference, remark)
    soft = [i for i, kind in enumerate(side.kinds, 1) if kind == "bistable"]
    if item is None or len(soft) != 1 or nothing:
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
        lost = ratio.state == "not determined" != value.state
        remark = f"not determined: {ratio.why}" if lost and not remark else remark
        yield _row(0, "ζ", "", ratio, _Value(item.damping_ratio), remark)


def _row(
    spring: int, name: str, unit: str, value: _Value, reference: _Value | None, remark: str
) -> Row:
    fitted, beside = (value.value, value.stderr, value.state), reference or _Value()
    return Row(spring, name, unit, *fitted, beside.value, beside.stderr, remark)


def _remark(value: _Value, reference: _Value | None, eta: bool, side: Side, other: Side) -> str:
    """Return why two numbers are not compared, "" if they are."""
    if value.state == "not determined":
        return f"not determined: {value.why}"
    if reference is not None and reference.state == "not determined":
        return f"not determined in {other.label}: {reference.why}"
    if eta and other.source is not None:
        return ETA_PUBLISHED if other.source.eta is not None else "the published model has no η"
    if eta and side.drive != other.drive:
        return "η means something else in another drive"
    if value.state == "fixed":
        return f"not identified, {value.why or 'held fixed'}"
    if value.stderr is not None and reference is not None:
        size = max(abs(value.value or 0.0), abs(reference.value or 0.0))
        if value.stderr > NOTHING * size:
            return VAGUE
    return ""
