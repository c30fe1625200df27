"""What a fit found, in words: the sentences that begin every report, and the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator

from foamfit.data.measurement import ASKED, interior_channel
from foamfit.report.readable import readable
from foamfit.report.render import sentences, words
from foamfit.results import STATED, Fit, Ladder, ParameterEstimate
from foamfit.springs.parameters import NUISANCE
from foamfit.text import counted, percent, wrapped

CURVES = {
    "stress_time": "stress-time",
    "displacement_time": "displacement-time",
    "stress_strain": "stress-strain",
}
ANSWERS = {True: "yes", False: "no", None: "–"}
LADDER = ["", "model", "with", "misfit %", "pred. %", "gain %", "rank", "AICc", "BIC"]
LADDER += ["p", "n.d.", "s"]
# Lines on the terminal for warnings, and for rows that are not used.
WARNING_LINES, ROW_LINES = 4, 2
LONGEST = 180  # characters of the reasons for a state; longer ones are left to the report


def summary_text(result: Fit, *, verbose: bool = False) -> str:
    """Return what the command prints after a fit: one screen, at most 100 columns wide.

    `verbose` adds what else is only in the report: the ladder, the reasons of each state, the
    checklist, the notes and all warnings.
    """
    rows = [readable(name, p) for name, p in result.parameters.items()]
    columns = {"parameter": "label", "value ± stderr": "with_error", "unit": "unit"}
    columns |= {"95 % interval": "interval"}
    columns |= {"range": "range"} if any(row.range for row in rows) else {}
    columns |= {"state": "state"}
    varied = [row for row in rows if row.state != "fixed"]
    return words(
        "summary",
        cycles=cycle_rows(result),
        result=result,
        m=result.measurement,
        ladder=result.ladder,
        ladder_rows=[] if result.ladder is None else [LADDER, *ladder_cells(result.ladder)],
        shown=[(name, percent(off)) for name, off in _compared(result).items()],
        rows=rows,
        table=[[*columns], *([getattr(row, one) for one in columns.values()] for row in varied)],
        fixed=[f"{row.name} {row.value} {row.unit}" for row in rows if row.state == "fixed"],
        conclusions=conclusions(result),
        answers=ANSWERS,
        verbose=verbose,
        short=[*_rows(result), *_short_warnings(result)],
    )


def misfits(result: Fit) -> dict[str, float | None]:
    """Return the misfits by the names of their curves, interior masses last."""
    names = CURVES | {
        f"{interior_channel(i)}_time": f"displacement-time of mass {i}"
        for i in result.curves.interior
    }
    return {name: result.misfit.get(key) for key, name in names.items()}


def _compared(result: Fit) -> dict[str, float]:
    return {name: off for name, off in misfits(result).items() if off is not None}


def conclusions(result: Fit) -> tuple[str, ...]:
    """Say in three sentences how well the model fits, what is known, and what is not.

    Further sentences say what the ± of the TOML add and, for microscale springs and relaxation,
    what the identified law does.
    """
    shown = _compared(result)
    timed = {name: off for name, off in shown.items() if name != CURVES["stress_strain"]} or shown
    springs = {name: p for name, p in result.parameters.items() if name not in NUISANCE}
    found = {name: p for name, p in springs.items() if p.state == "determined"}
    widths = {  # half of the 95 % interval over the value
        name: 0.5 * (p.ci95[1] - p.ci95[0]) / abs(p.value)
        for name, p in found.items()
        if p.ci95 is not None and p.value and math.isfinite(p.ci95[1] - p.ci95[0])
    }
    ends = dict.fromkeys(choose(widths, key=widths.__getitem__) for choose in (min, max) if widths)
    return sentences(
        "conclusions",
        result=result,
        followed=[(name, percent(off)) for name, off in timed.items()],
        determined=len(found),
        varied=sum(p.vary for p in springs.values()),
        widths=[(name, percent(widths[name])) for name in ends],
        unknown=_unknown(springs),
        weakest=[] if result.insight is None else list(result.insight.weakest()[1]),
        stated=STATED if result.budget is None else [*filter(result.budget.sources.count, STATED)],
        moved=_moved(result),
        accepted=result.status != "failed",
        several=len(result.chain.springs) > 1,
        lost=[name for name, p in springs.items() if p.state == "not determined"],
    )


def determined(result: Fit) -> str:
    """Say how many of the springs' parameters are determined, "" if none is varied."""
    varied = [p for name, p in result.parameters.items() if p.vary and name not in NUISANCE]
    found = sum(p.state == "determined" for p in varied)
    return f"{found} of {len(varied)} parameters determined" if varied else ""


def _unknown(parameters: dict[str, ParameterEstimate]) -> dict[str, dict[str, list[str]]]:
    """Group the parameters that are not determined, or weakly, by their state and its reason."""
    found = dict[str, dict[str, list[str]]]()
    for state in ("not determined", "weak"):
        groups = dict[str, list[str]]()
        for name, p in parameters.items():
            if p.state == state:
                groups.setdefault(p.why, []).append(name)
        told = "; ".join(f"{', '.join(names)} ({why})" for why, names in groups.items())
        if len(told) > LONGEST:
            every = [name for name, p in parameters.items() if p.state == state]
            groups = {"see why in the report": every}
        if groups:
            found[state] = groups
    return found


def _moved(result: Fit) -> tuple[str, float] | None:
    """Parameter that the unfitted ± of the TOML move farthest, and by which share of its scale."""
    if (budget := result.budget) is None or not budget.contributions:
        return None
    shares = {
        name: result.parameters[name].systematic / budget.scales[name]
        for name in budget.contributions
    }
    most = max(shares, key=shares.__getitem__)
    return (most, shares[most]) if shares[most] > 0.0 else None


def cycle_rows(result: Fit) -> list[list[str]]:
    """Table of several cycles that are one history, its head first; [] of one cycle."""
    if not (found := result.by_cycle):
        return []
    springs = next(iter(found.values()))["ever_snapped"]
    several = len(springs) > 1
    ever = ["ever snapped" + (f", {name}" if several else "") for name in springs]
    head = ["cycle", "misfit", "dissipated (kJ/m³)", "measured", *ever]
    rows = [
        [
            str(number),
            percent(one["misfit"]),
            f"{one['dissipated_fitted'] / 1e3:.4g}",
            f"{one['dissipated_measured'] / 1e3:.4g}",
            *(percent(share) for share in one["ever_snapped"].values()),
        ]
        for number, one in found.items()
    ]
    return [head, *rows]


def _rows(result: Fit) -> list[str]:
    """Say how many rows are used and, if there is room, why the others are not."""
    rows = result.measurement.rows
    reasons = ", ".join(f"{item.rows} ({item.why})" for item in rows.dropped)
    unused = f"; not used: {reasons}" if reasons else ""
    lines = wrapped(f"rows: {rows.rows} read, {rows.used} used{unused}")
    if len(lines) > ROW_LINES:
        lines = wrapped(f"rows: {rows.sentences()[0]} See the report for the others.")
    return lines


def _short_warnings(result: Fit) -> Iterator[str]:
    """Give all warnings about the input, and as many others as fit, except those on states."""
    said = [w for check in result.checklist if check.key == "determined" for w in check.warnings]
    warnings = [warning for warning in result.warnings if warning not in said]
    asked = [warning for warning in warnings if warning.startswith(ASKED)]
    for warning in asked:
        yield from wrapped(f"warning: {warning}")
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


def ladder_cells(ladder: Ladder) -> Iterator[list[str]]:
    """Give the models of a ladder as text, in the columns of `LADDER`.

    The misfits are those of the curves in time where there are any, else that of stress-strain;
    "pred." is the predicted misfit, "gain" by how much it is below that of the best model with no
    more parameters; "rank" is rank over parameters varied, "p" the smaller p-value of the two tests
    of the residuals, "n.d." parameters not determined over weak ones, by the 95 % intervals alone
    where a model was not chosen.
    """

    def whole(value: float | None) -> str:
        known = value is not None and math.isfinite(value)
        return f"{value:.0f}".replace("-", "−") if known else "–"

    for one in ladder.rungs:
        known = {key: off for key, off in one.misfit.items() if off is not None}
        timed = [off for key, off in known.items() if key != "stress_strain"]
        has = ["relaxation"] * bool(one.relaxation) + ["damping"] * (one.damping == "with")
        predicted, p = one.predicted_misfit, min(one.runs_p, one.neighbours_p)
        yield [
            "→" if one.chosen else "",
            one.model,
            "both" if len(has) == 2 else "".join(has) or "–",
            " ".join(percent(off).removesuffix(" %") for off in timed or known.values()),
            "–" if predicted is None else percent(predicted).removesuffix(" %"),
            whole(None if one.gain is None else 100.0 * one.gain),
            f"{one.rank}/{one.n_vary}",
            whole(one.aicc),
            whole(one.bic),
            "<1e−6" if p < 1e-6 else f"{p:.1g}".replace("-", "−"),
            f"{len(one.not_determined)}/{len(one.weak)}",
            f"{one.seconds:.1f}",
        ]
