"""The two sides of a comparison: the parameters of a fit, or published ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foamfit.errors import InputError
from foamfit.report.folder import load_result
from foamfit.results import Fit, ParameterEstimate, law_in_words
from foamfit.springs.model import Model
from foamfit.springs.published import PublishedSet
from foamfit.springs.published import published as published_sets

Result = Fit | Mapping[str, Any] | str | Path

# What is read of a result, and of each of its parameters.
CONTENT = {"test": str, "model": str, "drive": str, "status": str, "parameters": Mapping}
_NUMBER = int | float | None
ESTIMATE = {
    "value": _NUMBER, "stderr": _NUMBER, "unit": str, "vary": bool, "state": str, "why": str,
}  # fmt: skip


@dataclass(frozen=True)
class Side:
    """The parameters of one side of a comparison: of a fit, or published."""

    label: str
    kinds: tuple[str, ...]
    estimates: Mapping[str, ParameterEstimate]
    correlation: Mapping[tuple[str, str], float]
    drive: str = ""
    status: str = ""
    stopped: str | None = None
    test: str = ""
    sha: str = ""
    source: PublishedSet | None = None
    relaxation: int = 0  # terms of each hysteretic spring


def side_of(result: Result) -> Side:
    """Return the parameters of a fit; InputError if the result is not whole."""
    if isinstance(result, Fit):
        content: Mapping[str, Any] = result.to_json_dict()
    else:
        content = result if isinstance(result, Mapping) else load_result(result)
    where = str(result) if isinstance(result, str | Path) else "the result"
    given = _whole(content, CONTENT, where)
    test, model, drive = given["test"], given["model"], given["drive"]
    terms = given.get("relaxation", 0)
    if type(terms) is not int or terms < 0:
        raise InputError(
            f"{where} is no whole result of a fit: 'relaxation' cannot be {str(terms)[:40]!r}; "
            "fit again"
        )
    return Side(
        label=f"{test}: {law_in_words(model, terms)}, {drive} drive",
        kinds=Model.parse(model).kinds,
        relaxation=terms,
        estimates={name: _read_estimate(p, where, name) for name, p in given["parameters"].items()},
        correlation=_correlation(given.get("correlation"), where),
        drive=drive,
        status=given["status"],
        stopped=given.get("stopped"),
        test=test,
        sha=str(given.get("data_sha256", "")),
    )


def _whole(content: Any, wanted: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    """Return what a result holds if it holds all that is wanted, each of its kind."""
    given = content if isinstance(content, Mapping) else {}
    for key, kind in wanted.items():
        fine = key in given and isinstance(given[key], kind)
        if not fine or (kind is _NUMBER and isinstance(given[key], bool)):
            fault = f"cannot be {str(given[key])[:40]!r}" if key in given else "is missing"
            raise InputError(f"{where} is no whole result of a fit: '{key}' {fault}; fit again")
    return given


def _read_estimate(content: Mapping[str, Any], where: str, name: str) -> ParameterEstimate:
    """Read one parameter of a result."""
    p = _whole(content, ESTIMATE, f"{where}: {name}")
    value = math.nan if p["value"] is None else float(p["value"])
    return ParameterEstimate(value, p["stderr"], None, p["unit"], p["vary"], p["state"], p["why"])


def _correlation(content: Any, where: str) -> dict[tuple[str, str], float]:
    if content is None:
        return {}
    try:
        return {
            (str(one), str(other)): float(value)
            for one, row in zip(content["names"], content["matrix"], strict=True)
            for other, value in zip(content["names"], row, strict=True)
            if value is not None
        }
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{where} is no whole result of a fit: 'correlation' must have names and a square "
            "matrix of numbers; fit again"
        ) from None


def published_side(name: str) -> Side:
    """Return the parameters of a published set."""
    item = published_sets[name]
    values = {} if item.eta is None else {"site_eta": item.eta}
    kinds = []
    for i, spring in enumerate(item.chain.springs, start=1):
        kinds.append(spring.law.kind)
        for short in spring.law.own:
            values[f"s{i}_{short}"] = getattr(spring, short)
        values[f"s{i}_height"] = item.chain.heights[i - 1]
    estimates = {
        name: ParameterEstimate(value, None, None, "", False, "published", "")
        for name, value in values.items()
    }
    return Side(f"published {name}", tuple(kinds), estimates, {}, source=item)
