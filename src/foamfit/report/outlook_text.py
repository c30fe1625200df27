"""The look ahead at a test, in words."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from foamfit.report.outlook import GUESSED, Outlook, chain_of, worth
from foamfit.report.readable import readable
from foamfit.results import law_in_words
from foamfit.springs.laws import BistableSpring
from foamfit.springs.parameters import NUISANCE
from foamfit.text import aligned, engineering, labelled, percent, significant, wrapped
from foamfit.trust.checklist import ESTIMATED
from foamfit.trust.identifiability import Insight


def outlook_text(outlook: Outlook) -> str:
    """Write an outlook for people: at most 100 columns wide, no newline at the end."""
    problem, planned = outlook.problem, outlook.planned
    units = {name: "m" if "displacement" in name else "Pa" for name in outlook.noise}
    noise = ", ".join(
        f"{_spoken(name)} {engineering(level.sigma, units[name])} "
        f"({'stated' if level.given else 'estimated'})"
        for name, level in outlook.noise.items()
    )
    law = law_in_words(problem.model.name, problem.model.relaxation)
    told = [
        ("model", [f"{law}, {problem.objective.drive} drive"]),
        ("start", [f"{outlook.source}; all that follows holds there"]),
        ("noise", [noise, *_larger_residuals(outlook)]),
        ("loop", list(_closing_sentences(outlook))),
    ]
    if planned.insight is not None:
        told.append(("channels", list(_worth_sentences(planned.insight))))
        told.append(("least", [planned.insight.sentence()]))
    if outlook.exact:
        told.append(("exact", [_exact_sentence(outlook)]))
    lines = [
        line
        for name, item in planned.estimates.items()
        if item.state != "determined" and name not in NUISANCE
        for line in wrapped(f"{name}: {item.state}, {item.why}.")
    ]
    return "\n".join([labelled(told), "", *_table(outlook), "", *lines]).rstrip()


def _exact_sentence(outlook: Outlook) -> str:
    """Say what 1 % of each quantity without a ± would do at most, and name the worst."""
    effects = [
        f"1 % of the {quantity.replace('_', ' ')} moves {name} by {percent(share)} of its scale "
        f"({significant(times)} times)"
        for quantity, (name, times, share) in outlook.exact.items()
    ]
    most = next(iter(outlook.exact)).replace("_", " ")
    return (
        f"The ± of the {most}, which the TOML lacks, would matter most: {', '.join(effects)}; in "
        "brackets over the standard error by noise."
    )


def _larger_residuals(outlook: Outlook) -> Iterator[str]:
    """Warn where the start values leave more than the noise: then the errors are too small."""
    objective = outlook.problem.objective
    for name, rms in objective.rms(objective.differences(outlook.values)).items():
        if (times := rms / outlook.noise[name].sigma) > ESTIMATED:
            yield (
                f"The start values leave {significant(times)} times the noise of {_spoken(name)}, "
                "so the errors to expect are larger than those below."
            )


def _closing_sentences(outlook: Outlook) -> Iterator[str]:
    """Say for each bistable spring how far it goes, and what would close its loop."""
    planned = outlook.planned
    at = "In this test" if planned.velocity is None else f"At {planned.velocity:.4g} m/s"
    for name, seen in planned.visited.items():
        if "a" not in seen:
            continue
        if not outlook.problem.model.laws[int(name[1:]) - 1].points:
            yield _snapping_sentence(at, name, seen, planned.snapped.get(name))
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
        sentence = f"{at} spring {name[1:]} {does}; the loop closes {closing}"
        lost = ", ".join(
            parameter
            for parameter, item in planned.estimates.items()
            if "reached" in item.why and parameter.startswith(f"{name}_")
        )
        if lost and outlook.source.startswith(GUESSED) and "e" not in seen:
            sentence += f", which is a guess: this test does not determine {lost}"
        yield f"{sentence}."


def _snapping_sentence(at: str, name: str, seen: tuple[str, ...], most: float | None) -> str:
    """Say how far a microscale spring goes; it has no one point that closes its loop."""
    does = "snaps back" if "snap-back" in seen else "does not snap back"
    if "snap-through" not in seen:
        return f"{at} spring {name[1:]} stays elastic."
    if most is None:
        return f"{at} spring {name[1:]} snaps through and {does}."
    sentence = f"{at} {percent(most)} of the micro-springs of spring {name[1:]} snap, and it {does}"
    return f"{sentence}{'; of the others the test tells nothing' if most < 0.995 else ''}."


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
        _spoken(curve): 1.0 - float(np.mean(list(ratios.values())))
        for curve, ratios in worth(insight).items()
        if ratios
    }
    for curve, gain in gains.items():
        yield f"Half the noise of {curve} narrows the intervals by {percent(gain)} on average."
    if len(gains) > 1:
        yield f"The channel worth measuring better is {max(gains, key=gains.__getitem__)}."
    elif gains:
        yield f"Only {next(iter(gains))} is compared in this drive."


def _table(outlook: Outlook) -> list[str]:
    """Align the expected standard errors, beside those of the faster test where there is one."""
    table = [
        ["parameter", *(readable(*item).label for item in outlook.planned.estimates.items())],
        ["unit", *(readable(*item).unit for item in outlook.planned.estimates.items())],
    ]  # its columns
    for test in (outlook.planned, outlook.faster):
        if test is not None:
            at = "" if test.velocity is None else f" at {test.velocity:.4g} m/s"
            shown = [readable(name, test.estimates[name]) for name in outlook.planned.estimates]
            table.append([f"expected{at}", *(item.with_error for item in shown)])
            table.append(["state", *(item.state for item in shown)])
    return aligned(list(zip(*table, strict=True)))


def _spoken(name: str) -> str:
    return name.replace("_", "-")
