"""How a test is fitted: the options of every command that fits, and the fit that they ask for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from foamfit.cli.options import (
    COUNT,
    DRIVE,
    MORE,
    RELAXATION,
    WHOLE,
    option,
    together,
)
from foamfit.cli.progress import Progress
from foamfit.errors import InputError
from foamfit.springs.options import OPTIONS

if TYPE_CHECKING:
    import lmfit

    from foamfit.api import FitResult
    from foamfit.data.measurement import Measurement
    from foamfit.study.cycles import CycleFits

# Options that `foamfit.fit` does not take as keywords, and those that become its `intervals`.
OF_ONE_MODEL, WAYS = ("cycle", "cycles", "model", "fix", "vary"), ("profile", "bootstrap", "mcmc")


def _fixes(
    context: click.Context, parameter: click.Parameter, values: tuple[str, ...]
) -> dict[str, float]:
    fixed = {}
    for text in values:
        name, _, number = text.partition("=")
        try:
            fixed[name.strip()] = value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise click.BadParameter(f"'{text}' is not NAME=VALUE in SI, as s1_eta=0.")
    return fixed


fit_options = together(
    option(
        "--model",
        "Springs from the base up; auto compares models and takes the simplest that holds.",
        default="bistable",
    ),
    DRIVE,
    option("--seed", "The same test and seed give the same numbers.", WHOLE, default=0),
    option(
        "--starts",
        "Descents of the search. Default: 16 per spring, 48 if several are hysteretic.",
        COUNT,
    ),
    option("--max-time", "Then the best so far is taken.", float, metavar="SECONDS"),
    option("--fix", "Hold a parameter (SI).", multiple=True, metavar="NAME=VALUE", callback=_fixes),
    option("--vary", "Vary a parameter that is held by default.", multiple=True, metavar="NAME"),
    option("--interior-mass", "Put the specimen's mass between the springs."),
    option("--time-shift", "Fit the delay of the motion against the force."),
    RELAXATION,
    *MORE,
    option(
        "--loss",
        "All but linear weigh large residuals less.",
        click.Choice(["linear", "soft_l1", "huber", "cauchy"]),
        default="linear",
    ),
    option("--profile", "95 % intervals by profile likelihood."),
    option(
        "--bootstrap", "95 % intervals by N >= 40 refits to resampled blocks.", int, metavar="N"
    ),
    option("--mcmc", "95 % intervals by N steps of emcee.", int, metavar="N"),
)


def model_name(asked: Mapping[str, Any]) -> str:
    """Return a model's name without spaces; InputError if there is no such model."""
    from foamfit.springs.model import Model, with_options

    model = asked["model"].strip()
    with_options(model, **{name: asked[name] for name in OPTIONS})
    return "auto" if model == "auto" else Model.parse(model, asked["relaxation"]).words


def cycles_of(text: str | None) -> tuple[int | None, tuple[int, ...] | None]:
    """Read --cycle: the one cycle that is named, or the several that are ("all" names none)."""
    if text is None or text.strip().lower() == "all":
        return None, None if text is None else ()
    parts = text.split(",")
    if not all(part.strip().isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--cycle {text!r} must be a number from 1 up, several as 1,2,10, or all")
    numbers = tuple(int(part) for part in parts)
    return (None, numbers) if len(numbers) > 1 else (numbers[0], None)


def keywords_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords of `foamfit.fit` among the options of a command."""
    given = {way: options[way] for way in WAYS if options[way] not in (None, False)}
    if len(given) > 1:
        names = " and ".join(f"--{way}" for way in given)
        raise InputError(f"{names} exclude each other; choose one way to make the intervals")
    search = {name: one for name, one in options.items() if name not in (*OF_ONE_MODEL, *WAYS)}
    way, draws = next(iter(given.items()), ("auto", None))
    return search | {"intervals": way, "draws": None if draws is True else draws}


def fit_as_asked(
    test: Path,
    specimen: Path | None,
    options: Mapping[str, Any],
    begin: Callable[[float | None], AbstractContextManager[Progress]],
) -> FitResult | CycleFits:
    """Fit a test, or cycles of a record, as the options of the command say.

    `begin` is called when everything is read, before anything is simulated, with the time limit of
    the whole (s) if there is one; the fit reports to the `Progress` that it gives.
    """
    from foamfit.data.csv_file import read_test

    search = keywords_of(options)
    model = model_name(options)
    alone, several = cycles_of(options["cycle"])
    together = options.get("cycles")
    if together is not None and options["cycle"] is not None:
        raise InputError("give either --cycle or --cycles, not both")
    measurement = read_test(test, specimen, alone, cycles=together)
    for number in set(several or ()).difference(measurement.cycles):
        last = f"its cycles are {min(measurement.cycles)} to {max(measurement.cycles)}"
        raise InputError(f"--cycle {options['cycle']}: {test} has no cycle {number}; {last}")
    from foamfit import api
    from foamfit.one_model import Options

    Options(**search)  # refuses what is not admissible before anything is compiled
    params = _params(measurement, model, options)
    with begin(search["max_time"] if several is None else None) as news:  # it limits each cycle
        search |= {"progress": news.progress, "watch": news.watch, "tell": news.tell}
        if several is None:
            return api.fit(measurement, model=model, params=params, **search)
        from foamfit.study import cycles as study

        search["params"] = lambda one: _params(one, model, options)
        return study.fit_cycles(test, specimen, cycles=several or None, model=model, **search)


def _params(
    measurement: Measurement, model: str, options: Mapping[str, Any]
) -> lmfit.Parameters | None:
    """Return the parameters of a model as --fix and --vary want them; None for auto."""
    from foamfit.fitting.curves import check_time_shift, choose_drive
    from foamfit.fitting.problem import fix_and_vary, make_params

    drive, fix, vary = (options[name] for name in ("drive", "fix", "vary"))
    more = {name: options[name] for name in ("time_shift", "relaxation", *OPTIONS)}
    if options["time_shift"]:
        check_time_shift(measurement, drive or choose_drive(measurement))
    if model != "auto":
        return fix_and_vary(make_params(measurement, model, drive, **more), model, fix, vary)
    if fix or vary:
        raise InputError("--fix and --vary belong to one model; name it instead of --model auto")
    return None
