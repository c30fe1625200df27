"""The look ahead at a test, in words."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from foamfit.report.outlook import GUESSED, Outlook, chain_of, worth
from foamfit.report.readable import readable
from foamfit.springs.spring import BistableSpring
from foamfit.text import aligned, engineering, labelled, percent, significant, wrapped
from foamfit.trust.checklist import ESTIMATED
from foamfit.trust.identifiability import Insight


def outlook_text(outlook: Outlook) -> str:
    """Write an outlook for people: at most 100 columns wide, no newline at the end."""
    problem, planned = outlook.problem, outlook.planned
    noise = ", ".join(
        f"{_spoken(name)} {engineering(level.sigma, 'm' if 'displacement' in name else 'Pa')} "
        f"({'stated' if level.given else 'estimated'})"
        for name, level in outlook.noise.items()
    )
    told = [
        ("model", [f"{problem.model.name}, {problem.objective.drive} drive"]),
        ("start", [f"{outlook.source}; all that follows holds there"]),
        ("noise", [noise, *_larger_residuals(outlook)]),
        ("loop", list(_closing_sentences(outlook))),
    ]
    if planned.insight is not None:
        told.append(("channels", list(_worth_sentences(planned.insight))))
        told.append(("least", [planned.insight.sentence()]))
    reasons = [
        f"{name}: {item.state}, {item.why}."
        for name, item in planned.estimates.items()
        if item.state != "determined"
    ]
    lines = [line for reason in reasons for line in wrapped(reason)]
    return "\n".join([labelled(told), "", *_table(outlook), "", *lines]).rstrip()


def _larger_residuals(outlook: Outlook) -> Iterator[str]:
    """Warn where the start values leave more than the noise: then the errors are too small."""
    objective, at = outlook.problem.objective, 0
    residual = objective.differences(outlook.values)
    for (name, level), size in zip(outlook.noise.items(), objective.sizes, strict=True):
        rms = float(np.sqrt(np.mean(residual[at : at + size] ** 2)))
        rms *= objective.scale[name] / objective.weights[name] ** 0.5
        at += size
        if rms > ESTIMATED * level.sigma:
            yield (
                f"The start values leave {significant(rms / level.sigma)} times the noise of "
                f"{_spoken(name)}, so the errors to expect are larger than those below."
            )


def _closing_sentences(outlook: Outlook) -> Iterator[str]:
    """Say for each bistable spring how far it goes, and what would close its loop."""
    planned = outlook.planned
    at = "In this test" if planned.velocity is None else f"At {planned.velocity:.4g} m/s"
    for name, seen in planned.visited.items():
        if "a" not in seen:
            continue
        if planned.velocity is None:
            strain, stress = _needed(outlook, int(name[1:]))
            closing = f"from an overall strain of {strain:.3g} ({engineering(stress, 'Pa')}) on"
        elif (found := outlook.closing.get(name)) is None:
            closing = "at all velocities that were tried, or at none"
        else:
            closing = f"from {found:.4g} m/s on"
        last = "c" if "c" in seen else seen[-1]
        does = "closes its loop" if "e" in seen else f"turns back on branch {last}"
        open_ones = [
            parameter
            for parameter, item in planned.estimates.items()
            if "reached" in item.why and parameter.startswith(f"{name}_")
        ]
        guess = ""
        if open_ones and outlook.source.startswith(GUESSED) and "e" not in seen:
            guess = f", which is a guess: this test does not determine {', '.join(open_ones)}"
        yield f"{at} spring {name[1:]} {does}; the loop closes {closing}{guess}."


def _needed(outlook: Outlook, spring: int) -> tuple[float, float]:
    """Overall strain, and stress (Pa), at which a spring of a slow chain comes to its C1."""
    chain = chain_of(outlook.problem, outlook.values)
    soft = chain.springs[spring - 1]
    assert isinstance(soft, BistableSpring)
    stress = soft.sigma_hat_c
    path = np.linspace(0.0, stress, 400)
    strains = [
        soft.eps_hat_c if i == spring - 1 else float(other.strain(path)[-1])
        for i, other in enumerate(chain.springs)
    ]
    return float(np.dot(chain.heights, strains)) / chain.height, stress


def _worth_sentences(insight: Insight) -> Iterator[str]:
    """Say what halving the noise of each channel would bring, and which is worth it most."""
    gains = {
        curve: 1.0 - float(np.mean(list(ratios.values())))
        for curve, ratios in worth(insight).items()
        if ratios
    }
    for curve, gain in gains.items():
        yield (
            f"Half the noise of {_spoken(curve)} narrows the intervals by {percent(gain)} on "
            "average."
        )
    if len(gains) > 1:
        first = max(gains, key=lambda curve: gains[curve])
        yield f"The channel worth measuring better is {_spoken(first)}."
    elif gains:
        yield f"Only {_spoken(next(iter(gains)))} is compared in this drive."


def _table(outlook: Outlook) -> list[str]:
    """Align the expected standard errors, beside those of the faster test where there is one."""
    tests = [outlook.planned] + ([outlook.faster] if outlook.faster is not None else [])
    heads = [
        "expected" if o.velocity is None else f"expected at {o.velocity:.4g} m/s" for o in tests
    ]
    table = [["parameter", "unit", *(x for head in heads for x in (head, "state"))]]
    for name in outlook.planned.estimates:
        shown = [readable(name, test.estimates[name]) for test in tests]
        cells = [cell for item in shown for cell in (item.with_error, item.state)]
        table.append([name, shown[0].unit, *cells])
    return aligned(table)


def _spoken(name: str) -> str:
    return name.replace("_", "-")
