"""The simplest model that holds: a climb from one spring to several, and the evidence for each.

A ladder of models is fitted from the simplest up, each without damping and then with it. What is
compared are AICc and BIC with the effective number of samples and the effective number of
parameters, so that neither correlated residuals nor combinations that the curves do not fix count
as evidence. The climb ends where the residuals are structureless, or where two steps in a row bring
no evidence.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import lmfit

from foamfit import one_model
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.objective import choose_drive
from foamfit.fitting.problem import make_params
from foamfit.one_model import Found, Options, Progress, Tell
from foamfit.results import FitResult
from foamfit.springs.model import Model
from foamfit.springs.parameters import split_name
from foamfit.trust.evidence import (
    MARGIN,
    Evidence,
    Tried,
    choose,
    effective_samples,
    least,
    reference_of,
    rung_name,
    weigh,
)
from foamfit.trust.intervals import Choice
from foamfit.trust.residual_tests import BENT, find_structure, neighbours_test, runs_test

# From the simplest up. More springs have more parameters (23 and more) than a loop has features,
# and take minutes.
LADDER = ("bistable", "linear+bistable", "bistable+bistable", "linear+bistable+bistable")
# Steps up the ladder in a row without evidence after which it ends.
PATIENCE = 2


@dataclass(frozen=True)
class Rung:
    """One model of the ladder and the evidence for it.

    Attributes
    ----------
    model : str
        Springs from the base up.
    damping : str
        "with", "without" (every dashpot held at zero) or "none" where the drive has none to vary.
    misfit : dict
        As `FitResult.misfit`.
    chisqr : float
        Sum of the squared residuals.
    n_vary : int
        Parameters that were varied.
    rank : int
        How many combinations of them the curves fix: what AICc and BIC count.
    n_eff : float
        Effective samples by its own residuals. AICc and BIC use `Ladder.n_eff`, one for all.
    aicc, bic : float
        Infinite where there are too few effective samples for so many parameters.
    runs_p : float
        p-value of the runs test: the chance that noise without structure has as few runs.
    neighbours_p : float
        p-value of the neighbours test: the same by size, where the runs test goes by sign.
    not_determined, weak : tuple of str
        Names of the parameters in these states.
    seconds : float
        Run time.
    stopped : str or None
        What ended the search before its time.
    chosen : bool
        Whether the result is that of this rung.
    why : str
        Why it was chosen or not.
    """

    model: str
    damping: str
    misfit: dict[str, float | None]
    chisqr: float
    n_vary: int
    rank: int
    n_eff: float
    aicc: float
    bic: float
    runs_p: float
    neighbours_p: float
    not_determined: tuple[str, ...]
    weak: tuple[str, ...]
    seconds: float
    stopped: str | None
    chosen: bool
    why: str

    @property
    def name(self) -> str:
        """Model and damping in words."""
        return rung_name(self.model, self.damping)


@dataclass(frozen=True)
class Ladder:
    """The rungs that were tried, and what the comparison says.

    Attributes
    ----------
    rungs : tuple of Rung
        From the simplest up.
    n_eff : float
        Effective samples that AICc and BIC use.
    noise_from : str
        The rung of the least chi-square: its residuals are taken for the noise.
    ended : str
        Why the climb ended.
    stopped : str or None
        "the time limit" or "Ctrl-C" if that ended it.
    skipped : tuple of str
        Rungs that could not be tried, and why.
    sentences : tuple of str
        What the comparison says.
    cautions : tuple of str
        Those of them that are warnings.
    """

    rungs: tuple[Rung, ...]
    n_eff: float
    noise_from: str
    ended: str
    stopped: str | None
    skipped: tuple[str, ...]
    sentences: tuple[str, ...]
    cautions: tuple[str, ...]

    @property
    def chosen(self) -> Rung:
        """The rung whose result was taken."""
        return next(rung for rung in self.rungs if rung.chosen)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of `ladder` in fit.json."""
        return asdict(self)

    def rows(self) -> Iterator[list[object]]:
        """Rows of ladder.csv, the header first; a list of names is joined by blanks."""
        curves = [
            name
            for name in self.rungs[0].misfit
            if any(rung.misfit.get(name) is not None for rung in self.rungs)
        ]
        rest = [name for name in Rung.__dataclass_fields__ if name not in ("model", "misfit")]
        yield ["model", "damping", *(f"misfit_{name}" for name in curves), *rest[1:]]
        for rung in self.rungs:
            cells = [getattr(rung, name) for name in rest]
            plain = [" ".join(cell) if isinstance(cell, tuple) else cell for cell in cells]
            finite = [
                None if isinstance(cell, float) and not math.isfinite(cell) else cell
                for cell in plain
            ]
            misfits = [rung.misfit.get(name) for name in curves]
            yield [rung.model, finite[0], *misfits, *finite[1:]]


def _dampers(params: lmfit.Parameters) -> list[str]:
    """Names of the dampers that vary."""
    return [name for name in params if split_name(name)[1] == "eta" and params[name].vary]


def _carry(params: lmfit.Parameters, model: Model, below: FitResult | None) -> None:
    """Start from the springs of the rung below, the top one first; in place.

    A new linear spring starts short and stiff, so that the chain does what it did below.
    """
    if below is None:
        return
    if "time_shift" in params:
        params["time_shift"].value = below.params["time_shift"].value
    was = Model.parse(below.model)
    sources: dict[int, int] = {}
    for spring in reversed(range(len(model.kinds))):
        left = len(was.kinds) - 1 - len(sources)
        if left >= 0 and model.kinds[spring] == was.kinds[left]:
            sources[spring] = left
    for name in model.names:
        spring, short = split_name(name)
        source = "site_eta" if spring < 0 else f"s{sources.get(spring, -1) + 1}_{short}"
        if not params[name].vary:
            continue
        if source in below.params:
            params[name].value = below.params[source].value
        elif spring not in sources and model.kinds[spring] == "linear":
            end = params[name].min if short == "height" else 0.1 * params[name].max
            params[name].value = end


# ---------------------------------------------------------------- the climb


def climb(measurement: Measurement, options: Options, progress: Progress, tell: Tell) -> FitResult:
    """Fit ever richer models until one holds; this is `foamfit.fit` with model="auto".

    The time limit is that of all rungs together. The time limit and Ctrl-C keep what is done. Rungs
    have local intervals; those that were asked for are made of the chosen one.

    Returns
    -------
    FitResult
        That of the chosen rung, with its `ladder`.

    Raises
    ------
    InputError, SimulationError
        As `foamfit.fit`, if not one rung could be tried.
    """
    drive = choose_drive(measurement) if options.drive is None else options.drive
    deadline = None if options.max_time is None else time.monotonic() + options.max_time
    state = _Climb(
        measurement, drive, replace(options, drive=drive), progress, time.perf_counter(), deadline
    )
    models, skipped = _models(measurement)
    tried: list[Tried] = []
    ended, stopped, idle = "the top of the ladder was reached", None, 0
    try:
        for model in models:
            below = len(tried)
            family = state.family(model, models, tried, skipped)
            if state.stopped:
                break
            if any(one.structureless for one in family):
                ended = "the residuals are structureless"
                break
            idle = 0 if _speaks(tried, below) else idle + 1
            if idle == PATIENCE:
                ended = f"{PATIENCE} steps in a row brought no evidence"
                break
        stopped = state.stopped
    except KeyboardInterrupt:
        if not tried:
            raise
        stopped = "Ctrl-C"
    if not tried:
        raise SimulationError(f"{measurement.name}: no rung could be tried: {'; '.join(skipped)}")
    if stopped is None and options.choice.method != "local":
        best = choose(tried)[0]
        tried[best] = state.reassessed(best, tried[best], tell)
    state.progress(1.0, "done")
    ended = f"it was stopped by {stopped}" if stopped else ended
    return _conclude(tried, ended, stopped, tuple(skipped), time.perf_counter() - state.began)


def _speaks(tried: Sequence[Tried], below: int) -> bool:
    """Whether AICc or BIC speaks strongly for one of the last rungs against all below them."""
    if not 0 < below < len(tried):
        return len(tried) > below
    found = choose(tried)[1]
    return any(
        min(getattr(one, name) for one in found[below:])
        < min(getattr(one, name) for one in found[:below]) - MARGIN
        for name in ("aicc", "bic")
    )


@dataclass(eq=False)
class _Climb:
    """What every rung is fitted with, and what stopped the climb."""

    measurement: Measurement
    drive: str
    options: Options
    progress: Progress
    began: float
    deadline: float | None
    stopped: str | None = None
    fits: list[Found] = field(default_factory=list)  # of what was tried, in its order

    def family(
        self, model: str, models: Sequence[str], tried: list[Tried], skipped: list[str]
    ) -> list[Tried]:
        """Fit one model without damping and, unless that is enough, with it.

        What is fitted is added to `tried` at once.
        """
        params = self.params(model)
        dampings = ("without", "with") if _dampers(params) else ("none",)
        family: list[Tried] = []
        for i, damping in enumerate(dampings):
            left = None if self.deadline is None else self.deadline - time.monotonic()
            if left is not None and left <= 0.0 and tried:
                self.stopped = "the time limit"
                break
            if left is not None:
                left = max(left, 1e-6)
            below = family[-1] if family else tried[choose(tried)[0]] if tried else None
            share = (models.index(model) + i / len(dampings)) / len(models)
            try:
                found, one = self.rung(model, damping, below, left, share)
            except SimulationError as error:
                skipped.append(f"{rung_name(model, damping)}: {error}")
                continue
            family.append(one)
            tried.append(one)
            self.fits.append(found)
            self.stopped = one.result.stopped
            if self.stopped is not None or one.structureless:
                break
        return family

    def params(self, model: str) -> lmfit.Parameters:
        """Parameters of a model, as they are by default."""
        shift = self.options.time_shift
        return make_params(self.measurement, model, self.drive, time_shift=shift)

    def rung(
        self, model: str, damping: str, below: Tried | None, left: float | None, share: float
    ) -> tuple[Found, Tried]:
        """Fit one rung."""
        began = time.perf_counter()
        params = self.params(model)
        _carry(params, Model.parse(model), None if below is None else below.result)
        if damping == "without":
            for name in _dampers(params):
                params[name].set(value=0.0, vary=False)
        label = rung_name(model, damping)
        found = one_model.identify(
            self.measurement,
            model,
            params,
            replace(self.options, max_time=left),
            lambda done, what: self.progress(share + 0.1 * done, f"{label}: {what}"),
        )
        result = one_model.judge(found, Choice("local"), lambda _: None)
        return found, weigh(found.problem, result, damping, time.perf_counter() - began)

    def reassessed(self, at: int, one: Tried, tell: Tell) -> Tried:
        """Make the intervals that were asked for; of a better point that they meet, the weight."""
        result = one_model.judge(self.fits[at], self.options.choice, tell)
        return weigh(self.fits[at].problem, result, one.damping, one.seconds)


def _models(measurement: Measurement) -> tuple[list[str], list[str]]:
    """Models that a test allows, and which are left out and why.

    Heights that imaging gave are those of so many springs and no other number; a mass inside that
    was followed is data that every rung must have.
    """
    heights, inside = measurement.specimen.heights, max(measurement.interior, default=0)
    models, skipped = [], []
    for model in LADDER:
        count = len(Model.parse(model).kinds)
        if inside >= count:
            skipped.append(f"{model}: it has no mass {inside} inside, whose motion was measured")
        elif heights is not None and count not in (1, len(heights)):
            skipped.append(f"{model}: [specimen] heights are those of {len(heights)} springs")
        else:
            models.append(model)
    if not models:
        raise InputError(
            f"{measurement.name}: no model of the ladder fits this test: {'; '.join(skipped)}"
        )
    return models, skipped


# ---------------------------------------------------------------- what it says


def _conclude(
    tried: Sequence[Tried], ended: str, stopped: str | None, skipped: tuple[str, ...], took: float
) -> FitResult:
    """Result of the chosen rung with the whole ladder."""
    best, found = choose(tried)
    reference = reference_of(tried)
    rungs = tuple(
        _rung(one, ev, i == best, _why(i, best, tried, found))
        for i, (one, ev) in enumerate(zip(tried, found, strict=True))
    )
    sentences, cautions = _sentences(tried, found, best, ended, stopped)
    ladder = Ladder(
        rungs=rungs,
        n_eff=effective_samples(reference),
        noise_from=reference.name,
        ended=ended,
        stopped=stopped,
        skipped=skipped,
        sentences=(*sentences, *cautions),
        cautions=cautions,
    )
    result = tried[best].result
    status = "warnings" if cautions and result.status == "ok" else result.status
    return replace(
        result,
        status=status,
        warnings=(*cautions, *result.warnings),
        ladder=ladder,
        stopped=stopped or result.stopped,
        runtime_s=took,
    )


def _rung(one: Tried, found: Evidence, chosen: bool, why: str) -> Rung:
    return Rung(
        model=one.result.model,
        damping=one.damping,
        misfit=dict(one.result.misfit),
        chisqr=one.chisqr,
        n_vary=sum(item.vary for item in one.result.parameters.values()),
        rank=found.rank,
        n_eff=effective_samples(one),
        aicc=found.aicc,
        bic=found.bic,
        runs_p=one.runs_p,
        neighbours_p=one.neighbours_p,
        not_determined=one.states("not determined"),
        weak=one.states("weak"),
        seconds=one.seconds,
        stopped=one.result.stopped,
        chosen=chosen,
        why=why,
    )


def _why(i: int, best: int, tried: Sequence[Tried], found: Sequence[Evidence]) -> str:
    """Why a rung was chosen or not, in a phrase."""
    mine, taken = found[i], found[best]
    if i == best:
        noise = "its residuals are structureless" if tried[i].structureless else "best supported"
        if best == len(tried) - 1:
            return f"{noise}, and no richer rung was tried"
        return f"{noise}, and no richer rung lowers AICc and BIC by {MARGIN:g}"
    if i < best:
        return f"BIC {signed(mine.bic - taken.bic)}, AICc {signed(mine.aicc - taken.aicc)}"
    gains = [
        f"{name} {signed(off)}"
        for name, off in (("BIC", mine.bic - taken.bic), ("AICc", mine.aicc - taken.aicc))
        if not off < -MARGIN
    ]
    return f"richer without evidence: {', '.join(gains)}"


def signed(value: float) -> str:
    """Write a difference with its sign."""
    if not math.isfinite(value):  # too few effective samples for the correction of AICc
        return "not defined"
    return f"{value:+.1f}".replace("-", "−")


def p_value(p: float) -> str:
    """Write a p-value, with a sign: "= 0.43", "< 1e-6"."""
    if p < 1e-6:
        return "< 1e-6"
    return f"= {p:.2g}"


def _of(name: str, count: int) -> str:
    return f"Of {count} rungs {name}" if count > 1 else f"The first rung {name}"


def _sentences(
    tried: Sequence[Tried],
    found: Sequence[Evidence],
    best: int,
    ended: str,
    stopped: str | None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What the comparison says, and what it warns of."""
    one, mine = tried[best], found[best]
    taken = "is the simplest that holds" if one.structureless else "is what the evidence supports"
    said = [
        f"{_of(one.name, len(tried))} {taken} (runs test p {p_value(one.runs_p)}, neighbours "
        f"test p {p_value(one.neighbours_p)}); the climb ended because {ended}."
    ]
    warned = []
    varied = sum(item.vary for item in one.result.parameters.values())
    if mine.rank < varied:
        said.append(
            f"Of its {varied} parameters the curves fix {mine.rank} combinations; AICc and BIC "
            "count those."
        )
    for name, value in (("AICc", "aicc"), ("BIC", "bic")):
        other = least([getattr(one, value) for one in found])
        off = getattr(found[other], value) - getattr(mine, value)
        if off < -MARGIN:
            said.append(f"By {name} alone it would be {tried[other].name} ({signed(off)}).")
    if stopped is not None:
        warned.append(
            f"The ladder was stopped by {stopped} on {tried[-1].name}; richer models were not "
            "tried."
        )
    lost = one.states("not determined")
    if lost:
        warned.append(_undetermined(tried, found, best, lost))
    if not any(rung.structureless for rung in tried):
        warned.append(_remains(tried, best))
    return tuple(said), tuple(warned)


def _undetermined(
    tried: Sequence[Tried], found: Sequence[Evidence], best: int, lost: tuple[str, ...]
) -> str:
    """Sentence on the parameters of the chosen rung that the test does not determine."""
    sound = [i for i, one in enumerate(tried) if not one.states("not determined")]
    nearest = min(sound, key=lambda i: found[i].bic, default=None)
    other = "no rung of the ladder has all parameters determined"
    if nearest is not None:
        other = (
            f"{tried[nearest].name} has none such, at a BIC higher by "
            f"{found[nearest].bic - found[best].bic:.1f}"
        )
    return (
        f"The chosen model {tried[best].name} has parameters that the test does not determine "
        f"({', '.join(lost)}): the curves ask for its shape, not for these values; {other}."
    )


def _remains(tried: Sequence[Tried], best: int) -> str:
    """Sentence on the structure that no rung takes off, as the chosen one leaves it."""
    one = tried[best]
    which = least([min(runs_test(part), neighbours_test(part)) for part in one.curves])
    curve = one.counted[which]
    found = find_structure(one.curves[which], one.places[which])
    size, noise = found.size / one.spans[which], found.noise / one.spans[which]
    runs, near = (max(p) for p in zip(*((r.runs_p, r.neighbours_p) for r in tried), strict=True))
    told = (
        f"No rung reaches the noise (at best runs test p {p_value(runs)}, neighbours test p "
        f"{p_value(near)}): the residuals of {curve} hold a structure of {size:.2%} of the range "
        f"(neighbours scatter by {noise:.2%}), {found.share:.0%} of it on {found.place}"
    )
    if found.bent > BENT and found.straight:
        told += (
            f", where a parabola takes off {found.bent:.0%}: the curve is bent there where the law "
            "is a straight line, and a law with a curved branch would be needed to follow it"
        )
    return f"{told}."
