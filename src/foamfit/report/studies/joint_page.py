"""The page of a joint fit: one file that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from foamfit.report.page import environment
from foamfit.report.readable import readable, readable_unit, symbol
from foamfit.report.studies.joint_text import between
from foamfit.results import ParameterEstimate, law_in_words
from foamfit.springs.parameters import NUISANCE
from foamfit.text import number
from foamfit.trust.covariance import RULE

if TYPE_CHECKING:
    from foamfit.study.joint_result import JointData, JointParameter

CURVES = {"stress_strain": "loop", "stress_time": "σ(t)", "displacement_time": "u(t)"}


@dataclass(frozen=True)
class _Row:
    """One parameter as the page has it."""

    name: str
    symbol: tuple[str, str]
    kind: str
    value: str
    interval: str
    range: str
    between: str
    state: str | None
    why: str


@dataclass(frozen=True)
class _Cell:
    """One cell of the table of tests; `key` is what it is sorted by, if not what it shows."""

    shown: str
    key: str | None = None
    ends: str = ""
    state: str = ""
    link: str = ""


def joint_page(found: JointData, picture: bytes, *, linked: bool = True) -> str:
    """Return the page; `picture` is a PNG, `linked` says whether each test has a report."""
    names = [name for name, one in found.parameters.items() if one.tests and one.kind != "fixed"]
    evidence = {
        name: [one for one in found.evidence if one.parameter == name]
        for name in dict.fromkeys(one.parameter for one in found.evidence)
    }
    return environment().get_template("joint.html").render(
        found=found,
        law=law_in_words(found.study.model, found.study.relaxation),
        version=version("foamfit"),
        picture=base64.b64encode(picture).decode("ascii"),
        parameters=[
            _row(name, one) for name, one in found.parameters.items()
            if name not in NUISANCE and (one.kind != "fixed" or one.value)
        ],
        rule=RULE,
        ranged=any(one.range for one in found.parameters.values()),
        evidence=evidence,
        heads=_heads(found, names),
        rows=[list(_cells(found, t, names, linked)) for t in range(len(found.tests))],
        linked=linked,
    )  # fmt: skip


def _row(name: str, one: JointParameter) -> _Row:
    estimate = ParameterEstimate(
        one.value, one.stderr, one.ci95, one.unit, True, one.state or "", one.why or "",
        range=one.range,
    )  # fmt: skip
    shown = readable(name, estimate)
    unit = "" if shown.unit == "–" else f" {shown.unit}"
    interval = f"{shown.interval}{unit}" if shown.interval else ""
    value = f"{shown.with_error}{unit}"
    span = f"{shown.range}{unit}" if shown.range else ""
    return _Row(
        name, shown.symbol, one.kind, value, interval, span, between(one), one.state, one.why or ""
    )


def _curves(found: JointData) -> list[str]:
    """Curves that some test has."""
    every = found.fit.found.misfits
    return [name for name in CURVES if any(one.get(name) is not None for one in every)]


def _counted(found: JointData) -> list[str]:
    """Curves whose noise weights some test."""
    return [name for name in CURVES if any(name in one for one in found.noise)]


def _noise_unit(found: JointData, curve: str) -> tuple[float, str]:
    """Factor and unit in which the noise of a curve reads well."""
    top = max(one[curve]["sigma"] for one in found.noise if curve in one)
    return readable_unit(top, "m" if curve.startswith("displacement") else "Pa")


def _noise(level: Mapping[str, Any] | None, factor: float) -> _Cell:
    """The noise of a curve of a test: one standard deviation, and where it is from."""
    if level is None:
        return _Cell("")
    told = ["stated" if level["given"] else "estimated"]
    if level["time"] > 1.05:
        told.append(f"correlated over {level['time']:.2g} samples")
    if level["scale"] > level["sigma"]:
        told.append(f"counted as {number(level['scale'] / factor)}")
    sigma = level["sigma"] / factor
    return _Cell(number(sigma), f"{level['sigma']:.8g}", ", ".join(told))


def _unit(one: JointParameter) -> tuple[float, str]:
    """Factor and unit in which a parameter reads well in all tests."""
    tests = one.tests or {}
    return readable_unit(max((abs(at.value) for at in tests.values()), default=0.0), one.unit)


def _heads(found: JointData, names: list[str]) -> list[str]:
    heads = ["test", "rate (1/s)", *(f"misfit {CURVES[c]} (%)" for c in _curves(found))]
    heads.append("share of χ² (%)")
    heads += [f"noise {CURVES[c]} ({_noise_unit(found, c)[1]})" for c in _counted(found)]
    for name in names:
        one = found.parameters[name]
        stem, index = symbol(name)
        unit = _unit(one)[1]
        heads.append(f"{stem}{index}{f' ({unit})' if unit else ''}")
    return heads


def _cells(found: JointData, t: int, names: list[str], linked: bool) -> Iterator[_Cell]:
    test, rate, off = found.tests[t], found.rates[t], found.fit.found.misfits[t]
    yield _Cell(test, link=f"{quote(test)}/report.html" if linked else "")
    yield _Cell("" if rate is None else f"{rate:.3g}", "" if rate is None else f"{rate:.6g}")
    for curve in _curves(found):
        miss = off.get(curve)
        yield _Cell("" if miss is None else f"{100 * miss:.2f}")
    yield _Cell(f"{100 * found.shares[t]:.1f}")
    for curve in _counted(found):
        yield _noise(found.noise[t].get(curve), _noise_unit(found, curve)[0])
    for name in names:
        one = found.parameters[name]
        assert one.tests is not None  # such were chosen
        if (value := one.tests.get(test)) is None:
            yield _Cell("")
            continue
        factor = _unit(one)[0]
        ends = "" if value.ci95 is None else " to ".join(number(e / factor) for e in value.ci95)
        state = "" if value.state in ("determined", "fixed") else value.state
        yield _Cell(number(value.value / factor), f"{value.value:.8g}", ends, state)
