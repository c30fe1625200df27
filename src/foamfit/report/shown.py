"""Results as shown by Python and notebooks: a few lines of text, or one line and a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from foamfit.report.plots import draw_loops
from foamfit.report.readable import Readable, readable
from foamfit.report.render import page
from foamfit.report.tables import frame, stacked
from foamfit.springs.parameters import NUISANCE
from foamfit.text import counted, wrapped

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

Joint = Any  # `foamfit.study.joint_result.JointResult`


def brief(title: str, line: str, rows: Sequence[Readable], html: bool, table: Any = None) -> str:
    """Return a result in a few lines, or as HTML with a table of parameters or tests."""
    if html:
        return page("shown", title=title, line=line, rows=rows, by_test=table)
    marks = {"weak": " (weak)", "not determined": " (not determined)"}
    values = (f"{p.label} {p.with_unit(p.with_error)}{marks.get(p.state, '')}" for p in rows)
    return "\n".join([*wrapped(f"{title}: {line}", 2), *wrapped(", ".join(values), 2)])


class Shown:
    """A result that Python shows in a few lines, and a notebook with a table."""

    def _shown(self, *, html: bool = False) -> str:
        """Return the result as text or HTML."""
        raise NotImplementedError

    def __repr__(self) -> str:
        """Return the result in a few lines."""
        return self._shown()

    def _repr_html_(self) -> str:
        return self._shown(html=True)


class JointViews(Shown):
    """Plot, table and short text of a joint fit."""

    def plot(self: Joint, ax: Axes | None = None) -> Axes:
        """Draw the loops of all tests, measured and fitted, into axes or a new figure."""
        return draw_loops(self.loops, ax)

    def table(self: Joint) -> pd.DataFrame:
        """Return a row for each test and parameter, in SI; common values have the test "".

        `kind`, `scatter` and `b` are as in joint.json. The output of `to_latex` compiles.
        """
        common = {n: p for n, p in self.parameters.items() if p.kind != "own"}
        more = ("kind", "scatter", "b")
        columns = {key: {n: getattr(p, key) for n, p in common.items()} for key in more}
        frames = {"": frame(common, **columns)}
        for test in self.tests:
            own = {n: p for n, p in self.parameters.items() if p.tests and test in p.tests}
            kinds = {name: p.kind for name, p in own.items()}
            each = {name: p.in_test(test) for name, p in own.items()}
            frames[test] = frame(each, kind=kinds, scatter={}, b={})
        return stacked(frames, "test")

    def _shown(self: Joint, *, html: bool = False) -> str:
        """Return name, model, number of tests, status and the common values."""
        line = f"{self.model} · {counted(len(self.tests), 'test')} together · status {self.status}"
        every = self.parameters.items()
        common = {n: p for n, p in every if p.kind != "fixed" and n not in NUISANCE}
        rows = [readable(name, p) for name, p in common.items()]
        return brief(self.name, line, rows, html)
