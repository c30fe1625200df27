"""What all figures share: colours, style, one layout for all images of a figure, saving."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from foamfit.errors import InputError
from foamfit.files import write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GREY, BLUE, VERMILION = "#6b6b6b", "#0072B2", "#D55E00"  # of Okabe and Ito, told apart by all
INSIDE = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # of masses inside, from the base up
STYLE: Any = {  # matplotlib types its keys one by one
    "font.family": "DejaVu Sans",  # upright and regular: a PDF takes 0.1 s for every font
    "font.size": 7.5,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "pdf.fonttype": 42,
}
NO_LAYOUT = {"figure.autolayout": False, "figure.constrained_layout.use": False}
DPI = 250  # of a PNG


@contextmanager
def drawing(width: float, height: float) -> Iterator[Figure]:
    """Give an empty figure of a size in inches, and the style of all figures to draw it in."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        yield Figure(figsize=(width, height), layout="constrained")


@contextmanager
def laid_out(figure: Figure, dpi: int = DPI) -> Iterator[None]:
    """Keep one layout of a figure for all images that are made of it within.

    Left to itself matplotlib lays a figure out anew for every image, and draws it once more for
    that, unseen. `dpi` is the resolution at which its texts are measured.
    """
    import matplotlib

    engine, own_dpi = figure.get_layout_engine(), figure.dpi
    if engine is None:
        yield
        return
    with matplotlib.rc_context(STYLE | NO_LAYOUT), _unnamed_letters():
        figure.dpi = dpi
        engine.execute(figure)
        figure.dpi = own_dpi
        figure.set_layout_engine(None)  # "none" leaves a dummy, for which all is drawn twice
    try:
        yield
    finally:
        figure.set_layout_engine(engine)


@contextmanager
def _unnamed_letters() -> Iterator[None]:
    """Let a test be named in letters that the font lacks: the figure is good without them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


def image(figure: Figure, form: Literal["png", "pdf", "svg"], dpi: int = DPI) -> bytes:
    """Return the figure as the bytes of a file; `dpi` is that of a PNG."""
    import matplotlib

    buffer = io.BytesIO()
    # Without the date, the same fit gives the same file.
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(form)
    with laid_out(figure, dpi), matplotlib.rc_context(STYLE), _unnamed_letters():
        figure.savefig(buffer, format=form, dpi=dpi, metadata=metadata)
    return buffer.getvalue()


def say_nothing_there(ax: Axes) -> None:
    """Write into an empty panel that there is no curve."""
    ax.set_axis_off()
    ax.text(0.5, 0.5, "no curve to compare", ha="center", va="center", transform=ax.transAxes)


def figure_format(path: str | Path) -> Literal["png", "pdf", "svg"]:
    """Return the format that the suffix of a path names; any other is refused."""
    match Path(path).suffix.lower()[1:]:
        case ("png" | "pdf" | "svg") as form:
            return form
    raise InputError(f"a figure is saved as .png, .pdf or .svg, not {Path(path).name!r}")


def save(figure: Figure, path: str | Path | None) -> Figure:
    """Save a figure, if there is a path, in the format of its suffix; returns the figure."""
    if path is not None:
        write_file(path, image(figure, figure_format(path)))
    return figure
