"""The figures of a result: each is drawn once for all images of it, in whatever process."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any

from foamfit.report.figures import DPI, image, laid_out
from foamfit.report.identifiability_plots import plot_insight, plot_profiles
from foamfit.report.plots import plot_fit, plot_residuals
from foamfit.results import Fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Mapped = Callable[..., Iterable[Any]]  # as the built-in `map`
COARSE = 160  # dots per inch of what is only on the page, and should not take long
# In the order in which they are begun: what takes longest first.
FIGURES: dict[str, Callable[[Fit], Figure | None]] = {
    "fit": plot_fit,
    "insight": lambda result: _insight(result),
    "residuals": plot_residuals,
    "profiles": lambda result: _profiles(result),
}
PUBLISHED, COARSELY = ("fit",), ("insight",)  # also as a PDF; at `COARSE`


@dataclass(frozen=True)
class Images:
    """A figure as the bytes of files."""

    png: bytes
    dpi: int  # of the PNG
    pdf: bytes | None = None


def draw_all(result: Fit, mapped: Mapped = map) -> Iterable[tuple[str, Images | None]]:
    """Draw all figures of a result by a `map`; one that the result does not have is None.

    That of an executor draws them in its processes: it begins at once, and what is given is waited
    for when it is asked for.
    """
    drawn: dict[str, Any] = {field.name: getattr(result, field.name) for field in fields(Fit)}
    # No figure shows them, and another process would import lmfit, which takes it longest.
    drawn["params"] = None
    return zip(FIGURES, mapped(partial(_draw, Fit(**drawn)), FIGURES), strict=True)


def _draw(result: Fit, name: str) -> Images | None:
    figure = FIGURES[name](result)
    if figure is None:
        return None
    dpi = COARSE if name in COARSELY else DPI
    with laid_out(figure, dpi):
        pdf = image(figure, "pdf") if name in PUBLISHED else None
        return Images(image(figure, "png", dpi), dpi, pdf)


def _insight(result: Fit) -> Figure | None:
    matrix = None if result.correlation is None else result.correlation.matrix
    return None if result.insight is None else plot_insight(result.insight, matrix)


def _profiles(result: Fit) -> Figure | None:
    there = result.intervals is not None and result.intervals.profiles
    return plot_profiles(result) if there else None
