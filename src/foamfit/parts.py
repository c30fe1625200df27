"""Parts of results: one identified parameter, the comparison of models, and models in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from foamfit.options import FREED
from foamfit.text import counted, listed

Pair = tuple[float, float]
_OF_JOINT = {"omitted": True}  # fields that only files of joint fits contain; see `codec.plain`


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified parameter, in SI.

    `stderr` and `ci95` are None where the test does not determine the parameter; `state` is
    "determined", "weak", "not determined" or "fixed" (by the user or the model), and `why` gives
    the reason in a sentence. `ci95_method` is the source of the interval: "local covariance",
    "profile likelihood", "MCMC" or "other minima" (minima of the search that different noise could
    have made the best). `range` includes model error: the values that fit almost equally well; None
    where the residuals are noise. `systematic` is one standard deviation from the ± of height,
    area, mass and calibration in the TOML; `stderr` and `ci95` do not include it. It is 0 where no
    ± is stated or the test does not determine the parameter, and None in a joint fit.

    The other fields are None in the fit of one test. `kind` is one of `options.KINDS` or "fixed".
    `value` is then the common value: for a scattering parameter that of the median specimen, for a
    rate law that at the rate of the median test, for an own parameter the median over the tests,
    which has neither error nor state. `tests` contains the value in each test, unless it is the
    same in all. `scatter` is the standard deviation of its logarithm between specimens, `b` the
    slope of the rate law. `range` and `b_range` include the scatter of specimens
    (`foamfit.study.joint_fit.ranges_of`).
    """

    value: float
    stderr: float | None = None
    ci95: Pair | None = None
    unit: str = ""
    vary: bool = True
    state: str = ""
    why: str = ""
    ci95_method: str | None = None
    range: Pair | None = None
    systematic: float | None = 0.0
    kind: str | None = field(default=None, metadata=_OF_JOINT)
    tests: Mapping[str, ParameterEstimate] | None = field(default=None, metadata=_OF_JOINT)
    scatter: float | None = field(default=None, metadata=_OF_JOINT)
    scatter_stderr: float | None = field(default=None, metadata=_OF_JOINT)
    scatter_ci95: Pair | None = field(default=None, metadata=_OF_JOINT)
    b: float | None = field(default=None, metadata=_OF_JOINT)
    b_stderr: float | None = field(default=None, metadata=_OF_JOINT)
    b_ci95: Pair | None = field(default=None, metadata=_OF_JOINT)
    b_range: Pair | None = field(default=None, metadata=_OF_JOINT)

    def counted_from(self, zero: float) -> ParameterEstimate:
        """Shift value, interval and range to another zero."""
        pairs = (self.ci95, self.range)
        ci95, span = (pair and (pair[0] - zero, pair[1] - zero) for pair in pairs)
        return replace(self, value=self.value - zero, ci95=ci95, range=span)

    def in_test(self, test: str) -> ParameterEstimate:
        """Return the parameter of one test of a joint fit."""
        if self.tests is not None:  # older versions wrote no unit there
            return replace(self.tests[test], unit=self.unit)
        missing: Any = {one.name: None for one in fields(self) if "omitted" in one.metadata}
        return replace(self, **missing)


def covered(seen: tuple[str, ...]) -> tuple[str, ...]:
    """Return the branches about which visits to `seen` carry information.

    On the reversible branch of a microscale spring some micro-springs snap through as well.
    """
    return (*seen, "snap-through") if "reversible" in seen else seen


def law_in_words(model: str, relaxation: int = 0, damping: str = "none") -> str:
    """Describe a model, the parameters that its options free, its relaxation and damping in words.

    `damping` is "with", "without" or, where it goes without saying, "none".
    """
    from foamfit.springs.model import Model  # drawing needs no compiler

    words, more = model, list[str]()
    if model != "auto":
        parsed = Model.parse(model)
        options = (name for name, is_set in parsed.options.items() if is_set)
        words, more = parsed.words, [one for name in options for one in FREED[name]]
    if relaxation:
        more.append("relaxation" if relaxation == 1 else counted(relaxation, "relaxation term"))
    more += ["damping"] * (damping == "with")
    words += f" with {listed(more)}" if more else ""
    return f"{words}{',' * bool(more)} without damping" if damping == "without" else words


@dataclass(frozen=True)
class Rung:
    """One model of the comparison and the evidence for it."""

    model: str  # springs from the base up
    # "with", "without" (every dashpot fixed at zero) or "none" (no dashpot to vary in this drive)
    damping: str
    misfit: dict[str, float | None]  # as `Fit.misfit`
    chisqr: float  # sum of the squared residuals
    n_vary: int  # number of varied parameters
    rank: int  # number of their combinations that the curves fix, used in AICc and BIC
    n_eff: float  # effective samples by its own residuals; AICc and BIC use `Ladder.n_eff`
    aicc: float  # infinite with too few effective samples for the number of parameters
    bic: float
    runs_p: float  # p-value of the runs test, which uses the signs of the residuals
    neighbours_p: float  # p-value of the neighbours test, which also uses their sizes
    # Parameters in these states; from the 95 % intervals alone unless this model was chosen
    not_determined: tuple[str, ...]
    weak: tuple[str, ...]
    seconds: float  # run time
    stopped: str | None  # what ended the search early
    chosen: bool  # whether the result is from this model
    why: str  # why it was chosen or not
    relaxation: int = 0  # terms of each hysteretic spring
    # RMS over range of held-out samples (cross-validation in blocks); None if time ran out
    predicted_misfit: float | None = None
    gain: float | None = None  # its relative reduction against `gain_over`, if any
    # The best earlier model with no more parameters; None for the first
    gain_over: str | None = None

    @property
    def name(self) -> str:
        """Model, relaxation and damping in words."""
        return law_in_words(self.model, self.relaxation, self.damping)


@dataclass(frozen=True)
class Ladder:
    """Comparison of several models."""

    rungs: tuple[Rung, ...]  # in the order of the trials, from the simplest up
    n_eff: float  # effective samples in AICc and BIC
    noise_from: str  # the model of the least chi-square, whose residuals are taken as noise
    ended: str  # why the comparison ended
    stopped: str | None  # "the time limit" or "Ctrl-C" if that ended it
    skipped: tuple[str, ...]  # models that could not be tried, and why
    sentences: tuple[str, ...]  # conclusions
    cautions: tuple[str, ...]  # the conclusions that are warnings
    # Whether predictions decide (no model reaches the noise) instead of AICc and BIC
    by_prediction: bool = False

    @property
    def chosen(self) -> Rung:
        """The model of the result."""
        return next(rung for rung in self.rungs if rung.chosen)


class OfLaw:
    """A result that has a model and the number of relaxation terms of its springs."""

    model: str
    relaxation: int

    @property
    def law(self) -> str:
        """The model and its relaxation in words."""
        return law_in_words(self.model, self.relaxation)
