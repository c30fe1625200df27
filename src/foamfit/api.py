"""The public fit: of one model, or of the simplest that follows the curves."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import lmfit

from foamfit.arrays import single_threaded
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError
from foamfit.one_model import SEARCHED, Keywords, Options, Progress, identify, judge
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import save_whole, write_result
from foamfit.report.plots import draw_panel
from foamfit.report.readable import readable
from foamfit.report.result_figures import Mapped
from foamfit.report.samples import dataset
from foamfit.report.shown import Shown, brief
from foamfit.report.summary import compared
from foamfit.report.tables import frame
from foamfit.results import Fit
from foamfit.solve.precompile import at_first_use
from foamfit.springs.model import Model
from foamfit.text import percent
from foamfit.trust.intervals import Announce

if TYPE_CHECKING:
    import pandas as pd
    import xarray
    from matplotlib.axes import Axes


class FitResult(Shown, Fit):
    """The result of a fit: parameters, intervals, curves and verdict."""

    def plot(self, ax: Axes | None = None, what: str = "stress-strain") -> Axes:
        """Draw a panel, measured and fitted, into axes or into those of a new figure.

        `what` is "stress-strain", "stress-time" or "displacement-time". Returns the axes.
        """
        return draw_panel(self, ax, what)

    def table(self) -> pd.DataFrame:
        """Return a row for each parameter, SI; the LaTeX of its `to_latex` compiles."""
        return frame(self.parameters)

    @property
    def samples(self) -> xarray.Dataset | None:
        """Samples of `intervals="mcmc"` as ArviZ takes them, SI; None if no chain was made.

        InputError if xarray is not installed.
        """
        about = {"test": self.measurement.name, "model": self.words}
        return dataset(self.draws, **about) if self.draws else None

    def _shown(self, *, html: bool = False) -> str:
        """Return status, model, misfit and parameters."""
        told = ", ".join(f"{name} {percent(off)}" for name, off in compared(self).items())
        line = f"{self.law}, {self.drive} drive · status {self.status} · misfit: {told or '–'}"
        rows = [readable(name, p) for name, p in self.parameters.items() if p.state != "fixed"]
        return brief(self.measurement.name, line, rows, html)

    def save(
        self,
        folder: str | Path,
        *,
        report: bool = True,
        figure_width: str = TWO,
        mapped: Mapped = map,
    ) -> Path:
        """Write the result folder whole, replacing an older one at the end; returns it.

        Without `report` it has neither report.html nor figures. Its figure is "one" or "two"
        columns wide, or as wide as a length ("85 mm"); with ", pdf" behind that all figures of the
        report are written as PDF too, with ", untitled" they have no title. `mapped` draws the
        figures, as the `map` of an executor does.
        """
        inches(figure_width)  # refuses what is no width
        drawn: Any = {"pages": report, "width": figure_width, "mapped": mapped}
        return save_whole(folder, partial(write_result, self, **drawn))


@single_threaded
def fit(
    measurement: Measurement,
    *,
    model: str = "bistable",
    params: lmfit.Parameters | None = None,
    progress: Progress | None = None,
    tell: Announce | None = None,
    **options: Unpack[Keywords],
) -> FitResult:
    """Identify the parameters of a chain of springs from a test.

    Parameters
    ----------
    measurement : Measurement
        The test; see `foamfit.read_test`.
    model : str
        Springs from the base up, joined by "+"; "auto" compares models and takes the simplest
        that holds.
    params : lmfit.Parameters, optional
        Values, bounds, fixed values and expressions; see `make_params`.
    progress : callable, optional
        Called with the fraction done and the current step.
    tell : callable, optional
        Called with the expected run time of the intervals before they are computed.
    drive : str, optional
        "impact", "stress" or "displacement"; by default what the test allows, in this order:
        impact, displacement.
    seed : int
        Same test and seed give the same numbers.
    starts : int, optional
        Descents of the search; by default 16 for each spring, 48 if several are hysteretic.
    max_time : float, optional
        Seconds after which the best point so far is the result.
    weights : mapping, optional
        Weight of each curve, by its name in `FitResult.misfit`.
    interior_mass : bool
        Whether the specimen's mass is placed between the springs of a chain, in equal parts. By
        default it is neglected, and the notes of the result say what it would change.
    time_shift : bool
        Whether to fit how late the motion is against the force, as the parameter time_shift (s).
    relaxation : int
        Relaxation terms of every bistable and microscale spring: s1_g1, s1_tau1, …; model="auto"
        tries one term by itself and refuses this.
    stiffening : bool
        Whether branch a of every microscale spring stiffens as the test says: s1_stiffening.
    mullins : bool
        Whether what has snapped once softens and weakens: s1_softening, s1_weakening.
    intervals : str
        Method of the 95 % intervals: "auto" (local covariance, and profiles of the parameters
        along which the cost is not parabolic and whose range is not wider), "local", "profile" or
        "mcmc".
    draws : int, optional
        Steps of the Markov chain, by default 2000.
    priors : mapping, optional
        What is known of parameters of the springs before the fit: mean and standard deviation of a
        normal distribution, (5.5e6, 1e5) in SI or "5.5 ± 0.1 MPa". Each counts as one residual.
        [priors] of the TOML are used too.
    watch : callable, optional
        Called with the problem and the best parameters so far whenever these improve; it must be
        quick.
    fix : mapping, optional
        Parameters to hold at a value (SI), where `params` is not given.
    vary : sequence of str
        Names of parameters to vary though they are held by default.

    Returns
    -------
    FitResult
        If Ctrl-C or `max_time` ended the search, that of the best point found.

    Raises
    ------
    TypeError
        If an option is unknown.
    InputError
        If the test cannot feed the drive or a parameter is unknown; the message names it.
    SimulationError
        If no trial could be simulated.
    """
    if not isinstance(measurement, Measurement):
        raise InputError(
            f"measurement is a {type(measurement).__name__}; give what foamfit.read_test returns"
        )
    if params is not None and not isinstance(params, lmfit.Parameters):
        raise InputError("params must be lmfit.Parameters, as foamfit.make_params returns them")
    chosen = Options.of("fit", options)
    progress, tell = progress or (lambda *_: None), tell or (lambda _: None)
    if model == "auto":
        chosen.check_auto(params=params is not None, priors=measurement.priors)
    else:
        Model.parse(model, chosen.relaxation)
    with at_first_use(model, chosen.relaxation) as compile_rest:

        def part(begin: float, end: float) -> Progress:
            """Progress of a part of the work, between these shares of the whole."""

            def shown(share: float, what: str) -> None:
                compile_rest()  # before the first trial, after what is wrong was refused
                progress(begin + (end - begin) * share, what)

            return shown

        if model == "auto":
            from foamfit.auto import compare_models

            return FitResult(**vars(compare_models(measurement, chosen, part(0.0, 1.0), tell)))
        searched = identify(measurement, model, params, chosen, part(0.0, SEARCHED))
        found, _ = judge(searched, chosen.choice, tell, part(SEARCHED, 1.0))
        progress(1.0, "done")
        return FitResult(**vars(found))
