"""The cycles of one record: each fitted on its own, then together, to see what changes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import lmfit
import numpy as np

from foamfit.api import FitResult, fit
from foamfit.data.csv_file import read_test
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.search import what_stopped
from foamfit.one_model import Keywords, Options, Progress
from foamfit.report import render
from foamfit.report.figures import TWO, inches
from foamfit.report.studies.cycles import save_cycles
from foamfit.results import ParameterEstimate
from foamfit.study.cycle_fits import FittedCycles, span_of
from foamfit.study.shared import Group, Selection, select_own
from foamfit.text import listed, percent
from foamfit.trust.intervals import Announce

# Cycles that are fitted together at most; of more the first and others at equal ratios are taken.
MOST_TOGETHER = 6
# Factor by which a parameter goes up and down from cycle to cycle where its descriptions hop.
HOP = 1.5

Params = Callable[[Measurement], lmfit.Parameters | None]


class CycleFits(FittedCycles):
    """Fits of the cycles of one record, and how they are written; see `FittedCycles`."""

    def save(self, folder: str | Path, *, report: bool = True, figure_width: str = TWO) -> Path:
        """Write ``cycle-<n>/``, cycles.csv, cycles.png and cycles.json whole; returns the folder.

        cycles-plotted.csv holds what is plotted in cycles.png. An older result there is replaced as
        a whole, at the end. Without `report` there are tables alone. Figures are "one" or
        "two" columns wide, or as wide as a length ("85 mm").
        """
        inches(figure_width)  # refuses what is no width
        return save_cycles(self, folder, report=report, width=figure_width)


def fit_cycles(
    path: str | Path,
    specimen: str | Path | None = None,
    *,
    cycles: Sequence[int] | None = None,
    model: str = "bistable",
    together: bool = True,
    params: Params | None = None,
    progress: Progress | None = None,
    tell: Announce | None = None,
    **options: Unpack[Keywords],
) -> CycleFits:
    """Fit cycles of a record in turn, then together, and choose what changes by cycle.

    A later cycle starts at its own contact; its start strain is taken off (see `read_test`).
    Together, all parameters are shared at first; those that change from cycle to cycle are chosen
    by evidence, see `foamfit.study.shared.select_own`.

    Parameters
    ----------
    path, specimen
        The record and its TOML, as for `read_test`.
    cycles : sequence of int, optional
        Numbers of the cycles; all by default.
    model, tell, options
        As for `foamfit.fit`.
    together : bool
        Whether they are fitted together, too (at most `MOST_TOGETHER` of them).
    params : callable, optional
        Gives the parameters of each cycle's measurement, as `foamfit.make_params` does.
    progress : callable, optional
        Told the fraction done and what is going on.

    Returns
    -------
    CycleFits
        A cycle that cannot be read or fitted is in `refused` with its sentence.

    Raises
    ------
    InputError
        If the record or an option cannot be used at all.
    """
    chosen = Options.of("fit_cycles", options)
    report = progress or (lambda *_: None)
    first = read_test(path, specimen)
    wanted = first.cycles if cycles is None else tuple(dict.fromkeys(cycles))
    if not wanted:
        raise InputError("no cycle is named; name one or leave cycles out for all")
    results, refused = dict[int, FitResult](), dict[int, str]()
    share, stopped = 0.7 if together and len(wanted) > 1 else 1.0, None
    for i, number in enumerate(wanted):

        def told(done: float, what: str, i: int = i, number: int = number) -> None:
            report(share * (i + done) / len(wanted), f"cycle {number}: {what}")

        try:
            test = first if number == first.cycle else read_test(path, specimen, number)
            given = None if params is None else params(test)
            results[number] = fit(
                test, model=model, params=given, progress=told, tell=tell, **options
            )
            stopped = results[number].stopped
        except (InputError, SimulationError) as error:
            refused[number] = str(error)
        except KeyboardInterrupt as error:
            if not results:
                raise
            stopped = what_stopped(error)
        if stopped not in (None, "the time limit"):
            why = f"not fitted, because {stopped} ended the command before"
            refused |= {left: why for left in wanted[i:] if left not in results}
            break
    found = CycleFits(first.name, model, first.cycles, results, refused)
    if not together:
        return found
    return _fit_together(found, chosen, lambda done, what: report(share + 0.3 * done, what))


def _fit_together(found: CycleFits, options: Options, progress: Progress) -> CycleFits:
    """Add the fit of several cycles at once, where there can be one."""
    fitted = {n: one for n, one in sorted(found.results.items()) if one.status != "failed"}
    models = {one.model for one in fitted.values()}
    reasons = {
        "fewer than two cycles have a fit": len(fitted) < 2,
        f"they have different models ({', '.join(sorted(models))})": len(models) > 1,
        "a fit was stopped before its end": any(one.stopped for one in fitted.values()),
    }
    for why in (why for why, there in reasons.items() if there):
        return replace(found, sentences=(f"The cycles are not fitted together, because {why}.",))
    numbers = spread(list(fitted))
    problems = [
        options.problem(fitted[n].measurement, fitted[n].model, fitted[n].params.copy())
        for n in numbers
    ]
    vectors = [problem.vector() for problem in problems]
    for problem, values in zip(problems, vectors, strict=True):
        problem.objective.weigh_motion(values)
    try:
        selection = select_own([Group(tuple(problems), tuple(vectors))], progress=progress)
    except KeyboardInterrupt as error:  # the fits of the cycles are not given up for it
        told = f"The fit of the cycles together was ended by {what_stopped(error)}."
        return replace(found, sentences=(told,))
    together = replace(found, selection=selection, together=numbers)
    return replace(together, sentences=_sentences(together, selection))


def spread(numbers: list[int]) -> tuple[int, ...]:
    """At most `MOST_TOGETHER` of the cycles, at about equal ratios of their numbers."""
    if len(numbers) <= MOST_TOGETHER:
        return tuple(numbers)
    wanted = np.geomspace(numbers[0], numbers[-1], MOST_TOGETHER)
    there = np.array(numbers)
    nearest = [numbers[int(np.argmin(np.abs(there - at)))] for at in wanted]
    return tuple(dict.fromkeys(nearest))


def _sentences(found: CycleFits, selection: Selection) -> tuple[str, ...]:
    """What the fit of several cycles says.

    There is a trend where the single fits and the fit of all cycles agree on it. Descriptions hop
    where a parameter goes up and down again, or another way than in the fit of all cycles.
    """
    best, sure, hopping, unsure = selection.best, list[str](), list[str](), list[str]()
    for name in found.varied:
        each = [found.results[n].parameters[name] for n in found.together]
        side = _side(_span(each[0]), _span(each[-1]))
        steps = {_step(*pair) for pair in itertools.pairwise(each)}
        values = best.fits[0].value(name) if name in best.own else ()
        if steps >= {1, -1} or (values and side * (values[-1] - values[0]) < 0.0):
            hopping.append(name)
        elif values and side:
            alone = _change(each[0].value, each[-1].value)
            sure.append(f"{name} {_change(values[0], values[-1])} (each cycle alone: {alone})")
        elif values:
            unsure.append(name)
    return render.sentences(
        "cycles_sentences",
        cycles=listed(str(n) for n in found.together),
        first=found.together[0],
        last=found.together[-1],
        own=best.own,
        shared=len(best.fits[0].shared),
        best={"n_vary": best.n_vary, "ends": span_of(best.fits[0].misfits)},
        all_shared={
            "n_vary": selection.steps[0].n_vary,
            "ends": span_of(selection.steps[0].fits[0].misfits),
        },
        alone=span_of([found.results[n].misfit for n in found.together]),
        n_alone=selection.n_alone,
        n_eff=selection.n_eff,
        sure=sure,
        hopping=hopping,
        unsure=unsure,
        hop=HOP,
    )


def _span(one: ParameterEstimate) -> tuple[float, float]:
    """Where a parameter of one cycle may lie, by interval and range; anywhere if unknown."""
    ends = [one.value, *(one.ci95 or (-math.inf, math.inf)), *(one.range or ())]
    return min(ends), max(ends)


def _step(before: ParameterEstimate, after: ParameterEstimate) -> int:
    """1 or -1 where a parameter rises or falls by a factor of `HOP`, beyond noise; else 0."""
    side = _side(*(_span(replace(one, range=None)) for one in (before, after)))
    low, high = sorted([abs(before.value), abs(after.value)])
    return side if high > HOP * low else 0


def _side(before: tuple[float, float], after: tuple[float, float]) -> int:
    """1 if one span lies above the one before, -1 if below, 0 if they overlap."""
    return int(after[0] > before[1]) - int(after[1] < before[0])


def _change(before: float, after: float) -> str:
    """Say how a value changes, as "falls by 12 %" or "from 0 to 0.3"."""
    if abs(before) < 1e-3 * abs(after) or before == 0.0:
        return f"goes from {before:.3g} to {after:.3g}"
    ratio = after / before - 1.0
    return f"{'rises' if ratio > 0.0 else 'falls'} by {percent(abs(ratio))}"
