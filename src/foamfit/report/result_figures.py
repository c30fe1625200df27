"""The figures of a result: each is drawn once for all files of it, in whatever process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any

from foamfit.report.figures import DPI, TWO, image, inches, laid_out
from foamfit.report.identifiability_plots import plot_insight, plot_profiles
from foamfit.report.plots import plot_fit, plot_residuals
from foamfit.results import Fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Mapped = Callable[..., Iterable[Any]]  # as the built-in `map`
COARSE = 160  # dots per inch of a figure that is only on the page, to save time
# In the order in which they are begun: what takes longest first. "shown" is the fit on the page,
# two columns wide as all others there.
_NAMES = ("fit", "shown", "information", "residuals", "profiles")


@dataclass(frozen=True)
class Images:
    """A figure as the bytes of files: `pdf` where it is for print."""

    png: bytes
    dpi: int  # of the PNG
    pdf: bytes | None = None

    def files(self) -> Iterator[tuple[str, bytes]]:
        """Suffix and content of the files that are kept beside the report."""
        if self.pdf is not None:
            yield from (("png", self.png), ("pdf", self.pdf))


def draw_all(
    result: Fit, width: str = TWO, mapped: Mapped = map
) -> Iterator[tuple[str, Images | None]]:
    """Draw all figures of a result by a `map`; one that the result does not have is None.

    A `map` of an executor draws them in its processes: it begins at once, and what is given is
    waited for when it is asked for. `width` is that of "fit" (`foamfit.report.plots.plot_fit`).
    """
    again = inches(width) != inches(TWO)
    names = [name for name in _NAMES if again or name != "shown"]
    drawn: dict[str, Any] = {field.name: getattr(result, field.name) for field in fields(Fit)}
    # No figure needs them, and unpickling them would import lmfit, the slowest import.
    drawn["params"] = None
    images = mapped(partial(_draw, Fit(**drawn), width), names)  # begins before it is asked for

    def given() -> Iterator[tuple[str, Images | None]]:
        for name, one in zip(names, images, strict=True):
            yield name, one
            if name == "fit" and not again:
                yield "shown", Images(one.png, one.dpi)

    return given()


def _draw(result: Fit, width: str, name: str) -> Images | None:
    figure = _figure(result, width, name)
    if figure is None:
        return None
    dpi = COARSE if name == "information" else DPI
    with laid_out(figure, dpi):
        pdf = image(figure, "pdf") if name == "fit" else None
        png = image(figure, "png", dpi)
    return Images(png, dpi, pdf)


def _figure(result: Fit, width: str, name: str) -> Figure | None:
    """Draw one of the figures, if the result has it."""
    if name == "residuals":
        return plot_residuals(result)
    if name == "information":
        matrix = None if result.correlation is None else result.correlation.matrix
        return None if result.insight is None else plot_insight(result.insight, matrix)
    if name == "profiles":
        return plot_profiles(result) if result.intervals and result.intervals.profiles else None
    return plot_fit(result, width=width if name == "fit" else TWO)
