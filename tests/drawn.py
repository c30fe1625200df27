"""Figures of every kind, drawn from fabricated results and fast simulations."""

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import fabricated
import foamfit as ff
from foamfit.data.measurement import Outliers
from foamfit.report.comparison import compare, plot_comparison
from foamfit.report.plots import plot_fit, plot_response


def with_outliers(result: ff.FitResult) -> ff.FitResult:
    left_out = np.zeros(result.curves.time.size, dtype=bool)
    left_out[[100, 101]] = True
    spikes = Outliers(left_out, result.curves.time[left_out], np.array([2e6, 9e6]), None)
    measurement = replace(result.measurement, outliers={"stress": spikes})
    return replace(result, measurement=measurement)


def with_masses_inside(result: ff.FitResult) -> ff.FitResult:
    inside = 1e-4 * np.sin(np.linspace(0.0, 3.0, result.curves.time.size))
    interior = {1: (inside, 1.1 * inside), 2: (2.0 * inside, 2.1 * inside)}
    return replace(result, curves=replace(result.curves, interior=interior))


def without_time(result: ff.FitResult) -> ff.FitResult:
    switches = tuple(replace(switch, time=None) for switch in result.switches)
    curves = replace(result.curves, time=None, displacement=None)
    return replace(result, drive="displacement", curves=curves, switches=switches)


RESULTS = {
    "bistable": fabricated.result,
    "chain with masses inside": lambda: with_masses_inside(fabricated.chain_result()),
    "microscale, relaxing": fabricated.microscale_result,
    "outliers": lambda: with_outliers(fabricated.result()),
    "no time": lambda: without_time(fabricated.result()),
}


def response() -> Any:
    chain = ff.published["foam-1/model-3"].chain
    return ff.simulate(chain, ff.Impact(7e-3, 2.0), np.linspace(0.0, 1.2e-3, 301))


@functools.cache
def figures(width: str = "two") -> tuple[tuple[str, Figure], ...]:
    """Return all figures that are quick to draw; callers must not modify these shared figures."""
    return tuple(_figures(width))


def _figures(width: str) -> Iterator[tuple[str, Figure]]:
    for name, make in RESULTS.items():
        yield name, plot_fit(make(), width=width)
    yield "response", plot_response(response(), width=width)
    one = fabricated.result()
    named = replace(one, measurement=replace(one.measurement, name="foam-1/model-1"))
    yield "comparison", plot_comparison(compare([named]), width=width)
