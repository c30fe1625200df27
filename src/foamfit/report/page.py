"""What was fitted, to read: the HTML report of a result folder and the summary in the terminal."""

from __future__ import annotations

import base64
import math
import textwrap
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from foamfit.data.measurement import interior_channel
from foamfit.report.plots import (
    DPI,
    image,
    origin_word,
    plot_fit,
    plot_profiles,
    plot_residuals,
)
from foamfit.report.readable import Readable, number, readable, readable_unit
from foamfit.text import engineering

if TYPE_CHECKING:
    from foamfit.data.measurement import Measurement
    from foamfit.results import Fit, Ladder

CURVES = {
    "stress_time": "stress-time",
    "displacement_time": "displacement-time",
    "stress_strain": "stress-strain",
}
DRIVES = {
    "impact": "The motion follows from the mass and the velocity of the striker; nothing measured "
    "enters the simulation.",
    "stress": "The measured stress acts on the chain, which is in equilibrium at every sample.",
    "displacement": "The measured displacement of the top is prescribed.",
}
BRANCHES = {"a": "elastic", "d": "snap-buckling", "c": "densified", "e": "snap-back"}
POINTS = (  # attribute of the spring, symbol and its index, meaning, unit
    ("sigma_a", ("σ", "a"), "stress at A1, where snapping starts", "Pa"),
    ("sigma_c", ("σ̄", "c"), "stress at C2, where snap-back starts", "Pa"),
    ("eps_star", ("ε", "*"), "strain at which branch c starts from zero stress", ""),
    ("eps_hat_a", ("ε̂", "a"), "strain at A2, where branches e and a meet", ""),
    ("eps_hat_c", ("ε̂", "c"), "strain at C1, where branches d and c meet", ""),
    ("sigma_hat_c", ("σ̂", "c"), "stress at C1", "Pa"),
)
STATISTICS = {
    "n_data": "data points", "n_effective": "effective samples", "n_vary": "parameters varied",
    "chisqr": "χ²", "redchi": "reduced χ²", "aic": "AIC", "aicc": "AICc", "bic": "BIC",
    "n_failed": "trials that could not be simulated", "n_descents": "valleys searched",
    "n_agreeing": "descents that agree", "n_left_out": "outliers left out",
}  # fmt: skip
ENERGY = {  # of the audit: label and unit
    "striker_energy": ("striker's energy", "J/m³"),
    "absorbed_energy": ("absorbed energy", "J/m³"),
    "dissipated_energy": ("dissipated energy", "J/m³"),
    "dissipated_fraction": ("dissipated over absorbed", ""),
    "absorbed_over_striker": ("absorbed over striker's", ""),
    "rebound_velocity": ("rebound velocity", "m/s"),
    "impulse": ("impulse of the force", "N·s"),
    "momentum_change": ("change of momentum", "N·s"),
    "impulse_ratio": ("impulse over change of momentum", ""),
}
COARSE = 160  # dots per inch of what is only on the page, and should not take long
ANSWERS = {True: ("yes", "ok"), False: ("no", "weak"), None: ("–", "fixed")}
LADDER = (
    "model", "damping", "misfit %", "χ²", "vary", "rank", "n_eff", "AICc", "BIC", "runs p",
    "lag p", "n.d.", "weak", "s",
)  # fmt: skip
CITATION = (
    "Thevamaran, R., Fraternali, F., Daraio, C. (2014). Multiscale Mass-Spring Model for "
    "High-Rate Compression of Vertically Aligned Carbon Nanotube Foams. "
    "Journal of Applied Mechanics 81, 121006."
)


def render_report(result: Fit, *, fit_png: bytes | None = None) -> str:
    """Return the report as one HTML page that needs nothing else.

    Parameters
    ----------
    result : Fit
        What to report.
    fit_png : bytes, optional
        The figure of `plots.plot_fit` as PNG, if it is there already.

    Returns
    -------
    str
        HTML with its style and figures inside.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("foamfit.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    plain = result.to_json_dict()
    energy = plain["energy"]
    profiled = result.intervals is not None and result.intervals.profiles
    return environment.get_template("report.html").render(
        result=result,
        version=version("foamfit"),
        origin=origin_word(result),
        misfits={name: result.misfit.get(key) for key, name in _curves(result).items()},
        statistics={
            STATISTICS.get(name, name.replace("_", " ")): value
            for name, value in plain["statistics"].items()
            if name not in ("nfev", "n_starts")  # the page says these where it says how
        },
        visited=_visited(result),
        parameters=[readable(name, p) for name, p in result.parameters.items()],
        points={name: _points(spring) for name, spring in result.bistable_springs.items()},
        energy_sentences=energy.pop("sentences", None) or [],
        energy=dict(_energies(energy)),
        drive_meaning=DRIVES.get(result.drive, ""),
        branches=BRANCHES,
        ladder=result.ladder,
        ladder_header=LADDER,
        ladder_rows=[] if result.ladder is None else ladder_cells(result.ladder),
        fit_figure=_figure(fit_png or image(plot_fit(result), "png")),
        answers=ANSWERS,
        insight_figures=_insight_figures(result),
        residual_figure=_figure(image(plot_residuals(result), "png")),
        profile_figure=_figure(image(plot_profiles(result), "png")) if profiled else None,
        citation=CITATION,
    )


def summary_text(result: Fit) -> str:
    """Return what the command prints after a fit: plain text, at most 100 columns wide.

    Parameters
    ----------
    result : Fit
        What to sum up.

    Returns
    -------
    str
        Status, misfits, parameters and warnings; no newline at the end.
    """
    m = result.measurement
    head = f"{m.name}: {result.model}, {result.drive} drive, seed {result.seed}: {result.status}"
    head += f" (stopped by {result.stopped}, not finished)" if result.stopped else ""
    misfits = [
        f"{name} {100 * misfit:.2g} %"
        for key, name in _curves(result).items()
        if (misfit := result.misfit.get(key)) is not None
    ]
    rows = [readable(name, p) for name, p in result.parameters.items()]
    fixed = [f"{row.name} {row.value} {row.unit}" for row in rows if row.state == "fixed"]
    lines = _wrap("", head)
    lines += _wrap("", "misfit (RMS over range): " + (", ".join(misfits) or "no curve to compare"))
    lines += [] if result.ladder is None else ["", *_ladder_lines(result.ladder)]
    lines += ["", *_aligned([row for row in rows if row.state != "fixed"])]
    lines += _wrap("", "fixed: " + ", ".join(fixed)) if fixed else []
    lines += _reasons(rows)
    lines += list(_checks(result))
    lines += ["", *_data_lines(m)]
    for note in result.notes:
        lines += _wrap("note: ", note)
    for warning in result.warnings:
        lines += _wrap("warning: ", warning)
    return "\n".join(lines)


def _data_lines(measurement: Measurement) -> list[str]:
    """Say how many rows of the file are used, why not the others, and what was noticed of them."""
    lines = []
    for sentence in measurement.rows.sentences():
        lines += _wrap("rows: ", sentence)
    for note in measurement.notes:
        lines += _wrap("data: ", note) if note.startswith("Check:") else []
    return lines


def _reasons(rows: list[Readable]) -> list[str]:
    """Say why a parameter is not determined or weak, and what is to be known of its interval."""
    lines = []
    for row in rows:
        doubtful = row.state not in ("determined", "fixed")
        if doubtful or (row.state == "determined" and ";" in row.why):
            lines += _wrap("", f"{row.state}: {row.name}, {row.why}")
    return lines


def _checks(result: Fit) -> Iterator[str]:
    """Give the checklist, and what the test tells least."""
    if result.checklist:
        yield ""
    for check in result.checklist:
        text = f"{check.question} {check.sentence}"
        yield from textwrap.wrap(
            f"{ANSWERS[check.answer][0]:<5}{text}", 100, subsequent_indent=" " * 7
        )
    sentence = "" if result.insight is None else result.insight.sentence()
    if sentence:
        yield ""
        yield from _wrap("", sentence)


def _insight_figures(result: Fit) -> list[tuple[str, float]]:
    """Give the figures of what the test can tell; none where it tells nothing."""
    if result.insight is None:
        return []
    from foamfit.report.identifiability_plots import plot_information, plot_sensitivities

    matrix = None if result.correlation is None else result.correlation.matrix
    figures = (plot_information(result.insight, matrix), plot_sensitivities(result.insight))
    return [_figure(image(figure, "png", COARSE), COARSE) for figure in figures]


def _curves(result: Fit) -> dict[str, str]:
    """Return the keys of the misfits and what they are called, masses inside last."""
    inside = {f"{interior_channel(i)}_time": f"mass {i}" for i in result.curves.interior}
    return CURVES | {key: f"displacement-time of {name}" for key, name in inside.items()}


def _points(spring: Any) -> list[tuple[tuple[str, str], str, str, str]]:
    rows = []
    for attribute, symbol, meaning, si in POINTS:
        value = getattr(spring, attribute)
        factor, unit = readable_unit(value or 0.0, si)
        shown = "does not exist" if value is None else number(value / factor)
        rows.append((symbol, meaning, shown, unit or "–"))
    return rows


def _energies(energy: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Give label and value of the numbers of an audit; its texts are in its sentences."""
    for name, value in energy.items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            label, unit = ENERGY.get(name, (name.replace("_", " "), ""))
            yield label, engineering(value, unit) if unit else number(value)


def _visited(result: Fit) -> dict[str, tuple[str, ...] | None]:
    """Return the branches that each spring went through, None for a spring that has none."""
    bistable = result.bistable_springs
    names = [f"s{i}" for i in range(1, len(result.chain.springs) + 1)]
    return {name: result.visited.get(name, ()) if name in bistable else None for name in names}


def ladder_cells(ladder: Ladder) -> list[tuple[str, ...]]:
    """Return the rungs of a ladder as text, in the columns of `LADDER`.

    The misfits are those of the curves in time where there are any, else that of stress-strain.
    """
    cells = []
    for rung in ladder.rungs:
        timed = [name for name in rung.misfit if name != "stress_strain"]
        shown = [off for name in timed if (off := rung.misfit[name]) is not None]
        shown = shown or [off for off in rung.misfit.values() if off is not None]
        misfits = " ".join(f"{100 * off:.2g}" for off in shown)
        measures = [_tenth(value) for value in (rung.n_eff, rung.aicc, rung.bic)]
        cells.append(
            (
                rung.model, rung.damping, misfits, f"{rung.chisqr:.4g}", str(rung.n_vary),
                str(rung.rank), *measures, _p(rung.runs_p), _p(rung.neighbours_p),
                str(len(rung.not_determined)), str(len(rung.weak)), f"{rung.seconds:.1f}",
            )
        )  # fmt: skip
    return cells


def _whole(value: float) -> str:
    return f"{value:.0f}".replace("-", "−") if math.isfinite(value) else "–"


def _p(value: float) -> str:
    return "<1e−6" if value < 1e-6 else f"{value:.1g}".replace("-", "−")


def _tenth(value: float) -> str:
    return f"{value:.1f}".replace("-", "−") if math.isfinite(value) else "–"


def _ladder_lines(ladder: Ladder) -> list[str]:
    """Return the table of a ladder, why each rung was chosen or not, and what it all says.

    To fit the width, rank and parameters varied share a column (7/9), and so do parameters not
    determined and weak (0/2); numbers have fewer digits than in the page.
    """
    header = (
        "", "model", "damping", "misfit%", "χ²", "rank", "n_eff", "AICc", "BIC", "runs p", "lag p",
        "n.d.", "s",
    )  # fmt: skip
    rows = []
    for rung, cells in zip(ladder.rungs, ladder_cells(ladder), strict=True):
        whole = [_whole(value) for value in (rung.n_eff, rung.aicc, rung.bic)]
        rows.append(
            (
                "→" if rung.chosen else "", *cells[:3], f"{rung.chisqr:.3g}",
                f"{cells[5]}/{cells[4]}", *whole, cells[9], cells[10],
                f"{cells[11]}/{cells[12]}", cells[13],
            )
        )  # fmt: skip
    lines = _columns([header, *rows], gap=" ")
    for rung in ladder.rungs:
        lines += _wrap("", f"{rung.name}: {rung.why}")
    for reason in ladder.skipped:
        lines += _wrap("not tried: ", reason)
    said = [sentence for sentence in ladder.sentences if sentence not in ladder.cautions]
    return [*lines, "", *(line for sentence in said for line in _wrap("", sentence))]


def _aligned(rows: list[Readable]) -> list[str]:
    header = ("parameter", "value ± stderr", "unit", "95 % interval", "state")
    return _columns([header] + [(r.name, r.with_error, r.unit, r.interval, r.state) for r in rows])


def _columns(table: Sequence[tuple[str, ...]], gap: str = "  ") -> list[str]:
    header = table[0]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    return [
        gap.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]


def _wrap(start: str, text: str) -> list[str]:
    return textwrap.wrap(start + text, 100, subsequent_indent="  ")


def _figure(png: bytes, dpi: int = DPI) -> tuple[str, float]:
    """Return a PNG in base64, and its width in inches (the width in pixels is in its header)."""
    return base64.b64encode(png).decode("ascii"), int.from_bytes(png[16:20]) / dpi
