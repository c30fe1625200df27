"""Display of the uncertainty budget."""

from __future__ import annotations

from dataclasses import replace

import pytest

import fabricated
from foamfit.report.summary import render_report


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
