"""The HTML report of a result folder."""

from __future__ import annotations

from collections.abc import Mapping

from foamfit.fitting.branches import covered
from foamfit.report.plots import origin_word
from foamfit.report.readable import readable
from foamfit.report.render import page
from foamfit.report.result_figures import Images, draw_all
from foamfit.report.summary import ANSWERS, conclusions, determined, misfits, tables
from foamfit.results import Fit
from foamfit.trust.covariance import RULE


def render_report(result: Fit, figures: Mapping[str, Images | None] | None = None) -> str:
    """Return the report as one self-contained HTML page.

    `figures` are those of `draw_all`, if they are drawn already.
    """
    drawn = dict(draw_all(result)) if figures is None else figures
    plain, springs, insight = result.to_json_dict(), result.springs, result.insight
    parts, shares = ((), None) if insight is None else (insight.parts, insight.shares())
    correlation = None if insight is None else insight.correlation
    if result.correlation is not None:  # better known
        correlation = result.correlation.matrix
    return page(
        "report",
        result=result,
        origin=origin_word(result),
        conclusions=conclusions(result),
        determined=determined(result),
        misfits=misfits(result),
        statistics=plain["statistics"],
        springs=springs,
        seen={name: covered(result.visited.get(name, ())) for name in springs},
        parameters=[readable(name, p) for name, p in result.parameters.items()],
        rule=RULE,
        energy={k: x for k, x in plain["energy"].items() if type(x) in (int, float)},
        energy_sentences=plain["energy"].get("sentences") or [],
        answers=ANSWERS,
        parts=[] if shares is None else list(zip(parts, shares.T.tolist(), strict=True)),
        correlation=[] if correlation is None else correlation.tolist(),
        **tables(result),
        figures=drawn,
    )
