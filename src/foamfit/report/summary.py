"""Terminal output of a test and of a fit, and the HTML report of a fit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.data.energy import EnergyAudit, largest_motion, noise_sentences
from foamfit.data.measurement import UNITS, Measurement, Striker, interior_channel
from foamfit.data.zeros import CONTRADICTED
from foamfit.fitting.nuisance import POSITIVE
from foamfit.parts import covered
from foamfit.report import render
from foamfit.report.figures import images
from foamfit.report.plots import origin_word
from foamfit.report.render import Readable, count_determined, readable, words
from foamfit.results import Fit
from foamfit.springs.parameters import NUISANCE
from foamfit.text import aligned, counted, labelled, percent, warning, wrapped
from foamfit.trust.covariance import RULE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CURVES = {
    "stress_time": "stress-time",
    "displacement_time": "displacement-time",
    "stress_strain": "stress-strain",
}
# Effect of 1 % of a quantity in an impact and in a slow test (None: no effect), largest first.
EFFECTS = {
    "velocity": ("2 % of the striker's energy and 1 % of its momentum", None),
    "striker_mass": ("1 % of both", None),
    "area": ("1 % of every stress", "1 % of every stress and stiffness"),
    "height": ("1 % of every strain", "1 % of every strain, and so of the stiffnesses"),
}
ANSWERS = {True: "yes", False: "no", None: "–"}
LINES, COLUMNS = 22, 80  # screen of a fit; two more lines state where the result is
WARNING_LINES = 3  # kept for warnings
LONGEST = 180  # characters of the reasons for a state; longer ones appear only in the report


def describe(test: Measurement, audit: EnergyAudit) -> str:
    """Describe a test for the terminal."""
    channels, time = test.channels(), test.time
    told = any(one.quantity == "velocity" for one in audit.contradictions)
    peaks = dict[str, tuple[float, float | None]]()
    for name, values in channels.items():
        top, size = int(np.argmax(values)), float(values.max())
        if name != "stress":
            top, size = largest_motion(values, time)
        peaks[name] = size, None if time is None else float(time[top])
    lines = render.sentences(
        "described",
        test=test,
        audit=audit,
        spreads=defaultdict(float, test.uncertainties),
        count=max(map(len, channels.values())),
        step=None if time is None else float(np.median(np.diff(time))),
        peaks=peaks,
        units=UNITS,
        noises=noise_sentences(test),
        notes=[note for note in test.notes if not (told and CONTRADICTED in note)],
        remedies=[
            f"[{where}] {line}" for one in audit.contradictions for where, line in one.lines[:1]
        ],
        exact=taken_for_exact(test),
    )
    return labelled((label, text) for label, _, text in (line.partition("¦") for line in lines))


def taken_for_exact(test: Measurement) -> dict[str, str]:
    """Return the quantities without a ± in the TOML and the effect of 1 %, largest first."""
    striker, effects = test.striker or Striker(), dict[str, str]()
    impact = test.time is not None and striker.mass and striker.velocity
    for name, (of_impact, of_slow) in EFFECTS.items():
        effect = of_impact if impact else of_slow
        if name == "striker_mass" and test.braked:
            effect = EFFECTS["area"][0]
        if effect and name not in test.uncertainties:
            effects[name.replace("_", " ")] = effect
    return effects


def summary_text(result: Fit, *, verbose: bool = False) -> str:
    """Return the text that the command prints after a fit: one screen of 80 columns and 24 lines.

    If the table is too long, parameters that are not determined and those of the record are moved
    to a line below; if it is still too long, it becomes two columns of values. Warnings are cut.
    With `verbose` nothing is cut, and the ladder, the reason of each state, the checklist and the
    notes are added.
    """
    rows = [readable(name, p) for name, p in result.parameters.items()]
    values: dict[str, Any] = {
        "result": result,
        "shown": misfit_words(misfits(result)),
        "fixed": [row for row in rows if row.state == "fixed"],
        "determined": determined(result),
        "unknown": _unknown(result),
        "verbose": verbose,
        "remedies": [one.lines[0] for one in result.contradictions if one.lines],
    }
    *lines, last = _screen(result, rows, values)
    if verbose:
        values |= {"rows": rows, "answers": ANSWERS}
        lines.append("\n" + words("summary", **values, **tables(result)) + "\n")
    return "\n".join([*lines, last, *(line for _, line in values["remedies"])])


def _screen(result: Fit, rows: list[Readable], values: dict[str, Any]) -> Iterator[str]:
    """Yield the lines that fit on one screen, or all lines if they are to be `verbose`."""
    verbose = values["verbose"]
    head = words("short", part="head", **values).split("\n")
    head = [line for one in head for line in wrapped(one, 2, COLUMNS)[:2]]
    states = [w for check in result.checklist if check.key == "determined" for w in check.warnings]
    warnings = [one for one in result.warnings if one not in states]
    varied = [row for row in rows if row.state != "fixed"]
    estimated = [row for row in varied if row.state != "not determined"]
    springs = [row for row in estimated if row.name not in NUISANCE]
    lines, kept = 10**6 if verbose else LINES, min(len(warnings), WARNING_LINES)
    lines -= len(values["remedies"])
    stages = varied, varied, estimated, springs, list[Readable]()
    for stage, shown in enumerate(stages):
        left = [row for row in varied if row not in shown and row.name in NUISANCE]
        left.sort(key=lambda row: row.name not in POSITIVE)  # the calibration first
        more = {"whole": stage == 0, "stated": bool(shown), "of_record": [row.told for row in left]}
        foot = words("short", part="foot", **more, **values).split("\n")
        half, told = -(-len(springs) // 2), [row.told for row in springs]
        table = aligned([*zip_longest(told[:half], told[half:], fillvalue="")])
        if shown:
            table = aligned(_table(shown, short=not verbose))
        room = lines - len(head) - len(foot) - len(table) - 1
        if room >= kept:
            break
    yield from head
    yield from ("", *table) if table else ()
    for line in foot[:-1]:
        yield from wrapped(line) if verbose else [_cut(line)]
    yield from _fitting(warnings, max(room, min(kept, 1)))
    yield foot[-1]


def _table(rows: list[Readable], *, short: bool) -> list[list[str]]:
    """Return a table of parameters, head first; in a `short` one the range replaces the error."""
    ranged = any(row.range for row in rows)
    columns = {"parameter": "label", "value ± stderr": "with_error", "unit": "unit"}
    if short and ranged:
        columns = {"parameter": "label", "value": "value", "unit": "unit"}
    columns |= {"95 % interval": "interval"} | ({"range": "range"} if ranged else {})
    columns |= {"state": "state"}
    return [[*columns], *([getattr(row, one) for one in columns.values()] for row in rows)]


def _cut(line: str) -> str:
    return line if len(line) <= COLUMNS else f"{line[: COLUMNS - 2].rstrip()} …"


def _fitting(warnings: list[str], room: int) -> list[str]:
    """Return the warnings in `room` lines: the last ones are cut, then omitted."""
    paragraphs = [wrapped(warning(one), 2, COLUMNS) for one in warnings]
    for i in reversed(range(len(warnings))):
        if sum(map(len, paragraphs)) > room:
            paragraphs[i] = [_cut(warning(warnings[i]))]
    if len(warnings) > room:
        more = counted(len(warnings) - room + 1, "more warning")
        paragraphs[room - 1 :] = [[f"and {more}: see the report, or --verbose"]]
    return [line for lines in paragraphs for line in lines]


def misfits(result: Fit) -> dict[str, float | None]:
    """Return the misfits by the name of the curve, interior masses last."""
    names = CURVES | {
        f"{interior_channel(i)}_time": f"displacement-time of mass {i}"
        for i in result.curves.interior
    }
    return {name: result.misfit.get(key) for key, name in names.items()}


def misfit_words(misfits: Mapping[str, float | None]) -> str:
    """Return the misfits of curves by their names, in words; "" if none is compared."""
    known = (f"{name} {percent(one)}" for name, one in misfits.items() if one is not None)
    return ", ".join(known)


def determined(result: Fit) -> str:
    """Return how many parameters of the springs are determined, in words; "" if none is varied."""
    found, varied = count_determined(result.parameters)
    return f"{found} of {varied} determined" if varied else ""


def _unknown(result: Fit) -> dict[str, dict[str, list[str]]]:
    """Group the weak and undetermined parameters of the springs by state and reason."""
    grouped = dict[str, dict[str, list[str]]]()
    for state in ("not determined", "weak"):
        groups = dict[str, list[str]]()
        for name, p in result.parameters.items():
            if p.state == state and name not in NUISANCE:
                groups.setdefault(p.why, []).append(name)
        text = "; ".join(f"{', '.join(names)} ({why})" for why, names in groups.items())
        if len(text) > LONGEST:
            groups = {"reasons in the report": [one for names in groups.values() for one in names]}
        if groups:
            grouped[state] = groups
    return grouped


def tables(result: Fit) -> dict[str, list[list[str]]]:
    """Return the cells of the tables of cycles and of compared models; [] if there are none."""
    cycles, ladder = result.by_cycle, result.ladder
    return {
        "cycles": render.table("by_cycle", found=cycles) if cycles else [],
        "ladder_rows": render.table("ladder", ladder=ladder) if ladder else [],
    }


def render_report(result: Fit, drawn: Mapping[str, Figure], fit_svg: bytes | None = None) -> str:
    """Return the report as a self-contained HTML page; `drawn` are the figures of `figures_of`."""
    svg = {} if fit_svg is None else {"fit": fit_svg}
    svg |= {name: images(one, "svg")[0] for name, one in drawn.items() if name not in svg}
    plain, springs, insight = result.to_json_dict(), result.springs, result.insight
    parts, shares = ((), None) if insight is None else (insight.parts, insight.shares())
    return render.page(
        "report",
        result=result,
        origin=origin_word(result),
        determined=determined(result),
        misfits=misfits(result),
        statistics=plain["statistics"],
        springs=springs,
        seen={name: covered(result.visited.get(name, ())) for name in springs},
        parameters=[readable(name, p) for name, p in result.parameters.items()],
        rule=RULE,
        energy={k: x for k, x in plain["energy"].items() if type(x) in (int, float)},
        energy_sentences=plain["energy"].get("sentences") or [],
        answers=ANSWERS,
        parts=[] if shares is None else list(zip(parts, shares.T.tolist(), strict=True)),
        correlation=[] if result.correlation is None else result.correlation.matrix.tolist(),
        **tables(result),
        figures={name: (one.get_figwidth(), svg[name]) for name, one in drawn.items()},
    )
