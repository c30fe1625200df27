"""The figures of a result, each drawn once for all its files, in any process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any

from foamfit.report.figures import DPI, TWO, UNTITLED, all_as_pdf, image, laid_out
from foamfit.report.plots import plot_fit
from foamfit.report.report_plots import plot_profiles, plot_snapping
from foamfit.results import Fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Mapped = Callable[..., Iterable[Any]]  # as the built-in `map`
SHOWN = 200  # dots per inch of figures that are only on the page, to save time
# In the order in which they are begun. Those on the screen show the fit on the page, which has its
# own title, and on a phone.
_ON_SCREEN = ("shown", "narrow")
_NAMES = ("fit", *_ON_SCREEN, "snapping", "profiles")


@dataclass(frozen=True)
class Images:
    """A figure as the bytes of files: `pdf` where it is for print."""

    png: bytes
    dpi: int  # of the PNG
    pdf: bytes | None = None

    @property
    def width(self) -> float:
        """Its width in inches; that in pixels stands in the header of the PNG."""
        return int.from_bytes(self.png[16:20]) / self.dpi


def draw_all(
    result: Fit, width: str = TWO, mapped: Mapped = map
) -> Iterator[tuple[str, Images | None]]:
    """Draw all figures of a result by a `map`; one that the result does not have is None.

    A `map` of an executor draws them in its processes: it begins at once, and what is given is
    waited for when it is asked for. `width` is that of "fit" (`foamfit.report.plots.plot_fit`);
    with ", pdf" behind it all but those on the screen are made as PDF too.
    """
    drawn: dict[str, Any] = {field.name: getattr(result, field.name) for field in fields(Fit)}
    # No figure needs them, and unpickling them would import lmfit, the slowest import.
    drawn["params"] = None
    images = mapped(partial(_draw, Fit(**drawn), width), _NAMES)  # begins before it is asked for
    return zip(_NAMES, images, strict=True)


def _draw(result: Fit, width: str, name: str) -> Images | None:
    figure = _figure(result, width, name)
    if figure is None:
        return None
    dpi = DPI if name == "fit" else SHOWN
    with laid_out(figure, dpi):
        printed = name == "fit" or (all_as_pdf(width) and name not in _ON_SCREEN)
        pdf = image(figure, "pdf") if printed else None
        png = image(figure, "png", dpi)
    return Images(png, dpi, pdf)


def _figure(result: Fit, width: str, name: str) -> Figure | None:
    """Draw one of the figures, if the result has it."""
    if name == "profiles":
        return plot_profiles(result) if result.intervals and result.intervals.profiles else None
    if name == "snapping":
        return plot_snapping(result)
    columns = {"fit": width, "shown": f"{TWO}, {UNTITLED}", "narrow": f"one, {UNTITLED}"}
    return plot_fit(result, width=columns[name])
