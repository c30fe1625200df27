"""What a joint fit says in words: warnings and sentences, whose text stands in templates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from foamfit.fitting.links import RATES
from foamfit.report import render
from foamfit.study.joint_result import JointData
from foamfit.text import listed, percent
from foamfit.trust.checklist import POOR, UNACCEPTABLE

# Share of χ² from which on one test of many is named.
DOMINANT = 0.5
Joint = TypeVar("Joint", bound=JointData)


def with_words(result: Joint) -> Joint:
    """Give a joint fit its status, warnings and sentences."""
    lost, large = dict[str, None](), list[str]()
    for t, (test, problem) in enumerate(zip(result.tests, result.problems, strict=True)):
        for curve in problem.objective.counted:
            off, measured = result.fit.found.misfits[t][curve], problem.objective.measured[curve]
            if off is None or not off <= UNACCEPTABLE * np.std(measured) / np.ptp(measured):
                lost[test] = None
            elif off > POOR:
                large.append(f"{test} ({curve} {percent(off)})")
    share, top = max(zip(result.shares, result.tests, strict=True))
    known = [rate for rate in result.rates if rate is not None]
    shown = {
        "parameters": list(result.parameters.items()),
        "laws": RATES,
        "rates": f"{min(known):.3g} to {max(known):.3g} 1/s" if known else "",
        "slopes": [
            (name, result.parameters[name].kind, half) for name, half in result.open_slopes.items()
        ],
    }
    warnings = render.sentences(
        "joint_warnings",
        refused=[(Path(file).name, why.rstrip(".")) for file, why in result.refused.items()],
        lost=list(lost),
        large=large,
        top=(top, share) if len(result.tests) > 3 and share > DOMINANT else None,
        gap=result.bic - result.alone.bic,
        together=span_of(result.fit.found.misfits),
        alone=span_of(result.alone.misfits),
        evidence=_evidence(result),
        **shown,
    )
    kinds = dict[str, list[str]]()
    for name, one in result.parameters.items():
        kinds.setdefault(one.kind, []).append(name)
    sentences = render.sentences(
        "joint_sentences",
        tests=len(result.tests),
        n_vary=result.fit.found.n_vary,
        kinds=[f"{listed(names)} {kind}" for kind, names in kinds.items() if kind != "fixed"],
        scatter=[
            f"{name} {percent(one.scatter)} ({' to '.join(map(percent, one.scatter_ci95))})"
            for name, one in result.parameters.items()
            if one.scatter is not None and one.scatter_ci95 is not None
        ],
        **shown,
    )
    status = "failed" if lost else "warnings" if warnings else "ok"
    return replace(result, status=status, warnings=warnings, sentences=sentences)


def _evidence(result: JointData) -> list[tuple[str, str, str, float]]:
    """Of each parameter that was tried: the best kind, its own, and how much lower BIC is."""
    out = list[tuple[str, str, str, float]]()
    for name, tried in result.tried.items():
        mine, best = next(o for o in tried if o.chosen), min(tried, key=lambda one: one.bic)
        out.append((name, best.kind, mine.kind, mine.bic - best.bic))
    return out


def span_of(found: Sequence[dict[str, float | None]]) -> tuple[float, float] | None:
    """Smallest and largest misfit of some fits, of the loop or else of the stress; None if none."""
    names = ("stress_strain", "stress_time", "displacement_time")
    each = (next((one[n] for n in names if one.get(n) is not None), None) for one in found)
    known = [one for one in each if one is not None]
    return (min(known), max(known)) if known else None
