"""The simplest model that follows the curves, and the evidence for each that was tried.

A ladder of models is fitted from the simplest up, each without damping and then with it, and
compared by AICc and BIC with the effective numbers of samples and of parameters. It ends where the
residuals are structureless, or where two models in a row bring no evidence.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import lmfit
import numpy as np

from foamfit import one_model
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.curves import choose_drive
from foamfit.fitting.problem import make_params
from foamfit.one_model import Found, Options, Progress
from foamfit.results import Fit, Ladder, Rung, rung_name
from foamfit.springs.model import Model
from foamfit.springs.parameters import split_name
from foamfit.text import counted, percent
from foamfit.trust.evidence import MARGIN, Criteria, Tried, choose, effective_samples, reference_of
from foamfit.trust.intervals import Announce, Choice
from foamfit.trust.residual_tests import BENT, find_structure, neighbours_test, runs_test

# From the simplest up. More springs have more parameters (23 and more) than a loop has features,
# and take minutes.
LADDER = ("bistable", "linear+bistable", "bistable+bistable", "linear+bistable+bistable")
# So many models in a row without evidence end the comparison.
WITHOUT_EVIDENCE = 2


def _dampers(params: lmfit.Parameters) -> list[str]:
    """Names of the dampers that vary."""
    return [name for name in params if split_name(name)[1] == "eta" and params[name].vary]


def _carry(params: lmfit.Parameters, model: Model, below: Fit | None) -> None:
    """Start from the springs of the rung below, the top one first; in place.

    A new linear spring starts short and stiff, so that the chain does what it did below.
    """
    if below is None:
        return
    values, was = below.params.valuesdict(), list(Model.parse(below.model).kinds)
    if "time_shift" in params:
        params["time_shift"].value = values["time_shift"]
    sources: dict[int, int] = {}
    for spring in reversed(range(len(model.kinds))):
        if was and model.kinds[spring] == was[-1]:
            was.pop()
            sources[spring] = len(was)
    for name in model.names:
        spring, short = split_name(name)
        source = "site_eta" if spring < 0 else f"s{sources.get(spring, -1) + 1}_{short}"
        if not params[name].vary:
            continue
        if source in values:
            params[name].value = values[source]
        elif spring not in sources and model.kinds[spring] == "linear":
            params[name].value = params[name].min if short == "height" else 0.1 * params[name].max


# ---------------------------------------------------------------- the comparison


def compare_models(
    measurement: Measurement, options: Options, progress: Progress, announce: Announce
) -> Fit:
    """Fit ever richer models until one holds; this is `foamfit.fit` with model="auto".

    The time limit is that of all rungs together; it and Ctrl-C keep what is done. Rungs have local
    intervals; those that were asked for are made of the chosen one.
    """
    state = _Comparison(measurement, options, progress)
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
            idle = 0 if _has_evidence(tried, below) else idle + 1
            if idle == WITHOUT_EVIDENCE:
                ended = f"{WITHOUT_EVIDENCE} models in a row brought no evidence"
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
        result, point = one_model.judge(state.fits[best], options.choice, announce)
        tried[best] = replace(tried[best], result=result, best=point)  # it may be a better point
    progress(1.0, "done")
    ended = f"it was stopped by {stopped}" if stopped else ended
    return _conclude(tried, ended, stopped, tuple(skipped), time.perf_counter() - state.began)


def _has_evidence(tried: Sequence[Tried], below: int) -> bool:
    """Whether AICc or BIC strongly prefers one of the last rungs to all below them."""
    if not 0 < below < len(tried):
        return len(tried) > below
    found = choose(tried)[1]
    return any(
        min(values[below:]) < min(values[:below]) - MARGIN
        for values in ([one.aicc for one in found], [one.bic for one in found])
    )


@dataclass(eq=False)
class _Comparison:
    """What every rung is fitted with, and what stopped the comparison."""

    measurement: Measurement
    options: Options
    progress: Progress
    stopped: str | None = None
    fits: list[Found] = field(default_factory=list)  # of what was tried, in its order

    def __post_init__(self) -> None:
        """Choose the drive and begin."""
        self.began, limit = time.perf_counter(), self.options.max_time
        self.deadline = None if limit is None else time.monotonic() + limit
        if self.options.drive is None:
            self.options = replace(self.options, drive=choose_drive(self.measurement))

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
            left = None if self.deadline is None else max(self.deadline - time.monotonic(), 1e-6)
            if left == 1e-6 and tried:
                self.stopped = "the time limit"
                break
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
        options = self.options
        return make_params(self.measurement, model, options.drive, time_shift=options.time_shift)

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
        result, best = one_model.judge(found, Choice("local"), lambda _: None)
        return found, Tried(result, damping, best, time.perf_counter() - began)


def _models(measurement: Measurement) -> tuple[list[str], list[str]]:
    """Models that a test allows, and which are left out and why.

    They have as many springs as heights were given, or one, and every mass that was followed.
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
) -> Fit:
    """Result of the chosen rung with the whole ladder."""
    best, found = choose(tried)
    reference, result = reference_of(tried), tried[best].result
    said, warned = _choice_sentences(tried, found, best, ended), []
    if stopped is not None:
        warned.append(
            f"The comparison was stopped by {stopped} on {tried[-1].name}; richer models were not "
            "tried."
        )
    if tried[best].states("not determined"):
        warned.append(_undetermined(tried, found, best))
    if not any(rung.structureless for rung in tried):
        warned.append(_structure_left(tried, best))
    ladder = Ladder(
        rungs=tuple(_rung(i, best, tried, found) for i in range(len(tried))),
        n_eff=effective_samples(reference),
        noise_from=reference.name,
        ended=ended,
        stopped=stopped,
        skipped=skipped,
        sentences=(*said, *warned),
        cautions=tuple(warned),
    )
    return replace(
        result,
        status="warnings" if warned and result.status == "ok" else result.status,
        warnings=(*warned, *result.warnings),
        ladder=ladder,
        stopped=stopped or result.stopped,
        runtime_s=took,
    )


def _rung(i: int, best: int, tried: Sequence[Tried], found: Sequence[Criteria]) -> Rung:
    one = tried[i]
    return Rung(
        model=one.result.model,
        damping=one.damping,
        misfit=dict(one.result.misfit),
        chisqr=one.chisqr,
        n_vary=one.varied,
        rank=found[i].rank,
        n_eff=effective_samples(one),
        aicc=found[i].aicc,
        bic=found[i].bic,
        runs_p=one.runs_p,
        neighbours_p=one.neighbours_p,
        not_determined=one.states("not determined"),
        weak=one.states("weak"),
        seconds=one.seconds,
        stopped=one.result.stopped,
        chosen=i == best,
        why=_why(i, best, tried, found),
    )


def _why(i: int, best: int, tried: Sequence[Tried], found: Sequence[Criteria]) -> str:
    """Why a rung was chosen or not."""
    if i == best:
        reason = "its residuals are structureless" if tried[i].structureless else "best supported"
        richer = f"lowers AICc and BIC by {MARGIN:g}" if i < len(tried) - 1 else "was tried"
        return f"{reason}, and no richer model {richer}"
    bic, aicc = found[i].bic - found[best].bic, found[i].aicc - found[best].aicc
    told = f"BIC {signed(bic)}, AICc {signed(aicc)}"
    return told if i < best else f"richer without evidence: {told}"


def signed(value: float) -> str:
    """Write a difference with its sign."""
    if not math.isfinite(value):  # too few effective samples for the correction of AICc
        return "not defined"
    return f"{value:+.1f}".replace("-", "−")


def _choice_sentences(
    tried: Sequence[Tried], found: Sequence[Criteria], best: int, ended: str
) -> list[str]:
    """What was chosen, and what each criterion alone would choose."""
    one = tried[best]
    simplest = "it is the simplest whose residuals are structureless"
    reason = simplest if one.structureless else "the evidence supports it best"
    said = [
        f"{one.name} was chosen of {counted(len(tried), 'model')}: {reason}. No more models were "
        f"tried because {ended}."
    ]
    if found[best].rank < one.varied:
        said.append(
            f"The curves fix {found[best].rank} combinations of its {one.varied} parameters; AICc "
            "and BIC count those."
        )
    for name, values in (("AICc", [one.aicc for one in found]), ("BIC", [c.bic for c in found])):
        least = int(np.argmin(values))
        off = values[least] - values[best]
        if off < -MARGIN:
            said.append(f"{name} alone would choose {tried[least].name} ({signed(off)}).")
    return said


def _undetermined(tried: Sequence[Tried], found: Sequence[Criteria], best: int) -> str:
    """Sentence on the parameters of the chosen rung that the test does not determine."""
    lost = ", ".join(tried[best].states("not determined"))
    told = f"The test does not determine {lost} of the chosen model {tried[best].name}"
    sound = [i for i, one in enumerate(tried) if not one.states("not determined")]
    if not sound:
        return f"{told}; no model of the ladder has all parameters determined."
    nearest = min(sound, key=lambda i: found[i].bic)
    off = found[nearest].bic - found[best].bic
    return f"{told}; all of {tried[nearest].name} are determined, at a BIC higher by {off:.1f}."


def _structure_left(tried: Sequence[Tried], best: int) -> str:
    """Sentence on the structure in the residuals of the chosen rung."""
    one = tried[best]
    worst = int(np.argmin([min(runs_test(part), neighbours_test(part)) for part in one.curves]))
    found = find_structure(one.curves[worst], one.places[worst])
    size, noise = found.size / one.spans[worst], found.noise / one.spans[worst]
    told = (
        f"No model reaches the noise: the residuals of {one.counted[worst]} have a structure of "
        f"{percent(size)} of the range (noise {percent(noise)}), {percent(found.share)} of it on "
        f"{found.place}."
    )
    if found.bent > BENT and found.straight:
        told += " The measured branch is curved where the law is a straight line."
    return told
