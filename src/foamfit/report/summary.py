"""What a fit found, in words: the three sentences that begin every report, and the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from foamfit.data.measurement import ASKED, interior_channel
from foamfit.report.readable import Readable, readable
from foamfit.results import STATED, Fit, Ladder, ParameterEstimate, Rung
from foamfit.springs.parameters import NUISANCE
from foamfit.text import aligned, counted, engineering, listed, number, percent, wrapped

CURVES = {
    "stress_time": "stress-time",
    "displacement_time": "displacement-time",
    "stress_strain": "stress-strain",
}
ANSWERS = {True: "yes", False: "no", None: "–"}
LADDER = (
    "", "model", "with", "misfit %", "pred. %", "gain %", "rank", "AICc", "BIC", "p", "n.d.", "s",
)  # fmt: skip
# Lines that the terminal has for the warnings and for the rows that are not used.
WARNING_LINES, ROW_LINES = 4, 2
LONGEST = 180  # characters of the reasons for a state; longer ones are left to the report


def summary_text(result: Fit, *, verbose: bool = False) -> str:
    """Return what the command prints after a fit: one screen, at most 100 columns wide.

    `verbose` adds what else is only in the report: the ladder, the reasons of each state, the
    checklist, the notes and all warnings.
    """
    m = result.measurement
    head = f"{m.name}: {result.law}, {result.drive} drive, seed {result.seed}: {result.status}"
    head += f" (stopped by {result.stopped}, not finished)" if result.stopped else ""
    shown = [f"{name} {percent(off)}" for name, off in misfits(result).items() if off is not None]
    rows = [readable(name, p) for name, p in result.parameters.items()]
    paragraphs = [head, "misfit (RMS over range): " + (", ".join(shown) or "no curve to compare")]
    if result.ladder is not None:
        one = result.ladder.chosen
        tried = counted(len(result.ladder.rungs), "model")
        paragraphs.append(f"chosen of {tried} tried: {one.name}: {one.why}")
    if len(m.cycles) > 1:
        gone = f", start strain {percent(m.start_strain)}" if m.cycle != m.cycles[0] else ""
        paragraphs.append(
            f"cycle {m.cycle} of {len(m.cycles)} in the record{gone}: {m.rows.used} of "
            f"{m.rows.rows} rows used, the others cut (--cycle all fits each)"
        )
    lines = _paragraphs(paragraphs)
    lines += ["", *_table(rows), "", *_paragraphs(conclusions(result)), ""]
    if verbose:
        return "\n".join([*lines, *_details(result, rows)])
    lines += _rows(result) + list(_short_warnings(result))
    return "\n".join(lines).rstrip()


def conclusions(result: Fit) -> tuple[str, ...]:
    """Say in three sentences how well the model fits, what is known, and what is not.

    Also what the ± of the TOML add, and of microscale springs and of relaxation what the identified
    law does.
    """
    law = (*_snapping(result), *_relaxation(result)) if result.status != "failed" else ()
    return (_how_well(result), _known(result), _unknown(result), *_systematic(result), *law)


def misfits(result: Fit) -> dict[str, float | None]:
    """Return the misfits by what their curves are called, masses inside last."""
    names = CURVES | {
        f"{interior_channel(i)}_time": f"displacement-time of mass {i}"
        for i in result.curves.interior
    }
    return {name: result.misfit.get(key) for key, name in names.items()}


def _how_well(result: Fit) -> str:
    shown = {name: off for name, off in misfits(result).items() if off is not None}
    timed = {name: off for name, off in shown.items() if name != CURVES["stress_strain"]} or shown
    told = listed(f"{name} to {percent(off)}" for name, off in timed.items()) if timed else ""
    if not told:
        return "There is no measured curve to compare with."
    if result.status == "failed":
        return f"No acceptable fit: the model misses {told.replace(' to ', ' by ')} of the range."
    rest = {True: ", at the estimated noise", False: "; systematic residuals remain", None: ""}
    return f"The model follows {told} of the range{rest[result.at_noise]}."


def _of_state(result: Fit, state: str) -> dict[str, ParameterEstimate]:
    return {name: p for name, p in _of_springs(result).items() if p.state == state}


def _of_springs(result: Fit) -> dict[str, ParameterEstimate]:
    return {name: p for name, p in result.parameters.items() if name not in NUISANCE}


def _known(result: Fit) -> str:
    found = _of_state(result, "determined")
    varied = counted(sum(p.vary for p in _of_springs(result).values()), "varied parameter")
    if not found:
        return f"None of the {varied} is determined."
    told = f"{len(found)} of {varied} {'is' if len(found) == 1 else 'are'} determined"
    half = {  # of the 95 % interval over the value
        name: 0.5 * (p.ci95[1] - p.ci95[0]) / abs(p.value)
        for name, p in found.items()
        if p.ci95 is not None and p.value and math.isfinite(p.ci95[1] - p.ci95[0])
    }
    ends = dict.fromkeys(choose(half, key=half.__getitem__) for choose in (min, max) if half)
    shown = " to ".join(f"{name} ±{percent(half[name])}" for name in ends)
    return f"{told} (95 % intervals: {shown})." if shown else f"{told}."


def _unknown(result: Fit) -> str:
    parts = []
    for state in ("not determined", "weak"):
        reasons = dict[str, list[str]]()
        for name, p in _of_state(result, state).items():
            reasons.setdefault(p.why, []).append(name)
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


def _systematic(result: Fit) -> Iterator[str]:
    """Say how far the ± of the TOML that are not fitted move the springs' parameters."""
    if (budget := result.budget) is None:
        return
    shares = {
        name: result.parameters[name].systematic / budget.scales[name]
        for name in budget.contributions
    }
    if shares and (largest := max(shares.values())) > 0.0:
        which = max(shares, key=shares.__getitem__)
        stated = [one for one in budget.sources if one in STATED]
        yield (
            f"The ± of {listed(stated)} in the TOML moves {which} by {percent(largest)}, others by "
            "less; this is in no interval."
        )


def _of_spring(result: Fit, name: str) -> str:
    """Return " of spring 2" of s2, nothing where there is one spring only."""
    return f" of spring {name[1:]}" if len(result.chain.springs) > 1 else ""


def _snapping(result: Fit) -> Iterator[str]:
    """Say how many micro-springs the test snapped: it tells nothing of the others."""
    for name, snapped in result.snapping.items():
        at = f"{engineering(float(snapped.stress[snapped.turn]), 'Pa')}"
        if result.strain is not None:
            at += f" and a strain of {number(float(result.strain[snapped.turn]))}"
        sentence = (
            f"{percent(snapped.most)} of the micro-springs{_of_spring(result, name)} snap in this "
            f"test, at {at}"
        )
        if 1.0 - snapped.most > 0.005:
            sentence += "; what the others would do is extrapolated"
        yield f"{sentence}."


def _relaxation(result: Fit) -> Iterator[str]:
    """Say what the relaxation of each spring that has any amounts to."""
    for i, spring in enumerate(result.chain.springs, start=1):
        terms = [
            (f"s{i}_g{k}", g, f"s{i}_tau{k}", tau)
            for k, (g, tau) in enumerate(spring.relaxation, start=1)
        ]
        if not terms:
            continue
        lost = [
            name
            for g, _, tau, _ in terms
            for name in (g, tau)
            if name in result.parameters and result.parameters[name].state == "not determined"
        ]
        whose = _of_spring(result, f"s{i}")
        if lost:
            yield f"The relaxation{whose} is not determined ({', '.join(lost)})."
            continue
        total = 1.0 + sum(g for _, g, _, _ in terms)
        parts = (f"{percent(g / total)} of it with a time constant of {engineering(tau, 's')}"
                 for _, g, _, tau in terms)  # fmt: skip
        yield (
            f"On a sudden change of strain the stress{whose} changes {number(total)} times as much "
            f"as in equilibrium, and relaxes: {listed(parts)}."
        )


def _rows(result: Fit) -> list[str]:
    """Say how many rows are used and, where it is short, why not the others."""
    rows = result.measurement.rows
    told = f"rows: {rows.rows} read, {rows.used} used"
    reasons = ", ".join(f"{item.rows} ({item.why})" for item in rows.dropped)
    lines = wrapped(f"{told}; not used: {reasons}" if reasons else told)
    if len(lines) > ROW_LINES:
        lines = wrapped(f"rows: {rows.sentences()[0]} See the report for the others.")
    return lines


def _short_warnings(result: Fit) -> Iterator[str]:
    """Give all on the input; of the others, but those of the states, as many as fit."""
    said = [w for check in result.checklist if check.key == "determined" for w in check.warnings]
    warnings = [warning for warning in result.warnings if warning not in said]
    asked = [warning for warning in warnings if warning.startswith(ASKED)]
    yield from _paragraphs(f"warning: {warning}" for warning in asked)
    warnings, given = warnings[len(asked) :], 0
    for i, warning in enumerate(warnings):
        lines = wrapped(f"warning: {warning}")
        if i and given + len(lines) > WARNING_LINES:
            yield f"and {counted(len(warnings) - i, 'more warning')}: see the report, or --verbose"
            return
        if len(lines) > WARNING_LINES:
            lines = [*lines[: WARNING_LINES - 1], "  … (see the report, or --verbose)"]
        yield from lines
        given += len(lines)


def _paragraphs(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in wrapped(text)]


def _table(rows: list[Readable]) -> list[str]:
    ranged = any(row.range for row in rows)  # where an error of the law leaves something open
    span = (lambda text: (text,)) if ranged else (lambda _: ())
    header = ("parameter", "value ± stderr", "unit", "95 % interval", *span("range"), "state")
    cells = [
        (r.label, r.with_error, r.unit, r.interval, *span(r.range), r.state)
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
    yield from _paragraphs(f"warning: {text}" for text in result.warnings)


def ladder_cells(ladder: Ladder) -> list[tuple[str, ...]]:
    """Return the models of a ladder as text, in the columns of `LADDER`.

    The misfits are those of the curves in time where there are any, else that of stress-strain;
    "pred." is the predicted misfit, "gain" by how much it is below that of the best model with no
    more parameters; "rank" is rank over parameters varied, "p" the smaller p-value of the two tests
    of the residuals, "n.d." parameters not determined over weak ones, by
    the 95 % intervals alone where a model was not chosen.
    """
    cells = list[tuple[str, ...]]()
    for one in ladder.rungs:
        timed = {key: off for key, off in one.misfit.items() if key != "stress_strain"}
        shown = [off for off in timed.values() if off is not None]
        shown = shown or [off for off in one.misfit.values() if off is not None]
        cells.append(
            (
                "→" if one.chosen else "", one.model, _with(one),
                " ".join(percent(off).removesuffix(" %") for off in shown),
                _percents(one.predicted_misfit),
                "–" if one.gain is None else _whole(100.0 * one.gain),
                f"{one.rank}/{one.n_vary}", _whole(one.aicc), _whole(one.bic),
                _p(min(one.runs_p, one.neighbours_p)),
                f"{len(one.not_determined)}/{len(one.weak)}", f"{one.seconds:.1f}",
            )
        )  # fmt: skip
    return cells


def _with(one: Rung) -> str:
    """Return what a model has besides its springs."""
    has = (["relaxation"] if one.relaxation else []) + ["damping"] * (one.damping == "with")
    return "both" if len(has) == 2 else has[0] if has else "–"


def _percents(value: float | None) -> str:
    return "–" if value is None else percent(value).removesuffix(" %")


def _whole(value: float) -> str:
    return f"{value:.0f}".replace("-", "−") if math.isfinite(value) else "–"


def _p(value: float) -> str:
    return "<1e−6" if value < 1e-6 else f"{value:.1g}".replace("-", "−")


def _ladder_lines(ladder: Ladder) -> list[str]:
    """Return the table of a ladder, why each model was chosen or not, and what it all says."""
    lines = aligned([LADDER, *ladder_cells(ladder)], gap=" ")
    lines += _paragraphs(f"{one.name}: {one.why}" for one in ladder.rungs)
    lines += _paragraphs(f"not tried: {reason}" for reason in ladder.skipped)
    said = [sentence for sentence in ladder.sentences if sentence not in ladder.cautions]
    return [*lines, *_paragraphs(said)]
