"""What a joint fit says in words: warnings and sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from foamfit.fitting.links import RATES
from foamfit.study.cycle_fits import loop_misfits
from foamfit.study.joint_result import JointData
from foamfit.text import counted, listed, percent
from foamfit.trust.checklist import POOR, UNACCEPTABLE

# Share of χ² from which on one test of many is named.
DOMINANT = 0.5


def warnings_of(result: JointData) -> tuple[bool, list[str]]:
    """Whether some test is not followed acceptably, and what a reader must know."""
    out, lost, large = list[str](), list[str](), list[str]()
    for file, why in result.refused.items():
        out.append(f"{Path(file).name} is left out: {why.rstrip('.')}.")
    for t, (test, problem) in enumerate(zip(result.tests, result.problems, strict=True)):
        for curve in problem.objective.counted:
            off, measured = result.fit.found.misfits[t][curve], problem.objective.measured[curve]
            most = UNACCEPTABLE * float(np.std(measured) / np.ptp(measured))
            if off is None or not off <= most:
                lost.append(test)
            elif off > POOR:
                large.append(f"{test} ({curve} {percent(off)})")
    if lost:
        out.append(f"The misfit of {listed(dict.fromkeys(lost))} is not acceptable.")
    if large:
        more = f" and {len(large) - 3} more" if len(large) > 3 else ""
        out.append(f"The misfit is large in {', '.join(large[:3])}{more}.")
    top = int(np.argmax(result.shares))
    if len(result.tests) > 3 and result.shares[top] > DOMINANT:
        out.append(
            f"{result.tests[top]} holds {percent(result.shares[top])} of χ²: the law, or the noise "
            "that it states, does not fit it as the others."
        )
    if result.bic - result.alone.bic > 2.0:
        together, alone = loop_misfits(result.fit.found.misfits), loop_misfits(result.alone.misfits)
        out.append(
            f"The tests are not the same in what they share: misfit {_span(together)} together, "
            f"{_span(alone)} each alone, and the evidence is for the latter (BIC "
            f"{result.bic - result.alone.bic:.0f} lower); let more be own, scatter or follow a law "
            "of rate."
        )
    for name, one in result.parameters.items():
        if one.kind not in ("own", "fixed") and one.state != "determined":
            out.append(f"{name} ({one.kind}) is {one.state}: {one.why}.")
    for name, half in result.open_slopes.items():
        if (kind := result.parameters[name].kind) in RATES:
            out.append(
                f"{name} ({kind}): its own values in the tests, at {_rates(result)}, leave its "
                f"slope b open by {_open(half)}; a law of rate needs more tests over a wider span "
                "of rates."
            )
    for name in dict.fromkeys(one.parameter for one in result.evidence):
        tried = [one for one in result.evidence if one.parameter == name]
        mine, best = next(o for o in tried if o.chosen), min(tried, key=lambda one: one.bic)
        if best.bic < mine.bic - 2.0:
            out.append(
                f'The evidence on {name} is for "{best.kind}" rather than "{mine.kind}" '
                f"(BIC {mine.bic - best.bic:.1f} lower)."
            )
    return bool(lost), out


def _rates(result: JointData) -> str:
    """The rates of the tests in words."""
    known = [rate for rate in result.rates if rate is not None]
    return f"{min(known):.3g} to {max(known):.3g} 1/s"


def _open(half: float) -> str:
    """By how much slopes are left open."""
    return f"±{half:.2g}" if math.isfinite(half) else "any amount"


def _span(found: Sequence[float | None]) -> str:
    """Smallest and largest misfit."""
    known = [one for one in found if one is not None]
    return f"{percent(min(known))} to {percent(max(known))}" if known else "unknown"


def sentences_of(result: JointData) -> Iterator[str]:
    """What the fit says."""
    kinds = dict[str, list[str]]()
    for name, one in result.parameters.items():
        kinds.setdefault(one.kind, []).append(name)
    parts = [f"{listed(names)} {kind}" for kind, names in kinds.items() if kind != "fixed"]
    found = result.fit.found
    yield (
        f"{counted(len(result.tests), 'test')} fitted with {counted(found.n_vary, 'number')} "
        f"({'; '.join(parts)})."
    )
    untried = {
        name: half for name, half in result.open_slopes.items()
        if result.parameters[name].kind not in RATES
    }  # fmt: skip
    if untried:
        yield (
            f"No law of rate was tried for {listed(untried)}: over {_rates(result)} the values of "
            f"single tests leave a slope b open by {_open(min(untried.values()))} or more, and it "
            "is of the order of one."
        )
    spreads = {
        name: (one.scatter, *one.scatter_ci95) for name, one in result.parameters.items()
        if one.kind == "scatter" and one.scatter is not None and one.scatter_ci95 is not None
    }  # fmt: skip
    if spreads:
        told = ", ".join(
            f"{name} {percent(tau)} ({percent(low)} to {percent(high)})"
            for name, (tau, low, high) in spreads.items()
        )
        yield (
            "Scatter between specimens, errors of measurement taken off (standard deviation of "
            f"the logarithm; 95 % interval): {told}."
        )
    for name, one in result.parameters.items():
        if one.b is not None and one.b_ci95 is not None:
            low, high = one.b_ci95
            what = "rises" if one.b > 0.0 else "falls"
            sure = "" if low > 0.0 or high < 0.0 else ", which zero is consistent with"
            yield (
                f"{name} {what} with the rate: b = {one.b:.4g} (95 %: {low:.4g} to {high:.4g})"
                f"{sure}."
            )
