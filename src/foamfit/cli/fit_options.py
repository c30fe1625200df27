"""The options that say how a test is fitted, for every command that fits."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from foamfit.cli.options import DRIVE, RELAXATION
from foamfit.errors import InputError

if TYPE_CHECKING:
    import lmfit

    from foamfit.data.measurement import Measurement


def _fixes(
    context: click.Context, option: click.Parameter, values: tuple[str, ...]
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


_OPTIONS = (
    click.option(
        "--model",
        default="bistable",
        show_default=True,
        help="Springs from the base up; auto compares models, takes the simplest that holds.",
    ),
    DRIVE,
    click.option(
        "--seed",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Same test and seed, same numbers.",
    ),
    click.option(
        "--starts",
        type=click.IntRange(min=1),
        help="Descents of the search. Default: 16 per spring, 48 if several are hysteretic.",
    ),
    click.option(
        "--max-time", type=float, metavar="SECONDS", help="Then the best so far is taken."
    ),
    click.option(
        "--fix", multiple=True, metavar="NAME=VALUE", callback=_fixes, help="Hold one (SI)."
    ),
    click.option("--vary", multiple=True, metavar="NAME", help="Vary one that is held by default."),
    click.option(
        "--interior-mass", is_flag=True, help="Put the specimen's mass between the springs."
    ),
    click.option(
        "--time-shift", is_flag=True, help="Fit how late the motion is against the force."
    ),
    RELAXATION,
    click.option(
        "--loss",
        type=click.Choice(["linear", "soft_l1", "huber", "cauchy"]),
        default="linear",
        show_default=True,
        help="All but linear weigh large residuals less.",
    ),
    click.option("--profile", is_flag=True, help="95 % intervals by profile likelihood."),
    click.option(
        "--bootstrap",
        type=int,
        metavar="N",
        help="95 % intervals by N >= 40 refits to resampled blocks.",
    ),
    click.option("--mcmc", type=int, metavar="N", help="95 % intervals by N steps of emcee."),
)


def fit_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add them to a command: model, fix and vary, and the keywords of `foamfit.fit`."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def params_of(
    measurement: Measurement, model: str, search: dict[str, Any],
    fix: dict[str, float], vary: tuple[str, ...],
) -> lmfit.Parameters | None:  # fmt: skip
    """Return the parameters of a model as --fix and --vary want them; None for auto."""
    from foamfit.fitting.curves import check_time_shift, choose_drive
    from foamfit.fitting.problem import fix_and_vary, make_params

    drive, time_shift = search["drive"], search["time_shift"]
    if time_shift:
        check_time_shift(measurement, drive or choose_drive(measurement))
    if model == "auto":
        if fix or vary:
            raise InputError(
                "--fix and --vary belong to one model; name it instead of --model auto"
            )
        return None
    params = make_params(
        measurement, model, drive, time_shift=time_shift, relaxation=search["relaxation"]
    )
    return fix_and_vary(params, model, fix, vary)


def intervals_of(profile: bool, bootstrap: int | None, mcmc: int | None) -> dict[str, Any]:
    """Return the way of making intervals that --profile, --bootstrap or --mcmc names."""
    given = {"profile": profile or None, "bootstrap": bootstrap, "mcmc": mcmc}
    ways = [name for name, value in given.items() if value is not None]
    if len(ways) > 1:
        names = " and ".join(f"--{name}" for name in ways)
        raise InputError(f"{names} exclude each other; choose one way to make the intervals")
    draws = mcmc if bootstrap is None else bootstrap
    return {"intervals": ways[0] if ways else "auto", "draws": draws}
