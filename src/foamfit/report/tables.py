"""Tables of parameters for a paper: LaTeX with booktabs, and pandas."""

from __future__ import annotations

import functools
import re
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.codec import plain
from foamfit.parts import ParameterEstimate
from foamfit.report.render import environment, readable, symbol
from foamfit.springs.parameters import NUISANCE, split_name, springs_first
from foamfit.text import readable_unit

if TYPE_CHECKING:
    import pandas as pd

_MATH = {"−": "-", "·": r"\cdot ", "±": r"\pm ", "²": "^2", "³": "^3", "µ": r"\mu "}
_MATH |= {"₀": "_0", "₊": "_+", "₋": "_-"}
for _letter in "αβγδεζηθκλμνξπρστφχψωΓΔΘΛΞΠΣΦΨΩ":
    _, _size, _, _name = unicodedata.name(_letter).replace("LAMDA", "LAMBDA").split()
    _MATH[_letter] = f"\\{_name.lower() if _size == 'SMALL' else _name.capitalize()} "
_MATH["ε"] = r"\varepsilon "
_TEXT = {letter: f"${name.strip()}$" for letter, name in _MATH.items()}
_TEXT |= {letter: f"\\{letter}" for letter in "&%$#_{}"}
_TEXT |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_TEXT |= {"–": "--", "…": r"\dots{}"} | {letter: f"${letter}$" for letter in "<>|"}
_TEXT |= {letter: f"{{{letter}}}" for letter in "[]*"}  # options at the start of a row
_LAST_LETTER = "ſ"  # last letter that pdfLaTeX sets without further packages
# Names of the misfits in a table with one row per test.
MISFITS = {"stress_strain": "loop", "stress_time": "σ(t)", "displacement_time": "w(t)"}
Parameters = Mapping[str, ParameterEstimate]
ByTest = Mapping[str, Sequence[ParameterEstimate | None]]


def escaped(text: object) -> str:
    """Escape a text for LaTeX; "?" replaces letters that its fonts lack."""
    letters = (c if c.isprintable() else " " for c in str(text))
    return "".join(_TEXT.get(c, c if c <= _LAST_LETTER else "?") for c in letters)


def formula(pair: tuple[str, str]) -> str:
    """Return a symbol and its index as LaTeX: `$k_{0,1}$`."""
    stem, index = pair
    if len(stem) > 2:  # the name of a parameter without a symbol
        return rf"$\mathrm{{{escaped(stem)}}}$"
    stem, index = ("".join(_MATH.get(c, c) for c in part).strip() for part in pair)
    index = re.sub(r"[a-z]{2,}", lambda word: rf"\mathrm{{{word[0]}}}", index)  # words upright
    return f"${stem}_{{{index}}}$" if index else f"${stem}$"


def numbers(text: str) -> str:
    """Return "5.50 ± 0.01" or "1 to 2" as LaTeX."""
    text = re.sub(r"e\+?(-?)0*(\d+)", r"\\times 10^{\1\2}", text.replace("−", "-"))
    text = re.sub(r"(\S+) ± (\S+times \S+)", r"\1 \\pm (\2)", text)
    return " to ".join(f"${one.replace('±', chr(92) + 'pm')}$" for one in text.split(" to ") if one)


def parameters_tex(parameters: Parameters, **more: Any) -> str:
    """Return table.tex of a fit without what is fixed at zero; `more`: `kinds` and `between`."""
    shown = {n: p for n, p in parameters.items() if p.state != "fixed" or p.value}
    rows = [(own, readable(name, shown[name])) for name, own in symbols(shown).items()]
    return _tex("parameters", rows=rows, **({"kinds": {}, "between": {}} | more))


def count_determined(parameters: Parameters) -> tuple[int, int]:
    """Return how many parameters of the springs are determined, and how many have a state."""
    judged = [p for name, p in parameters.items() if p.vary and p.state and name not in NUISANCE]
    return sum(p.state == "determined" for p in judged), len(judged)


def varied(each: Sequence[Parameters]) -> dict[str, list[ParameterEstimate | None]]:
    """Return, for each parameter varied in any test, its values in all tests; None if missing."""
    out = dict[str, list[ParameterEstimate | None]]()
    for name in springs_first(name for one in each for name in one):
        values = (one.get(name) for one in each)
        finite = [p if p is not None and np.isfinite(p.value) else None for p in values]
        if any(p is not None and p.vary for p in finite):
            out[name] = finite
    return out


def with_head(rows: Iterable[Mapping[str, object]]) -> Iterator[Iterable[object]]:
    """Yield the column names of a table, then the cells of each row."""
    for i, row in enumerate(rows):
        yield from ([row] if i == 0 else [])
        yield row.values()


def wide(each: Sequence[Parameters]) -> Iterator[dict[str, Any]]:
    """Yield the parameters of each test as a row of a table, in SI; None for missing values."""
    names = springs_first(name for one in each for name in one)
    for parameters in each:
        row = dict[str, Any]()
        for name, p in zip(names, map(parameters.get, names), strict=True):
            low, high = (p and p.ci95) or (None, None)
            row |= {name: p and p.value, f"{name}_stderr": p and p.stderr}
            row |= {f"{name}_lo": low, f"{name}_hi": high, f"{name}_state": p and p.state}
        yield plain(row)


def by_test(tests: Sequence[str], parameters: ByTest) -> dict[str, Any]:
    """Return heads and rows of a table with one row per test and one column per parameter."""
    heads, cells = [], []
    for name, own in symbols(parameters).items():
        factor, unit = unit_of_all(parameters[name])
        heads.append((own, unit))
        cells.append([one and readable(name, one, (factor, unit)) for one in parameters[name]])
    return {"heads": heads, "rows": list(zip(tests, *cells, strict=True))}


def by_test_tex(first: str, tests: Sequence[str], parameters: ByTest) -> str:
    """Return a table of `by_test` as LaTeX; `first` is the head of the first column."""
    return _tex("by_test", first=first, **by_test(tests, parameters))


def symbols(names: Collection[str]) -> dict[str, tuple[str, str]]:
    """Return the symbols of parameters, without the spring if there is only one."""
    found = {name: symbol(name) for name in names}
    if not any(name.startswith("s2_") for name in names):
        alone = {name: pair for name, pair in found.items() if split_name(name)[0] >= 0}
        found |= {name: (stem, index.rpartition(",")[0]) for name, (stem, index) in alone.items()}
    return found


def unit_of_all(each: Iterable[ParameterEstimate | None]) -> tuple[float, str]:
    """Return factor and name of a suitable unit for the values of several tests."""
    finite = [one for one in each if one is not None and np.isfinite(one.value)]
    known = [one for one in finite if one.state != "not determined"] or finite
    size = float(np.median([abs(one.value) for one in known])) if known else 0.0
    return readable_unit(size, finite[0].unit if finite else "")


def _tex(name: str, **values: Any) -> str:
    values |= {"tex": escaped, "formula": formula}
    return environment().get_template(f"{name}.tex").render(numbers=numbers, **values)


def frame(parameters: Mapping[str, Any], **more: Mapping[str, Any]) -> pd.DataFrame:
    """Return a row for each parameter, in SI; `more` are further columns, by parameter."""
    rows = []
    for name, own in symbols(parameters).items():
        p = parameters[name]
        row = {"parameter": name, "symbol": formula(own), **numbers_of(p)}
        row |= {key: values.get(name) for key, values in more.items()}
        known = {key: np.nan if one is None else one for key, one in row.items()}
        rows.append(known | {"unit": getattr(p, "unit", ""), "state": p.state})
    return _frame_type()(rows, columns=None if rows else ["parameter"]).set_index("parameter")


def numbers_of(p: Any) -> dict[str, float | None]:
    """Return the numbers of a parameter by column name, in SI; None for missing values."""
    (low, high), (least, most) = p.ci95 or (None, None), p.range or (None, None)
    ends = {"ci95_lo": low, "ci95_hi": high, "range_lo": least, "range_hi": most}
    return {"value": p.value, "stderr": p.stderr, **ends, "systematic": p.systematic}


def stacked(frames: Mapping[Any, pd.DataFrame], name: str) -> pd.DataFrame:
    """Concatenate the tables of several tests; `name` is that of the new index level."""
    import pandas as pd

    filled = {key: one for key, one in frames.items() if len(one)}
    return _frame_type()(pd.concat(filled, names=[name]))


@functools.cache
def _frame_type() -> type[pd.DataFrame]:
    import pandas as pd

    class Table(pd.DataFrame):
        """A table whose LaTeX compiles: names are escaped, symbols are formulas."""

        @property
        def _constructor(self) -> Any:
            return Table

        def to_latex(self, *args: Any, **options: Any) -> Any:
            """Return the table as LaTeX with booktabs; arguments are those of pandas."""
            texts = self.columns.difference(["symbol"])
            plain = pd.DataFrame(self).assign(**{name: self[name].map(_cell) for name in texts})
            names = [escaped(name or "") for name in plain.index.names]
            plain = plain.rename(index=_cell, columns=_cell).rename_axis(index=names)
            chosen: Any = {"multirow": False, "na_rep": "--"} | options
            return plain.to_latex(*args, **chosen)

    return Table


def _cell(value: object) -> object:
    return escaped(value) if isinstance(value, str) else value
