"""The HTML report of a result folder."""

from __future__ import annotations

import base64
import functools
import math
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from foamfit.fitting.branches import covered
from foamfit.report.plots import origin_word
from foamfit.report.readable import number, readable, readable_unit
from foamfit.report.result_figures import Images, draw_all
from foamfit.report.summary import ANSWERS, LADDER, conclusions, ladder_cells, misfits
from foamfit.results import Fit
from foamfit.springs.laws import BistableSpring, MicroscaleSpring
from foamfit.text import engineering, percent
from foamfit.trust.covariance import RULE

if TYPE_CHECKING:
    from jinja2 import Environment

DRIVES = {
    "impact": "The motion follows from the mass and the velocity of the striker; nothing measured "
    "enters the simulation.",
    "stress": "The measured stress acts on the chain, which is in equilibrium at every sample.",
    "displacement": "The measured displacement of the top is prescribed.",
}
MARKS = {
    "bistable": "A1 and C1 are where the spring starts to snap and has snapped on loading; C2 and "
    "A2 where it starts to snap back and has recovered on unloading.",
    "microscale": "σ₊ and σ₋ are where half of the micro-springs have snapped on loading, and "
    "where half have snapped back on unloading. Of a single spring also its branches are drawn, "
    "thin and grey: the elastic branch a, on which none has snapped, and the densified branch c, "
    "on which all have.",
}
POINTS = (  # attribute of the spring, symbol and its index, meaning, unit
    ("sigma_a", ("σ", "a"), "stress at A1, where snapping starts", "Pa"),
    ("sigma_c", ("σ̄", "c"), "stress at C2, where snap-back starts", "Pa"),
    ("eps_star", ("ε", "*"), "strain at which branch c starts from zero stress", ""),
    ("eps_hat_a", ("ε̂", "a"), "strain at A2, where branches e and a meet", ""),
    ("eps_hat_c", ("ε̂", "c"), "strain at C1, where branches d and c meet", ""),
    ("sigma_hat_c", ("σ̂", "c"), "stress at C1", "Pa"),
)
STATISTICS = {
    "n_data": "data points", "n_effective": "effective samples", "n_vary": "parameters varied",
    "chisqr": "χ²", "redchi": "reduced χ²", "aic": "AIC", "aicc": "AICc", "bic": "BIC",
    "n_failed": "trials that could not be simulated", "n_descents": "local minima refined",
    "n_agreeing": "descents that reached the best", "n_left_out": "outliers left out",
}  # fmt: skip
ENERGY = {  # of the audit: label and unit
    "striker_energy": ("striker's energy", "J/m³"),
    "absorbed_energy": ("absorbed energy", "J/m³"),
    "dissipated_energy": ("dissipated energy", "J/m³"),
    "dissipated_fraction": ("dissipated over absorbed", ""),
    "absorbed_over_striker": ("absorbed over striker's", ""),
    "rebound_velocity": ("rebound velocity", "m/s"),
    "impulse": ("impulse of the force", "N·s"),
    "momentum_change": ("change of momentum", "N·s"),
    "impulse_ratio": ("impulse over change of momentum", ""),
}
Point = tuple[tuple[str, str], str, str, str]  # symbol and its index, meaning, value, unit
BADGES = {True: "ok", False: "weak", None: "fixed"}  # of the answers to the checklist
CITATION = (
    "Thevamaran, R., Fraternali, F., Daraio, C. (2014). Multiscale Mass-Spring Model for "
    "High-Rate Compression of Vertically Aligned Carbon Nanotube Foams. "
    "Journal of Applied Mechanics 81, 121006."
)


@functools.cache
def environment() -> Environment:
    """The templates of all pages."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("foamfit.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"number": number, "percent": percent}
    return made


def render_report(result: Fit, figures: Mapping[str, Images | None] | None = None) -> str:
    """Return the report as one HTML page that needs nothing else.

    `figures` are those of `draw_all`, if they are drawn already and kept as files beside it.
    """
    drawn = dict(draw_all(result)) if figures is None else figures
    plain = result.to_json_dict()
    energy = plain["energy"]
    return (
        environment()
        .get_template("report.html")
        .render(
            result=result,
            version=version("foamfit"),
            origin=origin_word(result),
            conclusions=conclusions(result),
            misfits=misfits(result),
            statistics={
                STATISTICS.get(name, name.replace("_", " ")): value
                for name, value in plain["statistics"].items()
                if name not in ("nfev", "n_starts")  # the page says these where it says how
            },
            visited=_visited(result),
            marks=[MARKS[kind] for kind in MARKS if kind in result.model.split("+")],
            parameters=[readable(name, p) for name, p in result.parameters.items()],
            systematic=any(p.systematic > 0.0 for p in result.parameters.values()),
            budget=_budget(result),
            ranged=any(p.range for p in result.parameters.values()),
            rule=RULE,
            points={
                f"Points of the law, spring {name}": _points(spring)
                for name, spring in result.bistable_springs.items()
            }
            | {
                f"Snapping of spring {name}": list(_snapping(result, name, spring))
                for name, spring in result.microscale_springs.items()
            },
            energy_sentences=energy.pop("sentences", None) or [],
            energy=dict(_energies(energy)),
            drive_meaning=DRIVES.get(result.drive, ""),
            ladder=result.ladder,
            ladder_header=LADDER,
            ladder_rows=[] if result.ladder is None else ladder_cells(result.ladder),
            answers=ANSWERS,
            badges=BADGES,
            kept=figures is not None,
            figures={name: images and _figure(images) for name, images in drawn.items()},
            citation=CITATION,
        )
    )


def _budget(result: Fit) -> dict[str, list[float]]:
    """Contributions to each parameter, and all of them combined, over its scale."""
    if (budget := result.budget) is None:
        return {}
    return {
        name: [
            value / budget.scales[name]
            for value in (*(row[source] for source in budget.sources), budget.combined(name))
        ]
        for name, row in budget.contributions.items()
    }


def _points(spring: BistableSpring) -> list[Point]:
    rows = []
    for attribute, symbol, meaning, si in POINTS:
        value = getattr(spring, attribute)
        factor, unit = readable_unit(value or 0.0, si)
        shown = "does not exist" if value is None else number(value / factor)
        rows.append((symbol, meaning, shown, unit or "–"))
    return rows


def _snapping(result: Fit, name: str, spring: MicroscaleSpring) -> Iterator[Point]:
    """Give what stands for the points of a bistable spring: symbol, meaning, value and unit."""
    for sign, sigma, spread, word in (
        ("+", spring.sigma_plus, spring.spread_plus, "through"),
        ("−", spring.sigma_minus, spring.spread_minus, "back"),
    ):
        factor, unit = readable_unit(sigma, "Pa")
        low, high = (number(sigma * math.exp(s * spread) / factor) for s in (-1.0, 1.0))
        median = f"median snap-{word} stress; 68 % snap {word} between {low} and {high} {unit}"
        yield ("σ", sign), median, number(sigma / factor), unit
    jump = "strain by which a micro-spring of median snap-through stress jumps"
    yield ("Δε", "+"), jump, number(spring.snap_strain), "–"
    if (snapped := result.snapping.get(name)) is not None:
        factor, unit = readable_unit(stress := float(snapped.stress[snapped.turn]), "Pa")
        yield ("p", "max"), "largest fraction snapped in the test", number(snapped.most), "–"
        yield ("σ", "max"), "equilibrium stress there", number(stress / factor), unit
        if result.strain is not None:
            strain = float(result.strain[snapped.turn])
            yield ("ε", "max"), "overall strain there", number(strain), "–"
    total = sum(g for g, _ in spring.relaxation)
    for k, (g, tau) in enumerate(spring.relaxation, start=1):
        factor, unit = readable_unit(tau, "s")
        time = f"{number(tau / factor)} {unit}"
        share = f"g/(1+Σg), share of a sudden change of stress that relaxes, with τ = {time}"
        yield ("g", str(k)), share, number(g / (1.0 + total)), "–"


def _energies(energy: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Give label and value of the numbers of an audit; its texts are in its sentences."""
    for name, value in energy.items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            label, unit = ENERGY.get(name, (name.replace("_", " "), ""))
            yield label, engineering(value, unit) if unit else number(value)


def _visited(result: Fit) -> dict[str, list[tuple[str, str, bool]]]:
    """Return the branches of each spring, what they are, and whether it went through them."""
    return {
        f"s{i}": [
            (branch, meaning, branch in covered(result.visited.get(f"s{i}", ())))
            for branch, meaning in (spring.law.branches if spring.law.hysteretic else {}).items()
        ]
        for i, spring in enumerate(result.chain.springs, start=1)
    }


def _figure(images: Images) -> tuple[str, float]:
    """Return a PNG in base64, and its width in inches (the width in pixels is in its header)."""
    width = int.from_bytes(images.png[16:20])
    return base64.b64encode(images.png).decode("ascii"), width / images.dpi
