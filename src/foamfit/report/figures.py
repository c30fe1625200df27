"""Colours, style, layout and saving of all figures."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from foamfit.errors import InputError
from foamfit.files import write_file
from foamfit.text import wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Format = Literal["png", "pdf", "svg"]

GREY, BLUE, VERMILION = "#6b6b6b", "#0072B2", "#D55E00"  # palette of Okabe and Ito
INSIDE = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # interior masses, from the base up
SEEN: Any = {"color": "0.65", "lw": 1.5}  # measured loops of small figures, also told in greyscale
STYLE: Any = {  # matplotlib types its keys one by one
    "font.family": "DejaVu Sans",  # one upright font: each further font costs 0.1 s per PDF
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
    # Keep text editable and searchable: TrueType in a PDF, text elements in an SVG.
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "foamfit",  # the same figure gives the same file
}
DPI = 250  # of a PNG
TWO = "two"
COLUMNS = {"one": 3.25, TWO: 7.0}  # widths in the Journal of Applied Mechanics, inches
NARROWEST, WIDEST = 2.5, 20.0
UNTITLED = "untitled"  # option after a width and a comma
LINE = 11.0 / 72.0  # height of a line of a title or a legend, inches
LETTERS = 14  # letters of a title per inch


def inches(width: str) -> float:
    """Return the width of a figure from "one" or "two" columns or a length such as "85 mm"."""
    from foamfit.data.units import parse_quantity

    length, _, option = (part.strip().lower() for part in width.partition(","))
    if (wide := COLUMNS.get(length)) is None:
        wide = round(parse_quantity(length, "m", "the width of figures", "85 mm") / 0.0254, 6)
    if not NARROWEST <= wide <= WIDEST or option not in ("", UNTITLED):
        low, high = (f"{25.4 * end:.0f}" for end in (NARROWEST, WIDEST))
        raise InputError(
            f"the width of figures = {width!r} is not admissible; it must be one, two (columns) or "
            f"a length from {low} to {high} mm, optionally followed by a comma and untitled"
        )
    return wide


def title(width: str, *parts: str) -> tuple[str, ...]:
    """Return the parts of a title, or none if the width has the option "untitled"."""
    return () if width.strip().lower().endswith(UNTITLED) else parts


def abreast(width: float, panels: int, least: float = 2.1) -> int:
    """Return the number of panels of at least `least` inches that fit side by side."""
    return max(1, min(panels, int(width / least)))


def tail(name: str, most: int) -> str:
    """Return a name, or only its end if it is longer than `most` characters."""
    return name if len(name) <= most else f"…{name[1 - most :]}"


@contextmanager
def drawing(
    width: float, height: float, *title: str, layout: Literal["constrained"] | None = "constrained"
) -> Iterator[Figure]:
    """Yield an empty figure in the common style; the title adds to its height (inches)."""
    import matplotlib
    from matplotlib.figure import Figure

    lines = [line for part in title for line in wrapped(part, 0, int(LETTERS * width))]
    height += LINE * len(lines)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout=layout)
        if lines:  # a dollar sign in a name does not start a formula
            style: Any = {"fontsize": 8, "parse_math": False}
            style |= {} if layout else {"y": 1.0 - 0.05 / height}
            figure.suptitle("\n".join(lines), x=0.01, ha="left", **style)
        yield figure


@contextmanager
def axes_or_new(ax: Axes | None) -> Iterator[Axes]:
    """Yield the axes of the caller, or those of a new pyplot figure in the common style."""
    if ax is not None:
        yield ax
        return
    import matplotlib
    from matplotlib import pyplot

    with matplotlib.rc_context(STYLE):
        yield pyplot.subplots(figsize=(4.5, 3.2), layout="constrained")[1]


def legend_below(figure: Figure, axes: Iterable[Axes], first: Iterable[str] = ()) -> None:
    """Draw a legend below all panels, labels `first` first; lines after one add to the height."""
    each = (zip(*reversed(ax.get_legend_handles_labels()), strict=True) for ax in axes)
    entries = {name: artist for pairs in each for name, artist in pairs}
    entries = {name: entries[name] for name in first if name in entries} | entries
    if not entries:
        return
    # In points: 4.2 per letter, 33 for a handle with its margins.
    sizes, room = [4.2 * len(name) + 33.0 for name in entries], 72.0 * figure.get_figwidth()
    for columns in range(len(sizes), 0, -1):
        lines = -(-len(sizes) // columns)
        widths = [max(sizes[i : i + lines]) for i in range(0, len(sizes), lines)]
        if sum(widths) <= room:
            break
    names = [name.replace("$", r"\$") for name in entries]
    figure.legend(entries.values(), names, loc="outside lower center", ncols=len(widths))
    figure.set_figheight(figure.get_figheight() + LINE * (lines - 1))


def images(figure: Figure, *forms: Format, dpi: int = DPI) -> list[bytes]:
    """Return the figure as the bytes of a file of each format; `dpi` is that of pixels."""
    import matplotlib

    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # in names of tests
        # The layout is found once for all formats, as it takes longer than drawing one.
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
            figure.set_layout_engine(None)
        try:
            return [_file(figure, form, dpi) for form in forms]
        finally:
            figure.set_layout_engine(engine)


def _file(figure: Figure, form: Format, dpi: int) -> bytes:
    """Return the figure, laid out, as the bytes of a file."""
    buffer = io.BytesIO()
    # Without a date the same fit gives the same file.
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(form)
    more: Any = {"pil_kwargs": {"compress_level": 3}} if form == "png" else {}  # twice as fast
    figure.savefig(buffer, format=form, dpi=dpi, metadata=metadata, **more)
    if form != "svg":
        return buffer.getvalue()
    # Verdana has nearly the same widths, where a browser lacks the font.
    return buffer.getvalue().replace(b"'DejaVu Sans'", b"'DejaVu Sans', Verdana, sans-serif")


def limits(values: Sequence[float], ends: Sequence[float]) -> tuple[float, float]:
    """Return limits of an axis; very wide intervals are cut, so that values stay apart."""
    low, high = min(values), max(values)
    room = max(1.5 * (high - low), 0.1 * max(abs(low), abs(high)))
    room = room or max(map(abs, ends), default=0.0) or 1.0  # all are zero
    bottom, top = max(min([low, *ends]), low - room), min(max([high, *ends]), high + room)
    edge = 0.08 * max(top - bottom, room)
    return bottom - edge, top + 2.0 * edge


def say_nothing_there(ax: Axes, text: str = "no curve to compare") -> None:
    """Write into an empty panel why it is empty."""
    ax.set_axis_off()
    ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes)


def figure_format(path: str | Path) -> Format:
    """Return the format given by the suffix of a path; InputError if it is not supported."""
    match Path(path).suffix.lower()[1:]:
        case ("png" | "pdf" | "svg") as form:
            return form
    raise InputError(f"a figure is saved as .png, .pdf or .svg, not {Path(path).name!r}")


def write_both(figure: Figure, place: Path) -> bytes:
    """Write `place`.png and .pdf and return SVG; OSError is explained by `folder.save_whole`."""
    png, pdf, svg = images(figure, "png", "pdf", "svg")
    place.with_suffix(".png").write_bytes(png)
    place.with_suffix(".pdf").write_bytes(pdf)
    return svg


def save(figure: Figure, path: str | Path | None) -> Figure:
    """Save a figure in the format of the suffix of `path`, if there is one; return the figure."""
    if path is not None:
        write_file(path, *images(figure, figure_format(path)))
    return figure
