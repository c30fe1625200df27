"""What was fitted, to look at: the three panels of the paper's Figs. 3 and 4, and the residuals."""

from __future__ import annotations

import io
import re
import textwrap
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from foamfit.errors import InputError
from foamfit.files import write_file
from foamfit.report.readable import readable_unit
from foamfit.terminal import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.results import Fit, ParameterEstimate
    from foamfit.solve.simulation import Response
    from foamfit.trust.profile import Profile

Array = NDArray[np.float64]

GREY, BLUE, VERMILION = "#6b6b6b", "#0072B2", "#D55E00"  # of Okabe and Ito, told apart by all
INSIDE = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # of masses inside, from the base up
STYLE: Any = {  # matplotlib types its keys one by one
    "font.family": "DejaVu Sans",
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
POINTS = {
    ("a", "d"): "A1", ("d", "a"): "A1",
    ("d", "c"): "C1",
    ("c", "e"): "C2", ("e", "c"): "C2",
    ("e", "a"): "A2",
}  # fmt: skip
BESIDE = {"a": (-6, 4), "d": (-6, 4), "c": (7, -3), "e": (4, -7)}  # points from the branch
MARKS = ((BLUE, "o"), (VERMILION, "s"), ("black", "^"), (GREY, "D"))  # of results in a comparison
MATH = {
    "k0": "$k_0$", "σ_a": r"$\sigma_a$", "ε_a": r"$\varepsilon_a$", "ε_c": r"$\varepsilon_c$",
    "k_h+": "$k_{h+}$", "k_h−": "$k_{h-}$", "k_c": "$k_c$", "Δσ": r"$\Delta\sigma$",
    "η": r"$\eta$",
}  # fmt: skip
IN_MATH = re.compile("|".join(map(re.escape, MATH)))
DPI = 250  # of a PNG
MARKERS = 60  # of a measured curve: more of them blot


def plot_fit(result: Fit, path: str | Path | None = None) -> Figure:
    """Draw stress-time, displacement-time and stress-strain, measured and fitted.

    Parameters
    ----------
    result : Fit
        The fit; a panel of which it has no curve is left out.
    path : str or Path, optional
        Where to save the figure; the suffix gives the format.

    Returns
    -------
    matplotlib.figure.Figure
        7 in wide where all three are there; it belongs to no pyplot state.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        panels = list(_panels(result))
        width = {0: 4.0, 1: 4.0, 2: 5.4, 3: 7.0}[len(panels)]
        figure = Figure(figsize=(width, 2.75), layout="constrained")
        for ax, panel in zip(_row(figure, len(panels)), panels, strict=True):
            _draw(ax, panel)
            _mark_outliers(ax, panel, result)
            _mark_switches(ax, panel, result)
            if panel.key == "stress_strain":
                _name_branches(ax, panel, result)
        _head(figure, result)
    return save(figure, path)


def plot_residuals(result: Fit, path: str | Path | None = None) -> Figure:
    """Draw fitted minus measured along each curve, in units of the measured range.

    Parameters
    ----------
    result : Fit
        The fit; a curve that has nothing to compare is left out.
    path : str or Path, optional
        Where to save the figure; the suffix gives the format.

    Returns
    -------
    matplotlib.figure.Figure
        7 in wide, one strip above the other, over time, or over the sample where there is no time.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        strips = list(_residuals(result))
        figure = Figure(figsize=(7.0, 0.45 + 0.85 * max(len(strips), 1)), layout="constrained")
        column = figure.subplots(max(len(strips), 1), 1, sharex=True, squeeze=False)[:, 0]
        time = result.curves.time
        for ax, (name, residual) in zip(column, strips, strict=False):
            factor, unit = readable_unit(_size(time), "s") if time is not None else (1.0, "")
            x = np.arange(residual.size) if time is None else time / factor
            ax.axhline(0.0, color=GREY, lw=0.6)
            ax.plot(x, 100.0 * residual, color=VERMILION, lw=0.9)
            ax.set_ylabel("% of range")
            ax.set_title(f"{name}: fitted − measured", loc="left", fontsize=7.5, pad=3)
            column[-1].set_xlabel(f"time ({unit})" if unit else "sample")
        if not strips:
            say_nothing_there(column[0])
    return save(figure, path)


def plot_profiles(result: Fit, path: str | Path | None = None) -> Figure:
    """Draw the profile of each parameter that was followed, with its 95 % cut and its interval.

    Parameters
    ----------
    result : Fit
        The fit; a profile that was stopped is drawn as far as it came.
    path : str or Path, optional
        Where to save the figure; the suffix gives the format.

    Returns
    -------
    matplotlib.figure.Figure
        7 in wide, four panels a row; dashed is the parabola of the local covariance.
    """
    import matplotlib
    from matplotlib.figure import Figure

    profiles = result.intervals.profiles if result.intervals is not None else ()
    rows = max(-(-len(profiles) // 4), 1)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 0.35 + 1.55 * rows), layout="constrained")
        axes = figure.subplots(rows, 4, squeeze=False, sharey=True).ravel()
        for ax, profile in zip(axes, profiles, strict=False):
            _draw_profile(ax, profile, result.parameters[profile.name])
        for ax in axes[max(len(profiles), 1) :]:
            ax.set_axis_off()
        if profiles:
            for ax in axes[: len(profiles) : 4]:
                ax.set_ylabel("rise of χ²")
        else:
            say_nothing_there(axes[0])
    return save(figure, path)


def _draw_profile(ax: Axes, profile: Profile, estimate: ParameterEstimate) -> None:
    """One profile, its cut, its interval, and the parabola of the standard error."""
    factor, unit = readable_unit(_size(profile.values), estimate.unit)
    top = 2.0 * profile.cut
    x = profile.values / factor
    ax.axhline(profile.cut, color=GREY, lw=0.6, ls=(0, (2, 2)))
    ax.axvspan(*(end / factor for end in profile.ci95), color="0.92", lw=0)
    fine = np.linspace(x.min(), x.max(), 200)
    if estimate.stderr:
        parabola = ((fine * factor - estimate.value) / estimate.stderr) ** 2
        ax.plot(fine, np.where(parabola <= top, parabola, np.nan), color=GREY, lw=0.8, ls="--")
    root = np.sign(profile.values - estimate.value) * np.sqrt(np.maximum(profile.rises, 0.0))
    ax.plot(fine, np.interp(fine, x, root) ** 2, color=BLUE, lw=1.1)
    ax.plot(x, profile.rises, "o", color=BLUE, ms=2.2)
    ax.plot(estimate.value / factor, 0.0, "o", color=VERMILION, ms=3.5)
    ax.set_ylim(-0.04 * top, top)
    ax.locator_params(axis="x", nbins=4)
    name = f"{profile.name} ({unit})" if unit else profile.name
    ax.set_xlabel(name if profile.complete else f"{name}, stopped", labelpad=1)


def plot_response(response: Response, path: str | Path | None = None) -> Figure:
    """Draw what a forward run gave: base stress and displacements over time, stress over strain.

    Parameters
    ----------
    response : Response
        From `foamfit.simulate`.
    path : str or Path, optional
        Where to save the figure; the suffix gives the format.

    Returns
    -------
    matplotlib.figure.Figure
        7 in wide, three panels; it belongs to no pyplot state.
    """
    import matplotlib
    from matplotlib.figure import Figure

    time, stress, nodes = response.time, response.base_stress, response.displacement
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 2.75), layout="constrained")
        axes = figure.subplots(1, 3)
        ft, t_unit = readable_unit(_size(time), "s")
        fs, s_unit = readable_unit(_size(stress), "Pa")
        fw, w_unit = readable_unit(_size(nodes), "m")
        axes[0].plot(time / ft, stress / fs, color=VERMILION, lw=1.3)
        # From the base up: light to dark, the top in the colour of what is simulated.
        shades = np.linspace(0.7, 0.35, max(len(nodes) - 1, 1))
        for i, node in enumerate(nodes[:-1]):
            axes[1].plot(time / ft, node / fw, color=str(shades[i]), lw=1.0, label=f"node {i + 1}")
        axes[1].plot(time / ft, nodes[-1] / fw, color=VERMILION, lw=1.3, label="top")
        end = np.inf if response.contact_end is None else response.contact_end
        loop = time <= end  # then the striker flies
        axes[2].plot(response.strain[loop], stress[loop] / fs, color=VERMILION, lw=1.3)
        for ax, x_label, y_label in (
            (axes[0], f"time ({t_unit})", f"base stress ({s_unit})"),
            (axes[1], f"time ({t_unit})", f"displacement ({w_unit})"),
            (axes[2], "overall strain (–)", f"base stress ({s_unit})"),
        ):
            ax.set_xlabel(x_label)
            ax.set_ylabel(y_label)
            ax.margins(0.05, 0.11)
        if response.contact_end is not None:
            for ax in axes[:2]:
                ax.axvline(response.contact_end / ft, color=GREY, lw=0.6, ls=(0, (2, 2)))
            axes[0].annotate(
                "end of contact", (response.contact_end / ft, 1.0), (-3, -3),
                xycoords=("data", "axes fraction"), textcoords="offset points",
                ha="right", va="top", rotation=90, color=GREY, fontsize=6.5,
            )  # fmt: skip
        if len(nodes) > 1:
            axes[1].legend(loc="best", handlelength=1.4)
    return save(figure, path)


@contextmanager
def laid_out(figure: Figure, dpi: int = DPI) -> Iterator[None]:
    """Keep one layout of a figure for all images that are made of it within.

    Left to itself matplotlib lays a figure out anew for every image, and draws it once more for
    that, unseen. Within another `laid_out` of the same figure this does nothing.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        What will be rendered; its engine is put back at the end.
    dpi : int
        Resolution at which its texts are measured.
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
    """Return the figure as the bytes of a file (PDF with embedded TrueType fonts).

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        What to render.
    form : {"png", "pdf", "svg"}
        The format.
    dpi : int
        Of a PNG.
    """
    import matplotlib

    buffer = io.BytesIO()
    # Without the date, the same fit gives the same file.
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(form)
    with laid_out(figure, dpi), matplotlib.rc_context(STYLE), _unnamed_letters():
        figure.savefig(buffer, format=form, dpi=dpi, metadata=metadata)
    return buffer.getvalue()


def origin_word(result: Fit) -> str | None:
    """Return "reconstruction" or "synthetic" where the test's name or notes say it is that."""
    text = " ".join((result.measurement.name, *result.measurement.notes)).lower()
    match = re.search(r"\b(reconstruct|synthetic)", text)
    return match and {"reconstruct": "reconstruction"}.get(match[1], match[1])


@dataclass(frozen=True)
class _Line:
    x: Array
    y: Array
    kind: Literal["measured", "fitted", "along"]
    node: int = 0  # the mass inside that it belongs to, 0 = the top
    source: str = "measured"  # where the motion of a measured line came from


@dataclass(frozen=True)
class _Panel:
    key: Literal["stress_time", "displacement_time", "stress_strain"]
    x_name: str
    x_unit: str
    y_name: str
    y_unit: str
    lines: list[_Line]

    def scale(self) -> tuple[float, str, float, str]:
        """Return factor and axis label of x, then of y."""
        x, x_unit = readable_unit(max(_size(line.x) for line in self.lines), self.x_unit)
        y, y_unit = readable_unit(max(_size(line.y) for line in self.lines), self.y_unit)
        return x, f"{self.x_name} ({x_unit})", y, f"{self.y_name} ({y_unit})"


def _panels(result: Fit) -> Iterator[_Panel]:
    c, height = result.curves, result.measurement.specimen.height
    # What a drive prescribes, the fitted loop has too, whether or not it is kept twice.
    pushed = c.measured_stress if result.drive == "stress" and c.stress is None else c.stress
    moved = c.displacement
    if result.drive == "displacement" and moved is None:
        moved = c.measured_displacement
    measured_strain = None if c.measured_displacement is None else c.measured_displacement / height
    strain = None if moved is None else moved / height
    stress = [("measured", c.time, c.measured_stress), ("fitted", c.time, c.stress)]
    motion = [("measured", c.time, c.measured_displacement), ("fitted", c.time, c.displacement)]
    loop = [
        ("measured", measured_strain, c.measured_stress),
        ("fitted", strain, pushed),
        ("along", measured_strain, c.stress_along),
    ]
    everything: list[tuple[Any, ...]] = [
        ("stress_time", "time", "s", "stress", "Pa", stress),
        ("displacement_time", "time", "s", "displacement", "m", motion),
        ("stress_strain", "strain", "–", "stress", "Pa", loop),
    ]
    for key, x_name, x_unit, y_name, y_unit, curves in everything:
        source = "measured" if key == "stress_time" else result.measurement.motion or "measured"
        lines = [
            _Line(x, y, kind, source=source)
            for kind, x, y in curves
            if x is not None and y is not None
        ]
        if key == "displacement_time" and c.time is not None:
            for node, (measured, fitted) in c.interior.items():
                lines.append(_Line(c.time, measured, "measured", node))
                lines.append(_Line(c.time, fitted, "fitted", node))
        if lines:
            yield _Panel(key, x_name, x_unit, y_name, y_unit, lines)


def _row(figure: Figure, n: int) -> list[Axes]:
    axes: list[Axes] = list(figure.subplots(1, max(n, 1), squeeze=False)[0])
    if n == 0:
        say_nothing_there(axes[0])
    return axes[:n]


def say_nothing_there(ax: Axes) -> None:
    """Write into an empty panel that there is no curve."""
    ax.set_axis_off()
    ax.text(0.5, 0.5, "no curve to compare", ha="center", va="center", transform=ax.transAxes)


def _draw(ax: Axes, panel: _Panel) -> None:
    fx, x_label, fy, y_label = panel.scale()
    for line in panel.lines:
        x, y = line.x / fx, line.y / fy
        color = INSIDE[(line.node - 1) % len(INSIDE)] if line.node else VERMILION
        if line.kind == "measured":
            some = _evenly(x, y, MARKERS)
            of_its_own = line.source == "measured"
            ax.plot(x, y, color=GREY, lw=0.5, alpha=0.6, zorder=1)
            ax.plot(
                x[some], y[some], "o" if of_its_own else "s", ms=2.6, mfc="white", mec=GREY,
                mew=0.6, zorder=2,
                label="_measured inside" if line.node
                else "measured" if of_its_own else f"measured, motion {line.source}",
            )  # fmt: skip
        elif line.kind == "fitted":
            name = f"mass {line.node}" if line.node else "fitted"
            ax.plot(x, y, color=color, lw=1.3, zorder=3, label=name)
        else:
            ax.plot(
                x, y, color=BLUE, lw=1.0, ls=(0, (4, 2)), zorder=4,
                label="springs along measured strain",
            )  # fmt: skip
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    ax.margins(0.05, 0.11)


def _evenly(x: Array, y: Array, n: int) -> NDArray[np.intp]:
    """Return up to `n` samples even along the curve; even in time they would crowd at its turns."""
    there = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if there.size <= n:
        return there
    dx, dy = (np.diff(v[there]) / (np.ptp(v[there]) or 1.0) for v in (x, y))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(dx, dy))))
    return there[np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], n)))]


def _mark_outliers(ax: Axes, panel: _Panel, result: Fit) -> None:
    """Cross what the file has at samples that are not fitted, at the edge if it is beyond."""
    test = result.measurement
    fx, _, fy, _ = panel.scale()
    own = "displacement" if panel.key == "displacement_time" else "stress"
    for channel, found in test.outliers.items():
        if not channel.startswith(own) or (panel.key != "stress_strain" and test.time is None):
            continue
        x = found.at
        if panel.key == "stress_strain":
            motion = test.displacement
            if motion is None:
                continue
            clock = np.arange(motion.size) if test.time is None else test.time
            x = np.interp(found.at, clock, motion) / test.specimen.height
        low, high = ax.get_ylim()  # fixed: a wild sample must not shrink the curves
        y = np.clip(found.values / fy, low, high)
        ax.plot(
            x / fx, y, "x", ms=4.0, mew=1.0, color="black", zorder=6, clip_on=False,
            label="outlier, not fitted",
        )  # fmt: skip
        ax.set_ylim(low, high)


def _mark_switches(ax: Axes, panel: _Panel, result: Fit) -> None:
    from matplotlib.patheffects import withStroke

    fx, _, fy, _ = panel.scale()
    inside = any(line.node for line in panel.lines)  # then the name of A1 may lie on its line
    halo = [withStroke(linewidth=1.5, foreground="white")]
    at: dict[str, list[tuple[float, float]]] = {}
    for switch in result.switches:
        point = POINTS.get((switch.source, switch.target), f"{switch.source}→{switch.target}")
        name = f"s{switch.spring} {point}" if len(result.chain.springs) > 1 else point
        x = switch.time
        if panel.key == "stress_strain":
            x = switch.displacement / result.measurement.specimen.height
        y = switch.displacement if panel.key == "displacement_time" else switch.stress
        if x is not None:
            at.setdefault(name, []).append((x / fx, y / fy))
    named: list[tuple[Array, float]] = []
    for name, places in at.items():
        ax.plot(*zip(*places, strict=True), "o", ms=3.2, color="black", zorder=5)
        offset = _offset(name[-2:], panel.key)
        here = np.array(places[0]) / [np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())]
        if panel.key != "stress_strain" and any(
            offset[0] * side > 0.0 and (np.abs(here - there) < (0.2, 0.05)).all()
            for there, side in named
        ):  # two springs switch at nearly one place: one name to each side
            offset = (-offset[0], -offset[1])
        named.append((here, offset[0]))
        ax.annotate(  # a spring that goes to and fro is named where it first does
            name, places[0], offset, textcoords="offset points", zorder=6,
            ha="left" if offset[0] > 0 else "right", va="center", fontsize=7,
            path_effects=halo if name.endswith("A1") and inside else None,
        )  # fmt: skip


def _offset(point: str, key: str) -> tuple[float, float]:
    """Return where the name of a point stands (in points): beside its curve, off the others."""
    if key == "stress_strain":
        return {"A1": (-4, 5), "C1": (-5, 3), "C2": (5, -3), "A2": (4, -7)}.get(point, (5, 5))
    return {"A1": (5, -4), "C1": (-5, 3), "C2": (5, 3), "A2": (5, 4)}.get(point, (5, 5))


def _name_branches(ax: Axes, panel: _Panel, result: Fit) -> None:
    """Write a, d, c, e beside the branches of the only spring."""
    fitted = next((line for line in panel.lines if line.kind == "fitted"), None)
    if len(result.chain.springs) > 1 or not result.bistable_springs or fitted is None:
        return
    fx, _, fy, _ = panel.scale()
    starts = [0, *_switch_samples(result, fitted), fitted.x.size - 1]
    branches = [*(switch.source for switch in result.switches[:1]), *_targets(result)]
    named: set[str] = set()
    for branch, start, end in zip(branches, starts, starts[1:], strict=False):
        if branch not in named and end > start:
            x, y = fitted.x[start : end + 1] / fx, fitted.y[start : end + 1] / fy
            middle = _evenly(x, y, 3)[1:2]
            ax.annotate(
                branch, (float(x[middle][0]), float(y[middle][0])), BESIDE.get(branch, (6, 6)),
                textcoords="offset points", ha="center", va="center", color=BLUE,
                style="italic", weight="bold", zorder=6,
            )  # fmt: skip
        named.add(branch)


def _targets(result: Fit) -> list[str]:
    return [switch.target for switch in result.switches] or ["a"]


def _switch_samples(result: Fit, loop: _Line) -> list[int]:
    """Return the sample of the fitted loop (strain, stress) at which each switch happens."""
    samples, time = [0], result.curves.time
    for switch in result.switches:
        if time is not None and switch.time is not None:
            samples.append(min(int(np.searchsorted(time, switch.time)), loop.x.size - 1))
        else:  # the nearest sample after the switch before
            strain = switch.displacement / result.measurement.specimen.height
            x, y = loop.x[samples[-1] :] - strain, loop.y[samples[-1] :] - switch.stress
            away = np.hypot(x / (np.ptp(loop.x) or 1.0), y / (np.ptp(loop.y) or 1.0))
            samples.append(samples[-1] + int(np.argmin(away)))
    return samples[1:]


def _head(figure: Figure, result: Fit) -> None:
    name = printable(" ".join(result.measurement.name.split()))
    name = name if len(name) <= 60 else name[:59] + "…"
    title = f"{name} · {result.model} · {result.drive} drive"
    word = origin_word(result)
    if word and word not in name.lower():
        title += f" · {word}"
    if result.stopped:
        title += f" · stopped by {result.stopped}"
    title = textwrap.fill(title, int(12 * figure.get_figwidth()))
    # A name may hold a dollar sign: it is no formula.
    figure.suptitle(title, x=0.012, ha="left", fontsize=8.5, weight="bold", parse_math=False)
    entries: dict[str, Any] = {}
    for ax in figure.axes:
        handles, labels = ax.get_legend_handles_labels()
        entries.update(zip(labels, handles, strict=True))
    if entries:
        figure.legend(
            list(entries.values()), list(entries), loc="outside lower center", ncols=len(entries)
        )


def _residuals(result: Fit) -> Iterator[tuple[str, Array]]:
    c = result.curves
    for key, name, fitted, measured in (
        ("stress_time", "stress-time", c.stress, c.measured_stress),
        ("displacement_time", "displacement-time", c.displacement, c.measured_displacement),
        ("stress_strain", "stress-strain", c.stress_along, c.measured_stress),
    ):
        compared = result.misfit.get(key) is not None  # else the drive prescribes this curve
        if compared and fitted is not None and measured is not None:
            yield name, (fitted - measured) / (float(np.ptp(measured)) or 1.0)
    for node, (measured, fitted) in c.interior.items():
        name = f"displacement-time of mass {node}"
        yield name, (fitted - measured) / (float(np.ptp(measured)) or 1.0)


def _size(values: Array) -> float:
    return float(np.nanmax(np.abs(values), initial=0.0))


def figure_format(path: str | Path) -> Literal["png", "pdf", "svg"]:
    """Return the format that the suffix of a path names; any other is refused."""
    forms: dict[str, Literal["png", "pdf", "svg"]] = {".png": "png", ".pdf": "pdf", ".svg": "svg"}
    form = forms.get(Path(path).suffix.lower())
    if form is None:
        raise InputError(f"a figure is saved as .png, .pdf or .svg, not {Path(path).name!r}")
    return form


def save(figure: Figure, path: str | Path | None) -> Figure:
    """Save a figure, if there is a path, in the format of its suffix; returns the figure."""
    if path is not None:
        write_file(path, image(figure, figure_format(path)))
    return figure
