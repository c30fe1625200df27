"""Comparison of fitted parameters with published ones, or with those of another fit.

Quantities are those of the paper's tables: stiffness of branch a in MPa, other slopes as ratios to
it, stress drop as a ratio to σ_a.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from uncertainties import correlated_values_norm, nominal_value, std_dev, ufloat

from foamfit.codec import build, reading
from foamfit.errors import InputError
from foamfit.parts import ParameterEstimate, law_in_words
from foamfit.report import figures
from foamfit.report.figures import TWO
from foamfit.report.folder import load_result
from foamfit.report.plots import Values, plot_parameters
from foamfit.report.render import readable, sentences, words
from foamfit.results import Fit
from foamfit.springs.laws import law
from foamfit.springs.laws.record import COMMON, ETA, HEIGHT, RELAXATION_TIME, STRENGTH, Compared
from foamfit.springs.model import Model
from foamfit.springs.published import PublishedSet, published as published_sets
from foamfit.text import significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Result = Fit | Mapping[str, Any] | str | Path

# Keys that a published set, or an older fit.json, does not have.
_GIVEN = dict[str, Any].fromkeys(("drive", "status", "stopped", "data_sha256", "correlation"))
NOTHING = 3.0  # standard error over value beyond which a difference is meaningless
WORST_FIRST = ("not determined", "weak", "determined", "fixed", "published")
VAGUE = "its standard error is many times its value, so the test does not determine it"


@dataclass(frozen=True)
class Row:
    """One quantity and its reference, in the paper's unit ("s2 k_h+/k0", "" or "k0", "MPa")."""

    label: str
    unit: str
    fitted: ParameterEstimate  # the state of a ratio is the worst of its parts
    reference: ParameterEstimate | None  # a published one has no standard error
    remark: str  # why the two are not compared, or ""

    @property
    def lost(self) -> bool:
        """Whether there is a reference, but the test does not determine the parameter."""
        nothing = self.fitted.state == "not determined" or self.remark == VAGUE
        return nothing and self.reference is not None

    def difference_over(self, unit: float) -> float | None:
        """Return fitted minus reference over a unit; None if this is meaningless."""
        if self.remark or self.reference is None or not unit:
            return None
        return (self.fitted.value - self.reference.value) / unit

    @property
    def percent(self) -> float | None:
        """The difference in percent of the reference."""
        return self.difference_over(abs(self.reference.value) / 100.0 if self.reference else 0.0)

    @property
    def standard_errors(self) -> float | None:
        """The difference in standard errors; both sides are assumed to be independent."""
        errors = (one.stderr or 0.0 for one in (self.fitted, self.reference) if one)
        return self.difference_over(math.hypot(*errors))


@dataclass(frozen=True)
class Pair:
    """One result and its reference."""

    side: Side
    other: Side
    rows: tuple[Row, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """Results compared with their published sets, or with the first result."""

    pairs: tuple[Pair, ...]

    @property
    def reference(self) -> str:
        """The kind of reference in one word."""
        return "published" if all(pair.other.source for pair in self.pairs) else "reference"


def compare(results: Sequence[Result], published: str | None = None) -> Comparison:
    """Compare results (fits, result folders or the output of `load_result`) with published sets.

    Without `published`, each result is compared with the set that the name of its test contains,
    for example "foam-1/model-3"; if a test names none, all results are compared with the first.
    InputError if a result cannot be read, the set is unknown, or there is no reference.
    """
    sides = [side_of(result) for result in results]
    if not sides:
        raise InputError("nothing to compare; give at least one result folder")
    names = [published or (None if s.unpublished else recognised(s.given["test"])) for s in sides]
    references = [published_side(name) for name in names if name is not None]
    if len(references) == len(sides):
        return Comparison(tuple(map(_pair, sides, references)))
    if len(sides) == 1:
        kind, test = sides[0].unpublished, sides[0].given["test"]
        raise InputError(
            f"no published set has {kind} springs; give a second result to compare with"
            if kind
            else f"the test '{test}' names no published set; choose one by --published "
            f"({', '.join(published_sets)}), or give a second result"
        )
    return Comparison(tuple(_pair(side, sides[0]) for side in sides[1:]))


def recognised(test: str) -> str | None:
    """Return the published set that is named in the name of a test, if there is one."""
    plain = partial(re.sub, r"[\s/_-]+", "-")
    patterns = {rf"(?<![a-z0-9]){plain(name)}(?![0-9a-z])": name for name in published_sets}
    named = (name for word, name in patterns.items() if re.search(word, plain(test.casefold())))
    return next(named, None)


@dataclass(frozen=True)
class Side:
    """One side of a comparison: the parameters of a fit or of a published set."""

    label: str
    model: Model
    estimates: Mapping[str, ParameterEstimate]
    numbers: Mapping[str, Any] = field(compare=False)  # values with correlated errors
    given: Mapping[str, Any] = field(compare=False)  # content of fit.json
    source: PublishedSet | None = None

    @property
    def law(self) -> str:
        """The model and its relaxation in words."""
        return law_in_words(self.model.name, self.model.relaxation)

    @property
    def families(self) -> list[str]:
        """The kinds of the springs; all springs without hysteresis count as "linear"."""
        return [one.kind if one.hysteretic else "linear" for one in self.model.laws]

    @property
    def unpublished(self) -> str:
        """The first kind of spring without published parameters, or ""."""
        known = {kind for one in published_sets.values() for kind in one.model.split("+")}
        kinds = (one.kind for one in self.model.laws if one.hysteretic)
        return next((kind for kind in kinds if kind not in known), "")

    def evaluate(
        self, names: Sequence[str], formula: Callable[..., Any]
    ) -> ParameterEstimate | None:
        """Return a function of parameters with its error; None if it cannot be evaluated."""
        if not names or any(name not in self.estimates for name in names):
            return None
        try:
            value = formula(*(self.numbers[name] for name in names))
        except (ZeroDivisionError, ValueError):
            return None
        parts = (self.estimates[name] for name in names)
        worst = min(parts, key=lambda part: WORST_FIRST.index(part.state))
        error = 0.0 if worst.state == "not determined" else std_dev(value)
        return replace(worst, value=float(nominal_value(value)), stderr=error or None)


def side_of(result: Result) -> Side:
    """Return the parameters of a fit; InputError if the result is incomplete."""
    known = result.to_json_dict() if isinstance(result, Fit) else result
    given = known if isinstance(known, Mapping) else load_result(known)
    with reading(str(result) if isinstance(result, str | Path) else "the result"):
        model, about = Model.of_result(given), (given["test"], given["drive"], given["status"])
        every = given["parameters"].items()
        estimates = {n: build(ParameterEstimate, {**p, "state": p["state"]}, {}) for n, p in every}
        shared = given.get("correlation") or {"names": (), "matrix": ()}
        numbers = _with_errors(estimates, shared["names"], shared["matrix"])
        label = f"{about[0]}: {law_in_words(model.name, model.relaxation)}, {about[1]} drive"
        return Side(label, model, estimates, numbers, _GIVEN | dict(given))


def _with_errors(
    estimates: Mapping[str, ParameterEstimate], names: Sequence[str], matrix: Sequence[Any]
) -> dict[str, Any]:
    """Return values with correlated errors; parameters missing in the matrix are independent."""
    errors = {name: p.stderr for name, p in estimates.items() if p.stderr}
    numbers: dict[str, Any] = {name: p.value for name, p in estimates.items()}
    numbers |= {name: ufloat(numbers[name], error) for name, error in errors.items()}
    if kept := [i for i, name in enumerate(names) if name in errors]:
        known = np.array(matrix, dtype=float)[np.ix_(kept, kept)]
        known = np.where(np.isnan(known), np.eye(len(kept)), known)
        shared = [names[i] for i in kept]
        pairs = [(numbers[name].n, numbers[name].s) for name in shared]
        numbers |= zip(shared, correlated_values_norm(pairs, known), strict=True)
    return numbers


def published_side(name: str) -> Side:
    """Return the parameters of a published set; InputError if the name is unknown."""
    if name not in published_sets:
        known = ", ".join(published_sets)
        raise InputError(f"there is no published set '{name}'; there are {known}")
    item = published_sets[name]
    values = {} if item.eta is None else {"site_eta": item.eta}
    for i, spring in enumerate(item.chain.springs, start=1):
        values |= {f"s{i}_{name}": getattr(spring, name) for name in spring.law.own}
        values[f"s{i}_height"] = item.chain.heights[i - 1]
    estimates = {n: ParameterEstimate(x, vary=False, state="published") for n, x in values.items()}
    given = {"model": "+".join(spring.law.kind for spring in item.chain.springs)}
    return Side(f"published {name}", Model.of_result(given), estimates, values, _GIVEN, item)


def _pair(side: Side, other: Side) -> Pair:
    about: dict[str, Any] = {"side": side, "other": other}
    nothing = words("incomparable", **about)
    rows = tuple(_rows(side, other, nothing))
    ratios = any("/" in row.label for row in rows)
    return Pair(side, other, rows, sentences("remarks", nothing=nothing, ratios=ratios, **about))


def _total(*parts: Any) -> Any:
    return sum(parts)


_UNITS = {"Pa": (1e6, "MPa"), "Pa s": (1.0, "Pa·s"), "m": (1e-3, "mm")}
DAMPING = Compared("η", "Pa·s", (), _total)  # of the striker's motion


def _quantities(kind: str, relaxation: int) -> Iterator[Compared]:
    """Yield the compared quantities of a law: those of its record, or else each parameter."""
    own, hysteretic = law(kind), law(kind).hysteretic
    for row in own.compared or (*own.own, ETA.name, HEIGHT.name):
        if isinstance(row, Compared):
            yield row
            continue
        param = COMMON.get(row) or own.by_name[row]
        factor, unit = _UNITS.get(param.unit, (1.0, param.unit))
        yield Compared(param.label, unit, (row,), lambda value, factor=factor: value / factor)
    for k, param in itertools.product(range(1, relaxation + 1), (STRENGTH, RELAXATION_TIME)):
        if hysteretic:
            yield Compared(f"{param.symbol[0]}_{k}", param.unit, (f"{param.name}{k}",), _total)


def _row(
    label: str,
    one: Compared,
    names: tuple[list[str], list[str]],
    about: tuple[Side, Side, str],  # both sides, and why nothing is compared
    *,
    eta: bool,
) -> Iterator[Row]:
    """Yield the row of a function of parameters; a dashpot of zero beside no value has none."""
    side, other, nothing = about
    value, reference = (s.evaluate(n, one.formula) for s, n in zip(about[:2], names, strict=True))
    always = not eta or (other.source is not None and one is DAMPING)
    if value is None or not (always or value.value or (reference and reference.value)):
        return
    size = max(abs(p.value) for p in (value, reference) if p)
    vague = VAGUE if reference and (value.stderr or 0.0) > NOTHING * size else ""
    known: dict[str, Any] = {"value": value, "reference": reference, "side": side, "other": other}
    remark = nothing or words("remark", eta=eta, vague=vague, **known)
    yield Row(label, one.unit, value, reference, remark)


def _rows(side: Side, other: Side, nothing: str) -> Iterator[Row]:
    """Yield the rows of the springs, then those of the damping of the striker's motion."""
    item, several, about = other.source, len(side.model.kinds) > 1, (side, other, nothing)
    alike = [a == b for a, b in itertools.zip_longest(side.families, other.families)]
    for i, kind in enumerate(side.model.kinds, start=1):
        for one in _quantities(kind, side.model.relaxation):
            names, eta = [f"s{i}_{part}" for part in one.of], one.of == (ETA.name,)
            if several or not eta:  # the damping of a single spring counts with the onsite damper
                label = f"s{i} {one.label}" if several else one.label
                yield from _row(label, one, (names, names * alike[i - 1]), about, eta=eta)
    names = [n for n in ("site_eta", "s1_eta")[: 1 if several else 2] if n in side.estimates]
    same = [n for n in names if n in other.estimates] if item is None else ["site_eta"]
    for found in _row("site η" if several else "η", DAMPING, (names, same), about, eta=True):
        yield found
        yield from _damping_ratio(side, other, names, found) if item and not nothing else ()


def _damping_ratio(side: Side, other: Side, names: list[str], damping: Row) -> Iterator[Row]:
    """Yield the damping ratio as defined in the paper, for chains with one hysteretic spring."""
    item, soft = other.source, [i for i, one in enumerate(side.model.laws, 1) if one.hysteretic]
    if item is None or len(soft) != 1:
        return
    # The paper's ratio: ρ H = m/A, so that 2 H √(ρ k_c) = 2 √(m H k_c/A).
    inertia = item.striker_mass * item.chain.height / item.chain.area
    ratio = side.evaluate(
        [*names, f"s{soft[0]}_kc"],
        lambda *at: _total(*at[:-1]) / (2.0 * (inertia * at[-1]) ** 0.5),
    )
    if ratio is not None:
        # ζ is η over a square root, so it has the state of η unless k_c is undetermined.
        unknown = ratio.state == "not determined" and damping.fitted.state != "fixed"
        ratio = replace(ratio, state=ratio.state if unknown else damping.fitted.state)
        stated = None if item.damping_ratio is None else ParameterEstimate(item.damping_ratio)
        yield Row("ζ", "", ratio, stated, damping.remark)


def comparison_text(comparison: Comparison) -> str:
    """Return a comparison as aligned text of at most 100 columns, without a final newline."""
    return words("comparison", comparison=comparison, with_error=_with_error)


def _with_error(p: ParameterEstimate | None) -> str:
    """Return a number and its error, rounded to two digits of the error; "–" for None."""
    if p is None:
        return "–"
    if p.stderr is None:
        return significant(p.value, 4).replace("-", "−")
    return readable("", p, (1.0, "")).with_error


def plot_comparison(
    comparison: Comparison, path: str | Path | None = None, *, width: str = TWO
) -> Figure:
    """Draw fitted values with 95 % intervals and references as ticks; see `plots.plot_response`."""
    sources = [pair.other.source for pair in comparison.pairs]
    tests = [
        f"{pair.side.given['test'] if source is None else source.name}, {pair.side.given['drive']}"
        for source, pair in zip(sources, comparison.pairs, strict=True)
    ]
    if len(set(tests)) < len(tests):
        tests = [f"{i}: {name}" for i, name in enumerate(tests, start=1)]
    panels = dict[str, Values]()
    for test, pair in zip(tests, comparison.pairs, strict=True):
        for row in pair.rows:
            # What is neither compared nor lost is omitted.
            if row.reference and (row.standard_errors is not None or row.lost):
                one = panels.setdefault(row.label, Values(row.label, _math(row.label), {}, {}))
                one.tests[test] = _drawn(row.fitted, row.unit, row.fitted.state)
                one.references[test] = _drawn(row.reference, row.unit, comparison.reference)
    title = f"fitted and {comparison.reference} parameters"
    return figures.save(plot_parameters(title, tests, list(panels.values()), width=width), path)


def _drawn(p: ParameterEstimate, unit: str, state: str) -> ParameterEstimate:
    ends = None if p.stderr is None else (p.value - 1.96 * p.stderr, p.value + 1.96 * p.stderr)
    return replace(p, ci95=ends, unit=unit, state=state)


def _math(label: str) -> str:
    """Convert the symbols of a label to formulas: "s2 k_h+/k0" gives "s2 $k_{h+}$/$k_{0}$"."""
    *spring, name = label.split(" ")
    parts = re.findall(r"(Δ?\w)_?([^/]*)/?", name.translate(str.maketrans("₊₋−", "+--")))
    formulas = (f"${stem}_{{{index}}}$" if index else f"${stem}$" for stem, index in parts)
    return " ".join([*spring, "/".join(formulas)])
