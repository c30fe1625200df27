"""`foamfit card`: a material card for finite elements, and what it loses."""

from __future__ import annotations

import re
from pathlib import Path

import click

from foamfit.cli import options
from foamfit.cli.group import main
from foamfit.errors import InputError
from foamfit.terminal import say


@main.command()
@click.argument("result", metavar="RESULT", type=options.FILE)
@options.option(
    "--format",
    "LS-DYNA *MAT_083 or *MAT_057, Radioss LAW90, Abaqus low-density foam, or the curves alone.",
    metavar="mat083|mat057|law90|abaqus|csv",
    required=True,
)
@options.option(
    "--units", "Consistent units of the card.", metavar="kg-mm-ms|t-mm-s|SI", default="kg-mm-ms"
)
@options.option(
    "--rates",
    "Strain rates of the loading curves, 1/s. Default: those of the fitted tests.",
    metavar="RATE,RATE,…",
)
@options.option("--out", "The card. Default: cards/<test>-<format> and its ending.", options.FILE)
def card(result: Path, format: str, units: str, rates: str | None, out: Path | None) -> None:
    """Write a material card of the law in RESULT: the folder of a fit or of a joint fit.

    Beside FILE stand FILE.json (parameters, curves in SI, misfit of fit and card), FILE.png and
    FILE.pdf: measured, fitted, card. A rate outside the fitted ones gets the curve of the nearest
    fitted rate, with a warning; beyond the measured strain the law extrapolates.

    \b
    Examples:
        foamfit card fits/TEST/microscale --format mat083
        foamfit card joint/new-heel --format law90 --units t-mm-s --rates 0.01,1,100 --out foam.rad
    """
    from foamfit.cards import card as cards
    from foamfit.study.prediction.identified import read_source

    asked = None if rates is None else rates.split(",")
    cards.check(format, units, asked)
    source = read_source(result)
    name = re.sub(r"[^\w.+-]+", "-", source.name).strip("-.") or "card"
    file = out or Path("cards", f"{name}-{format}{cards.FORMATS[format][0]}")
    folder = result if result.is_dir() else result.parent
    if folder.resolve() in file.resolve().parents:
        raise InputError(
            f"{file} lies in a result, which is replaced as a whole; choose another --out"
        )
    with options.compiling(False, source.model.name, source.model.relaxation) as compile_rest:
        compile_rest()
        made = cards.card(result, format=format, units=units, rates=asked)
    if out is None:
        file.parent.mkdir(exist_ok=True)
    made.save(file)
    say(f"{made.summary()}\nwritten to {file}, with {file.name}.json, .png and .pdf beside it")
