"""What a fit found, in words: the three sentences that begin every report, and the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from foamfit.data.measurement import interior_channel
from foamfit.report.readable import Readable, readable
from foamfit.results import Fit, Ladder, ParameterEstimate
from foamfit.text import aligned, counted, listed, percent, wrapped

CURVES = {
    "stress_time": "stress-time",
    "displacement_time": "displacement-time",
    "stress_strain": "stress-strain",
}
ANSWERS = {True: "yes", False: "no", None: "–"}
LADDER = (
    "", "model", "damping", "misfit %", "χ²", "rank", "n_eff", "AICc", "BIC", "runs p", "lag p",
    "n.d.", "s",
)  # fmt: skip
# Lines that the terminal has for the warnings and for the rows that are not used.
WARNING_LINES, ROW_LINES = 4, 2
LONGEST = 180  # characters of the reasons for a state; longer ones are left to the report


def summary_text(result: Fit, *, verbose: bool = False) -> str:
    """Return what the command prints after a fit: one screen, at most 100 columns wide.

    Parameters
    ----------
    result : Fit
        What to sum up.
    verbose : bool
        Whether to add what else is only in the report: the ladder, the reasons of each state, the
        checklist, the notes and all warnings.

    Returns
    -------
    str
        Status, misfits, parameters and what is known; no newline at the end.
    """
    m = result.measurement
    head = f"{m.name}: {result.model}, {result.drive} drive, seed {result.seed}: {result.status}"
    head += f" (stopped by {result.stopped}, not finished)" if result.stopped else ""
    shown = [f"{name} {percent(off)}" for name, off in misfits(result).items() if off is not None]
    rows = [readable(name, p) for name, p in result.parameters.items()]
    paragraphs = [head, "misfit (RMS over range): " + (", ".join(shown) or "no curve to compare")]
    if result.ladder is not None:
        one = result.ladder.chosen
        tried = counted(len(result.ladder.rungs), "model")
        paragraphs.append(f"chosen of {tried} tried: {one.name}: {one.why}")
    lines = _paragraphs(paragraphs)
    lines += ["", *_table(rows), "", *_paragraphs(conclusions(result)), ""]
    if verbose:
        return "\n".join([*lines, *_details(result, rows)])
    lines += _fitting(f"rows: {_rows(result)}", f"rows: {result.measurement.rows.sentences()[0]}")
    lines += _short_warnings(result)
    return "\n".join(lines).rstrip()


def conclusions(result: Fit) -> tuple[str, str, str]:
    """Say in three sentences how well the model fits, what is known, and what is not."""
    return _how_well(result), _known(result), _unknown(result)


def misfits(result: Fit) -> dict[str, float | None]:
    """Return the misfits by what their curves are called, masses inside last."""
    inside = {f"{interior_channel(i)}_time": f"mass {i}" for i in result.curves.interior}
    names = CURVES | {key: f"displacement-time of {name}" for key, name in inside.items()}
    return {name: result.misfit.get(key) for key, name in names.items()}


def _how_well(result: Fit) -> str:
    shown = {name: off for name, off in misfits(result).items() if off is not None}
    timed = {name: off for name, off in shown.items() if name != CURVES["stress_strain"]} or shown
    told = listed(f"{name} to {percent(off)}" for name, off in timed.items()) if timed else ""
    if not told:
        return "There is no measured curve to compare with."
    if result.status == "failed":
        return f"No acceptable fit: the model misses {told.replace(' to ', ' by ')} of the range."
    floor = next((check.answer for check in result.checklist if check.key == "floor"), None)
    rest = {True: ", which is the noise", False: ", which is more than the noise", None: ""}[floor]
    return f"The model follows {told} of the range{rest}."


def _of_state(result: Fit, state: str) -> list[str]:
    return [name for name, p in result.parameters.items() if p.state == state]


def _known(result: Fit) -> str:
    names, varied = _of_state(result, "determined"), [p.vary for p in result.parameters.values()]
    if not names:
        return f"None of the {counted(sum(varied), 'varied parameter')} is determined."
    told = f"{len(names)} of {counted(sum(varied), 'varied parameter')} "
    told += "is determined" if len(names) == 1 else "are determined"
    half = {name: _relative(result.parameters[name]) for name in names}
    known = {name: size for name, size in half.items() if math.isfinite(size)}
    ends = [choose(known, key=lambda name: known[name]) for choose in (min, max) if known]
    shown = [f"{name} ±{percent(known[name])}" for name in dict.fromkeys(ends)]
    return f"{told} (95 % intervals: {' to '.join(shown)})." if shown else f"{told}."


def _relative(p: ParameterEstimate) -> float:
    """Half of the 95 % interval over the value; NaN where there is none."""
    if p.ci95 is None or not p.value:
        return math.nan
    return 0.5 * (p.ci95[1] - p.ci95[0]) / abs(p.value)


def _unknown(result: Fit) -> str:
    parts = []
    for state in ("not determined", "weak"):
        reasons = dict[str, list[str]]()
        for name in _of_state(result, state):
            reasons.setdefault(result.parameters[name].why, []).append(name)
        groups = [f"{', '.join(names)} ({why})" for why, names in reasons.items()]
        if len("; ".join(groups)) > LONGEST:
            groups = [f"{', '.join(_of_state(result, state))} (see why in the report)"]
        if groups:
            parts.append(f"{state}: {'; '.join(groups)}")
    if parts:
        told = ". ".join(f"{part[0].upper()}{part[1:]}" for part in parts)
        return f"{told}."
    if result.insight is None or len(names := list(result.insight.weakest()[1])) < 2:
        return "No varied parameter is weak or not determined."
    return f"No varied parameter is weak; least determined is the combination of {listed(names)}."


def _rows(result: Fit) -> str:
    """Say how many rows are used and why not the others, in one sentence."""
    rows = result.measurement.rows
    told = f"{rows.rows} read, {rows.used} used"
    reasons = ", ".join(f"{item.rows} ({item.why})" for item in rows.dropped)
    return f"{told}; not used: {reasons}" if reasons else told


def _warnings(result: Fit) -> list[str]:
    """Return the warnings, and what the reader of the file asks to be looked at."""
    return [*result.warnings, *(n for n in result.measurement.notes if n.startswith("Check:"))]


def _short_warnings(result: Fit) -> Iterator[str]:
    """Give the warnings but those of the states, as many as fit, and how many more there are."""
    said = [w for check in result.checklist if check.key == "determined" for w in check.warnings]
    warnings = [warning for warning in _warnings(result) if warning not in said]
    room = WARNING_LINES
    for i, warning in enumerate(warnings):
        lines = wrapped(f"warning: {warning}")
        if i and len(lines) > room:
            yield f"and {counted(len(warnings) - i, 'more warning')}: see the report, or --verbose"
            return
        if len(lines) > WARNING_LINES:
            lines = [*lines[: WARNING_LINES - 1], "  … (see the report, or --verbose)"]
        yield from lines
        room -= len(lines)


def _fitting(text: str, short: str) -> list[str]:
    """Wrap a text, or a shorter one if it takes too many lines."""
    lines = wrapped(text)
    return lines if len(lines) <= ROW_LINES else wrapped(f"{short} See the report for the others.")


def _paragraphs(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in wrapped(text)]


def _table(rows: list[Readable]) -> list[str]:
    ranged = any(row.range for row in rows)  # where an error of the law leaves something open
    span = (lambda text: (text,)) if ranged else (lambda _: ())
    header = ("parameter", "value ± stderr", "unit", "95 % interval", *span("range"), "state")
    cells = [
        (r.name, r.with_error, r.unit, r.interval, *span(r.range), r.state)
        for r in rows
        if r.state != "fixed"
    ]
    fixed = ", ".join(f"{row.name} {row.value} {row.unit}" for row in rows if row.state == "fixed")
    return [*aligned([header, *cells]), *(wrapped(f"fixed: {fixed}") if fixed else [])]


def _details(result: Fit, rows: list[Readable]) -> Iterator[str]:
    """Give what only the report says else."""
    if result.ladder is not None:
        yield from (*_ladder_lines(result.ladder), "")
    reasons = [f"{row.state}: {row.name}, {row.why}" for row in rows if row.matters]
    yield from _paragraphs(reasons)
    yield ""
    for check in result.checklist:
        yield from wrapped(f"{ANSWERS[check.answer]:<5}{check.question} {check.sentence}", 7)
    yield ""
    if result.insight is not None:
        yield from (*wrapped(result.insight.sentence()), "")
    yield from _paragraphs(f"rows: {text}" for text in result.measurement.rows.sentences())
    yield from _paragraphs(f"note: {text}" for text in result.notes)
    yield from _paragraphs(f"warning: {text}" for text in _warnings(result))


def ladder_cells(ladder: Ladder) -> list[tuple[str, ...]]:
    """Return the rungs of a ladder as text, in the columns of `LADDER`.

    The misfits are those of the curves in time where there are any, else that of stress-strain;
    "rank" is rank over parameters varied, "n.d." parameters not determined over weak ones.
    """
    cells = list[tuple[str, ...]]()
    for rung in ladder.rungs:
        timed = [off for name, off in rung.misfit.items() if name != "stress_strain"]
        shown = [off for off in timed if off is not None]
        shown = shown or [off for off in rung.misfit.values() if off is not None]
        cells.append(
            (
                "→" if rung.chosen else "", rung.model, rung.damping,
                " ".join(percent(off).removesuffix(" %") for off in shown), f"{rung.chisqr:.4g}",
                f"{rung.rank}/{rung.n_vary}", _whole(rung.n_eff), _whole(rung.aicc),
                _whole(rung.bic), _p(rung.runs_p), _p(rung.neighbours_p),
                f"{len(rung.not_determined)}/{len(rung.weak)}", f"{rung.seconds:.1f}",
            )
        )  # fmt: skip
    return cells


def _whole(value: float) -> str:
    return f"{value:.0f}".replace("-", "−") if math.isfinite(value) else "–"


def _p(value: float) -> str:
    return "<1e−6" if value < 1e-6 else f"{value:.1g}".replace("-", "−")


def _ladder_lines(ladder: Ladder) -> list[str]:
    """Return the table of a ladder, why each rung was chosen or not, and what it all says."""
    lines = aligned([LADDER, *ladder_cells(ladder)], gap=" ")
    lines += _paragraphs(f"{rung.name}: {rung.why}" for rung in ladder.rungs)
    lines += _paragraphs(f"not tried: {reason}" for reason in ladder.skipped)
    said = [sentence for sentence in ladder.sentences if sentence not in ladder.cautions]
    return [*lines, *_paragraphs(said)]
