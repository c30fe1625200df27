"""Display of the uncertainty budget and of the nuisance parameters."""

from __future__ import annotations

from dataclasses import replace

import pytest

import fabricated
import foamfit as ff
from foamfit.parts import ParameterEstimate
from foamfit.report.readable import readable
from foamfit.report.summary import render_report

NUISANCE = {
    "contact_time": (3.2e-6, 1.1e-6, "s", "contact time t₀", "µs"),
    "displacement_zero": (-2e-9, 4e-6, "m", "motion zero w₀", "µm"),
    "stress_zero": (20.0, 1.5e3, "Pa", "stress zero σ₀", "kPa"),
    "acceleration_zero": (3.0, 0.2, "m/s^2", "acceleration zero a₀", "m/s²"),
    "velocity": (1.752, 0.004, "m/s", "velocity v₀", "m/s"),
    "striker_mass": (7.01e-3, 2e-5, "kg", "striker mass m", "g"),
}


def with_nuisance() -> ff.FitResult:
    made = {
        name: ParameterEstimate(
            value, error, (value - 2 * error, value + 2 * error), unit, True, "weak", "so"
        )
        for name, (value, error, unit, _, _) in NUISANCE.items()
    }
    one = fabricated.result()
    return replace(one, parameters=one.parameters | made, warnings=())


@pytest.mark.parametrize("name", NUISANCE)
def test_a_nuisance_parameter_reads_well(name: str) -> None:
    *_, label, unit = NUISANCE[name]
    shown = readable(name, with_nuisance().parameters[name])
    assert (shown.label, shown.unit) == (label, unit)
    assert shown.stderr
    assert "e" not in shown.with_error


def test_the_report_has_the_budget_as_table_and_picture() -> None:
    budget = fabricated.budget(area=0.02, contact_and_zero=0.01)
    one = fabricated.result()
    estimates = {
        name: replace(p, systematic=0.02 * abs(p.value)) for name, p in one.parameters.items()
    }
    result = replace(one, budget=budget, parameters=estimates)
    text = render_report(result, fabricated.no_figures())
    page = text[text.index("Uncertainty budget") :]
    head, row = (part.split("</tr>")[0] for part in page.split("<tr>")[1:3])
    assert head.count("<th") == 6  # corner, three sources, combined, bars
    assert "mass" not in head
    for share in ("1 %", "2 %", "2.4 %"):  # √(1 + 1 + 4)
        assert f">{share}<" in row
    widths = [float(bar.split("%")[0]) for bar in row.split("width: ")[1:]]
    assert widths == pytest.approx([100 / 6, 100 / 6, 400 / 6], abs=0.1)  # shares of variance
    assert "± 0.11" in text  # 2 % of k0 = 5.5 MPa
    assert "Systematic is one standard deviation" in text


def test_noise_alone_needs_no_budget() -> None:
    """The table of parameters already shows uncertainty due to noise."""
    result = fabricated.result(budget=fabricated.budget(law=0.03))
    text = render_report(result, fabricated.no_figures())
    assert "Uncertainty budget" not in text
    assert "systematic</th>" not in text
