"""The HTML report of a result folder."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from importlib.metadata import version

from foamfit.fitting.branches import covered
from foamfit.report.plots import origin_word
from foamfit.report.readable import quantity, readable
from foamfit.report.render import page
from foamfit.report.result_figures import Images, draw_all
from foamfit.report.summary import ANSWERS, conclusions, determined, misfits, tables
from foamfit.results import Fit
from foamfit.trust.covariance import RULE


def render_report(result: Fit, figures: Mapping[str, Images | None] | None = None) -> str:
    """Return the report as one HTML page that needs nothing else.

    `figures` are those of `draw_all`, if they are drawn already.
    """
    drawn = dict(draw_all(result)) if figures is None else figures
    plain = result.to_json_dict()
    springs = result.springs
    return page(
        "report",
        result=result,
        version=version("foamfit"),
        origin=origin_word(result),
        conclusions=conclusions(result),
        determined=determined(result),
        misfits=misfits(result),
        statistics=plain["statistics"],
        springs=springs,
        seen={name: covered(result.visited.get(name, ())) for name in springs},
        parameters=[readable(name, p) for name, p in result.parameters.items()],
        rule=RULE,
        quantity=quantity,
        energy={k: x for k, x in plain["energy"].items() if type(x) in (int, float)},
        energy_sentences=plain["energy"].get("sentences") or [],
        answers=ANSWERS,
        **tables(result),
        figures={name: images and _figure(images) for name, images in drawn.items()},
    )


def _figure(images: Images) -> tuple[str, float]:
    """Return a PNG in base64, and its width in inches (the width in pixels is in its header)."""
    width = int.from_bytes(images.png[16:20])
    return base64.b64encode(images.png).decode("ascii"), width / images.dpi
