"""Templates of pages and texts; parameters in readable form, and tables of them: LaTeX, pandas."""

from __future__ import annotations

import functools
import json
import math
import re
import sys
import unicodedata
from base64 import b64encode
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit import text
from foamfit.codec import plain
from foamfit.parts import ParameterEstimate
from foamfit.report.figures import tail
from foamfit.springs.parameters import NUISANCE, any_param, family, split_name, springs_first
from foamfit.text import UNITS, fixed, number, readable_unit, with_error

if TYPE_CHECKING:
    import pandas as pd
    from jinja2 import Environment

APART = 1e3  # ratio of two numbers from which each has a unit of its own, if it has prefixes
NOTHING = 1e-4  # a number below this share of another is zero beside it, if units have no prefix
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


@functools.cache
def environment() -> Environment:
    """Return the templates of all pages, texts and cards, with filters that format numbers."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape
    from jinja2.bccache import Bucket, FileSystemBytecodeCache

    class Compiled(FileSystemBytecodeCache):
        """Keeps compiled templates beside the compiled modules, if that folder can be written."""

        def dump_bytecode(self, bucket: Bucket) -> None:
            if not sys.dont_write_bytecode:
                with suppress(OSError):
                    super().dump_bytecode(bucket)

    made = Environment(
        loader=ChoiceLoader([PackageLoader(f"foamfit.{of}") for of in ("report", "cards", "page")]),
        extensions=["jinja2.ext.do"],
        autoescape=select_autoescape(("html",)),
        bytecode_cache=Compiled(str(Path(__file__).with_name("__pycache__"))),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name in ("percent", "engineering", "significant", "signed", "number", "field", "warning"):
        made.filters[name] = getattr(text, name)
    made.filters.update(counted=text.counted, listed=text.listed, in_unit=in_unit, exp=math.exp)
    made.filters["paragraphs"] = _paragraphs
    made.filters["aligned"] = lambda rows, **more: "\n".join(text.aligned(list(rows), **more))
    made.filters["svg"] = lambda svg: "data:image/svg+xml;base64," + b64encode(svg).decode()
    made.filters["tail"] = tail
    made.filters["quoted"] = functools.partial(json.dumps, ensure_ascii=False)
    made.filters["filename"] = lambda path: Path(path).name
    made.filters["spoken"] = lambda name: name.replace("_", "-")
    made.globals["version"] = version("foamfit")
    return made


def page(name: str, **values: Any) -> str:
    """Render an HTML page."""
    return environment().get_template(f"{name}.html").render(**values)


def words(name: str, **values: Any) -> str:
    """Render a text for the terminal, without a final newline."""
    return environment().get_template(f"{name}.txt").render(**values).rstrip("\n")


def sentences(name: str, **values: Any) -> tuple[str, ...]:
    """Render a text with one sentence per line and return its lines without the empty ones."""
    return tuple(line for line in words(name, **values).splitlines() if line.strip())


def table(name: str, **values: Any) -> list[list[str]]:
    """Render a text with one row per line and return its cells, which "¦" separates."""
    return [line.split("¦") for line in words(name, **values).splitlines()]


def _paragraphs(content: str, indent: int = 2) -> str:
    """Wrap each line of a text as a separate paragraph; keep empty lines."""
    lines = (text.wrapped(line, indent) or [""] for line in content.split("\n"))
    return "\n".join(line for paragraph in lines for line in paragraph)


@dataclass(frozen=True)
class Readable:
    """A parameter in a suitable unit, with numbers rounded to its uncertainty."""

    name: str
    symbol: tuple[str, str]  # symbol and index
    value: str
    stderr: str
    interval: str
    unit: str
    state: str
    why: str
    method: str = ""
    range: str = ""
    systematic: str = ""

    @property
    def label(self) -> str:
        """The name in reports; for parameters of springs, the name in fit.json."""
        return NUISANCE[self.name].what if self.name in NUISANCE else self.name

    @property
    def with_error(self) -> str:
        """The value with its standard error, if there is one."""
        return f"{self.value} ± {self.stderr}" if self.stderr else self.value

    def with_unit(self, number: str) -> str:
        """Append the unit, if there is one, to a number of this parameter that has none."""
        own = not number or number[-1].isalpha()
        return number if own else f"{number} {self.unit}".removesuffix(" –")

    @property
    def told(self) -> str:
        """Name, value, standard error and unit."""
        return f"{self.label} {self.with_unit(self.with_error)}"

    @property
    def tied(self) -> bool:
        """Whether an expression of other parameters gives the value."""
        return self.state == "fixed" and self.why.startswith("tied by")

    @property
    def matters(self) -> bool:
        """Whether the reason is worth showing: not determined, or a remark after a semicolon."""
        return self.state != "fixed" and (self.state != "determined" or ";" in self.why)


def readable(name: str, p: ParameterEstimate, given: tuple[float, str] | None = None) -> Readable:
    """Return a parameter in readable form, in a given unit (factor and name) or a suitable one."""
    half = abs(p.ci95[1] - p.ci95[0]) / 2.0 if p.ci95 else 0.0
    sizes = [abs(p.value), p.stderr or 0.0, half]  # the value may be far below its error
    factor, unit = given or readable_unit(max(filter(math.isfinite, sizes), default=0.0), p.unit)
    value = p.value / factor
    shown, stderr, interval = number(value), "", ""  # four digits, or two of the standard error
    if math.isfinite(value) and p.stderr is not None and 0 < p.stderr < math.inf:
        shown, stderr, places = with_error(value, p.stderr / factor)
        if p.ci95 is not None:
            interval = " to ".join(fixed(bound / factor, places) for bound in p.ci95)
    span = "" if p.range is None else _span(p.range, p.unit, factor)
    least = NOTHING * max(sizes)  # what is less comes from rounding
    scale = f"{p.systematic / factor:.2g}" if p.systematic and p.systematic > least else ""
    rest = (p.state, p.why, p.ci95_method or "", span, scale)
    return Readable(name, symbol(name), shown, stderr, interval, unit or "–", *rest)


def _span(ends: tuple[float, float], unit: str, factor: float) -> str:
    """Write the ends of a range in the unit of `factor`, unless far apart or far above it."""
    least, most = sorted(map(abs, ends))
    width = ends[1] - ends[0]
    digits = 2 + (math.floor(math.log10(most / width)) if 0.0 < 10.0 * width < most else 0)
    if UNITS.get(unit, [])[1:] and (0.0 < APART * least <= most or most >= 10.0 * APART * factor):
        return in_unit(ends, unit, digits)
    seen = (end / factor if abs(end) > NOTHING * most else 0.0 for end in ends)
    return " to ".join(_few(end, digits) for end in seen)


def own_name(name: str, model: str) -> str:
    """Return the name of a parameter, without the spring if there is only one."""
    return name if "+" in model else name.removeprefix("s1_")


def in_unit(values: Sequence[float], unit: str, digits: int = 4) -> str:
    """Format a value or the ends of an interval; far apart, each has a unit: "1 kPa to 2 GPa"."""
    sizes = [abs(value) for value in values if value]
    if UNITS.get(unit, [])[1:] and sizes and max(sizes) >= APART * min(sizes):
        return " to ".join(in_unit([value], unit, digits) for value in values)
    factor, name = readable_unit(max(sizes, default=0.0), unit)
    return f"{' to '.join(_few(value / factor, digits) for value in values)} {name}".rstrip()


def _few(value: float, digits: int) -> str:
    return number(float(f"{value:.{digits}g}"), digits)


def symbol(name: str) -> tuple[str, str]:
    """Return the symbol of a parameter and its index: k and "c,2" for s2_kc."""
    spring, short = split_name(name)
    if name in NUISANCE:
        return NUISANCE[name].symbol
    if spring < 0:
        return ("η", "site") if name == "site_eta" else (name, "")
    stem, index = any_param(short).symbol
    term = short.removeprefix(family(short))  # number of the relaxation term
    return stem, ",".join(filter(None, (index, term, str(spring + 1))))


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
