"""`foamfit.fit`: fit one model, or find the simplest model that describes the curves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack

import lmfit
import numpy as np
from lmfit import Minimizer
from lmfit.minimizer import MinimizerResult

from foamfit.arrays import single_threaded
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError
from foamfit.fitting.minimizer import minimizer_of, result_of
from foamfit.one_model import SEARCHED, Options, Progress, identify, judge, part_of
from foamfit.options import Keywords, documented
from foamfit.report.folder import Result, brief, write_result
from foamfit.report.plots import draw_panel
from foamfit.report.render import frame, readable
from foamfit.report.summary import misfit_words, misfits, summary_text
from foamfit.results import Fit
from foamfit.solve.precompile import compile_solver
from foamfit.springs.parameters import unit_of
from foamfit.trust.intervals import Announce

if TYPE_CHECKING:
    import pandas as pd
    import xarray
    from matplotlib.axes import Axes


class FitResult(Result, Fit):
    """Result of a fit: parameters, intervals, curves, status and warnings."""

    _kind = "fit.json"
    write, to_json_dict = write_result, Fit.to_json_dict

    def plot(self, ax: Axes | None = None, what: str = "stress-strain") -> Axes:
        """Plot one panel, measured and fitted, into `ax` or into a new figure.

        `what` is "stress-strain", "stress-time" or "displacement-time". Returns the axes.
        """
        return draw_panel(self, ax, what)

    @property
    def minimizer(self) -> Minimizer:
        """The residual of the fit for `lmfit.conf_interval(result.minimizer, result.lmfit)`."""
        return minimizer_of(self)

    @property
    def lmfit(self) -> MinimizerResult:
        """The numbers of the fit as lmfit's, for `lmfit.fit_report(result.lmfit)`.

        Parameters without a standard error are held.
        """
        return result_of(self)

    def text(self, *, verbose: bool = False) -> str:
        """Return one screen on the fit, or with `verbose` all of it."""
        return summary_text(self, verbose=verbose)

    def table(self) -> pd.DataFrame:
        """Return one row per parameter, in SI units; the output of its `to_latex` compiles."""
        return frame(self.parameters)

    @property
    def samples(self) -> xarray.Dataset | None:
        """Samples of `intervals="mcmc"` in ArviZ's layout, SI units; None without a chain.

        Raises InputError if xarray is not installed.
        """
        if not self.draws:
            return None
        try:
            import xarray
        except ImportError:
            why = 'samples need xarray, which is not installed; pip install "foamfit[mcmc]"'
            raise InputError(why) from None
        dims, about = ("chain", "draw"), {"test": self.measurement.name, "model": self.words}
        columns = {n: (dims, x, {"units": unit_of(n) or "1"}) for n, x in self.draws.items()}
        sizes = zip(dims, next(iter(self.draws.values())).shape, strict=True)
        return xarray.Dataset(columns, {dim: np.arange(size) for dim, size in sizes}, about)

    def __repr__(self) -> str:
        """Return status, model, misfit and parameters."""
        found = misfit_words(misfits(self)) or "–"
        line = f"{self.law}, {self.drive} drive · status {self.status} · misfit: {found}"
        rows = [readable(name, p) for name, p in self.parameters.items() if p.state != "fixed"]
        return brief(self.measurement.name, line, rows)


@documented
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
        Springs from the base up, joined by "+"; "auto" compares models and selects the simplest
        one that describes the curves.
    params : lmfit.Parameters, optional
        Values, bounds, fixed values and expressions; see `make_params`.
    progress : callable, optional
        Called with the completed fraction and the name of the current step.
    tell : callable, optional
        Called with the expected run time of the intervals before they are computed.
    **options
        The options of a fit; `foamfit.options` describes each of them.

    Returns
    -------
    FitResult
        The best point found so far if Ctrl-C or `max_time` ended the search.

    Raises
    ------
    TypeError
        If an option is unknown.
    InputError
        If the test cannot feed the drive or a parameter is unknown; the message names it.
    SimulationError
        If none of the trial parameters could be simulated.
    """
    if not isinstance(measurement, Measurement):
        why = f"measurement is a {type(measurement).__name__}; give what foamfit.read_test returns"
        raise InputError(why)
    if params is not None and not isinstance(params, lmfit.Parameters):
        raise InputError("params must be lmfit.Parameters, as foamfit.make_params returns them")
    chosen = Options.of("fit", options)
    progress, tell = progress or (lambda *_: None), tell or (lambda _: None)
    chosen.check(measurement, model, params)  # before anything is compiled
    compile_solver(model)
    if model == "auto":
        from foamfit.auto import compare_models

        found = compare_models(measurement, chosen, progress, tell)
    else:
        searched = identify(measurement, model, params, chosen, part_of(progress, 0.0, SEARCHED))
        found, _ = judge(searched, chosen.choice, tell, part_of(progress, SEARCHED, 1.0))
        progress(1.0, "done")
    stored = chosen.stored(measurement, model) if params is None else None
    return FitResult(**vars(found) | {"options": stored})
