"""The simplest model that follows the curves, and the evidence for each that was tried.

Models are fitted from the simplest up, each without damping and then with it. If one of them
reaches the noise, AICc and BIC compare them, with the effective numbers of samples and parameters;
otherwise their predictions of samples that were held back do (`trust.evidence`). The comparison
ends where the residuals are random, or where two groups of models in a row bring no gain.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import lmfit
import numpy as np

from foamfit import one_model, text
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.box import is_share
from foamfit.fitting.curves import choose_drive
from foamfit.fitting.problem import make_params
from foamfit.fitting.search import SearchStoppedError, what_stopped
from foamfit.one_model import Found, Options, Progress
from foamfit.results import Fit, Ladder, Rung, rung_name
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, split_name
from foamfit.text import counted, percent
from foamfit.trust import evidence
from foamfit.trust.best_point import BestPoint
from foamfit.trust.checklist import input_first
from foamfit.trust.evidence import MARGIN, SHARE, Tried
from foamfit.trust.intervals import Announce, Choice
from foamfit.trust.prediction import BLOCKS, predicted_misfit
from foamfit.trust.residuals.residual_tests import BENT, find_structure, neighbours_test, runs_test

# From the simplest up, in groups: one spring; a linear spring below it or its relaxation; two
# springs; three; two that relax. More springs have more parameters (23 and more) than a loop has
# features.
LADDER = (
    (Model.parse("bistable"), Model.parse("microscale")),
    (
        *(Model.parse("linear+bistable"), Model.parse("linear+microscale")),
        *(Model.parse("bistable", 1), Model.parse("microscale", 1)),
    ),
    (Model.parse("bistable+bistable"), Model.parse("microscale+microscale")),
    (Model.parse("linear+bistable+bistable"),),
    (Model.parse("microscale+microscale", 1),),
)
# The comparison ends after so many groups in a row without a gain.
WITHOUT_GAIN = 2
# Chains with microscale springs, which take minutes in an impact, are not tried where one such
# spring misses the curves by so many times more than one bistable spring.
HOPELESS = 1.1
# Two of them take a minute even under a known motion: they are not tried where one, perhaps with
# relaxation, misses the curves by no more than this share of the range.
CLOSE = 0.01
# Share of the time of a comparison after which only the chosen model is left to be judged.
CHOSEN = 0.9
# While models are compared: only the chosen one gets ranges and better intervals, which cost as much
# as a search.
COMPARED = Choice("local", ranges=False)


def _dampers(params: lmfit.Parameters) -> list[str]:
    """Return the names of the dampers that vary."""
    return [name for name in params if split_name(name)[1] == "eta" and params[name].vary]


def _carry(params: lmfit.Parameters, model: Model, tried: Sequence[Tried]) -> None:
    """Start from the best fit of a model that is contained in this one, top spring first; in place.

    A new linear spring starts short and stiff and new relaxation with a share of zero, so that the
    chain starts with the curves of that fit.
    """
    inside = [
        one
        for one in tried
        if Counter(Model.parse(one.result.model).kinds) <= Counter(model.kinds)
        and one.result.relaxation <= model.relaxation
    ]
    if not inside:
        return
    below = min(inside, key=lambda one: one.chisqr).result
    values, was = below.params.valuesdict(), list(Model.parse(below.model).kinds)
    sources: dict[int, int] = {}
    for spring in reversed(range(len(model.kinds))):
        if was and model.kinds[spring] == was[-1]:
            was.pop()
            sources[spring] = len(was)
    for name in (*NUISANCE, *model.names):
        if name not in params or not params[name].vary:
            continue
        spring, short = split_name(name)
        source = name if spring < 0 else f"s{sources.get(spring, -1) + 1}_{short}"
        if source in values:
            params[name].value = values[source]
        elif spring in sources and is_share(short):
            params[name].value = 0.0
        elif spring >= 0 and spring not in sources and model.kinds[spring] == "linear":
            params[name].value = params[name].min if short == "height" else 0.1 * params[name].max


# ---------------------------------------------------------------- the comparison


def compare_models(
    measurement: Measurement, options: Options, progress: Progress, announce: Announce
) -> Fit:
    """Fit ever richer models until one holds; this is `foamfit.fit` with model="auto".

    The time limit is that of all models together; it and Ctrl-C keep what is done. All models have
    local intervals, and states by these alone; only the chosen one has ranges and the intervals
    that were asked for.
    """
    state = _Comparison(measurement, options, progress)
    tried = state.tried
    try:
        state.climb()
    except KeyboardInterrupt as error:
        if not tried:
            raise
        state.stopped = what_stopped(error)
    if not tried:
        told = "; ".join(state.skipped)
        raise SimulationError(f"{measurement.name}: no model could be tried: {told}")
    best = evidence.choose(tried).best
    wanted = options.choice.method != "local" or tried[best].best.misfits
    if state.stopped is None and wanted:

        def tell(share: float, what: str) -> None:
            done = CHOSEN + (1.0 - CHOSEN) * share
            progress(done, f"model chosen, {tried[best].name}: {what}")

        result, point = one_model.judge(state.fits[best], options.choice, announce, tell)
        tried[best] = replace(tried[best], result=result, best=point)  # it may be a better point
    progress(1.0, "done")
    return _conclude(state)


class _Comparison:
    """The test and options of all models, what was tried, and what stopped the comparison."""

    def __init__(self, measurement: Measurement, options: Options, progress: Progress) -> None:
        self.measurement, self.progress = measurement, progress
        self.options = replace(options, drive=options.drive or choose_drive(measurement))
        self.began, limit = time.perf_counter(), options.max_time
        self.deadline = None if limit is None else time.monotonic() + limit
        self.skipped: list[str] = []  # models that cannot be tried, and why
        self.groups = self._models()
        self.of, self.number = sum(map(len, self.groups)), 0  # models in all, and the present one
        self.tried: list[Tried] = []
        self.fits: list[Found] = []  # of what was tried, in its order
        self.stopped: str | None = None
        self.ended = "there are no richer ones that this test allows"

    def _models(self) -> list[list[Model]]:
        """Return the models that the test allows, in their groups.

        They have as many springs as heights are given, or one, and every mass whose motion was
        measured; relaxation needs the time.
        """
        test = self.measurement
        heights, inside = test.specimen.heights, max(test.interior, default=0)
        groups = []
        for group in LADDER:
            allowed = []
            for model in group:
                count = len(model.kinds)
                if inside >= count:
                    self._skip(model, f"it has no mass {inside} inside, whose motion was measured")
                elif heights is not None and count not in (1, len(heights)):
                    self._skip(model, f"[specimen] heights are those of {len(heights)} springs")
                elif model.relaxation and test.time is None:
                    self._skip(model, "relaxation needs a time column")
                else:
                    allowed.append(model)
            if allowed:
                groups.append(allowed)
        if not groups:
            told = "; ".join(self.skipped)
            raise InputError(f"{test.name}: no model of the ladder fits this test: {told}")
        return groups

    def _skip(self, model: Model, why: str) -> None:
        self.skipped.append(f"{rung_name(model.name, 'none', model.relaxation)}: {why}")

    def climb(self) -> None:
        """Fit group after group until one model holds, two groups gain nothing, or time is up."""
        idle = 0
        for group in self.groups:
            below = len(self.tried)
            for model in group:
                self.number += 1
                if why := _hopeless(model, self.tried):
                    self._skip(model, why)
                else:
                    self._family(model)
                if any(one.structureless for one in self.tried):
                    self.ended = "the residuals are random"
                    return
                if self.stopped:
                    return
            if len(self.tried) > below:
                idle = 0 if _has_gained(self.tried, below) else idle + 1
            if idle == WITHOUT_GAIN:
                self.ended = f"{WITHOUT_GAIN} groups of richer models in a row brought no gain"
                return

    def _family(self, model: Model) -> None:
        """Fit one model without damping and, unless that is enough, with it."""
        dampings = ("without", "with") if _dampers(self._params(model)) else ("none",)
        for i, damping in enumerate(dampings):
            left = None if self.deadline is None else max(self.deadline - time.monotonic(), 1e-6)
            if left == 1e-6 and self.tried:
                self.stopped = "the time limit"
                return
            try:
                one = self._fit(model, damping, left, i / len(dampings), 1.0 / len(dampings))
            except SimulationError as error:  # a dashpot would not help
                self._skip(model, str(error).removeprefix(f"{self.measurement.name}: "))
                return
            self.tried.append(one)
            self.stopped = one.result.stopped
            if self.stopped is not None or one.structureless:
                return

    def _params(self, model: Model) -> lmfit.Parameters:
        options = self.options
        return make_params(self.measurement, model, options.drive, time_shift=options.time_shift)

    def _fit(
        self, model: Model, damping: str, left: float | None, before: float, part: float
    ) -> Tried:
        """Fit one model with or without damping; `before` and `part` are shares of its work."""
        began, params = time.perf_counter(), self._params(model)
        _carry(params, model, self.tried)
        if damping == "without":
            for name in _dampers(params):
                params[name].set(value=0.0, vary=False)
        named = rung_name(model.name, damping, model.relaxation)

        def tell(share: float, what: str) -> None:
            done = CHOSEN * (self.number - 1 + before + 0.8 * part * share) / self.of
            self.progress(done, f"model {self.number} of {self.of}: {named}: {what}")

        options = replace(self.options, max_time=left, relaxation=model.relaxation)
        found = one_model.identify(self.measurement, model.name, params, options, tell)
        result, best = one_model.judge(found, COMPARED, lambda _: None)
        predicted = None if result.stopped else self._predicted(best)
        self.fits.append(found)
        return Tried(result, damping, best, time.perf_counter() - began, predicted)

    def _predicted(self, best: BestPoint) -> float | None:
        """Return the misfit of samples that are held back; None if the time is up."""
        try:
            return predicted_misfit(best, self.deadline)
        except SearchStoppedError:
            return None


def _hopeless(model: Model, tried: Sequence[Tried]) -> str:
    """Why a chain with microscale springs cannot win; "" where it may, and of other models."""

    def least(kind: str, most: float = math.inf) -> float:
        """Misfit of one such spring that has no more relaxation terms."""
        alone = (t for t in tried if t.result.model == kind and t.result.relaxation <= most)
        return min((one.misfit for one in alone), default=math.nan)

    if len(model.kinds) == 1 or "microscale" not in model.kinds:
        return ""
    one, other = least("microscale", 0), least("bistable", 0)
    if model.kinds.count("microscale") > 1 and (near := least("microscale")) <= CLOSE:
        return f"one microscale spring misses the curves by {percent(near)} of the range only"
    if not one > HOPELESS * other:
        return ""
    return (
        f"one microscale spring misses the curves by {percent(one)} of the range, "
        f"one bistable spring by {percent(other)}"
    )


def _has_gained(tried: Sequence[Tried], below: int) -> bool:
    """Whether one of the last models is chosen, or AICc or BIC strongly prefers one."""
    if below == 0:
        return True
    decision = evidence.choose(tried)
    if decision.best >= below or decision.by_prediction:
        return decision.best >= below
    return any(
        min(values[below:]) < min(values[:below]) - MARGIN
        for values in zip(*((one.aicc, one.bic) for one in decision.criteria), strict=True)
    )


# ---------------------------------------------------------------- what it says


def _conclude(state: _Comparison) -> Fit:
    """Return the result of the chosen model with the whole comparison."""
    tried, stopped = state.tried, state.stopped
    said = _Account(tried)
    best, result = said.best, said.best.result
    ended, warned = state.ended, []
    if stopped is not None:
        ended = f"it was stopped by {stopped}"
        warned.append(
            f"The comparison was stopped by {stopped} on {tried[-1].name}; richer models were not "
            "tried."
        )
    if best.states("not determined"):
        warned.append(said.undetermined())
    if result.at_noise is False and not any(one.structureless for one in tried):
        warned.append(said.structure_left())
    reference = evidence.reference_of(tried)
    ladder = Ladder(
        rungs=tuple(said.rung(i) for i in range(len(tried))),
        n_eff=evidence.effective_samples(reference),
        noise_from=reference.name,
        ended=ended,
        stopped=stopped,
        skipped=tuple(state.skipped),
        sentences=(*said.choice(ended), *warned),
        cautions=tuple(warned),
        by_prediction=said.decision.by_prediction,
    )
    return replace(
        result,
        status="warnings" if warned and result.status == "ok" else result.status,
        warnings=input_first((*warned, *result.warnings)),
        ladder=ladder,
        stopped=stopped or result.stopped,
        runtime_s=time.perf_counter() - state.began,
    )


class _Account:
    """The models that were tried, and the sentences on the choice among them."""

    def __init__(self, tried: Sequence[Tried]) -> None:
        self.tried, self.decision = tried, evidence.choose(tried)
        self.at = self.decision.best
        self.best = tried[self.at]

    def rung(self, i: int) -> Rung:
        """Return what was found of the `i`-th model."""
        one, found, before = self.tried[i], self.decision.criteria[i], self.decision.before[i]
        shared = ("damping", "chisqr", "runs_p", "neighbours_p", "seconds")
        return Rung(
            **{name: getattr(one, name) for name in shared},
            model=one.result.model,
            misfit=dict(one.result.misfit),
            n_vary=one.varied,
            rank=found.rank,
            n_eff=evidence.effective_samples(one),
            aicc=found.aicc,
            bic=found.bic,
            not_determined=one.states("not determined"),
            weak=one.states("weak"),
            stopped=one.result.stopped,
            chosen=i == self.at,
            why=self._why(i),
            relaxation=one.result.relaxation,
            predicted_misfit=one.predicted,
            gain=self._gain(i),
            gain_over=None if before is None else self.tried[before].name,
        )

    def _gain(self, i: int) -> float | None:
        """Return the share by which a model predicts better than the one before."""
        before = self.decision.before[i]
        other = None if before is None else self.tried[before].predicted
        own = self.tried[i].predicted
        return None if own is None or other is None else 1.0 - own / other

    def _why(self, i: int) -> str:
        """Say why a model was chosen or not."""
        one, found = self.tried[i], self.decision.criteria
        if (ruler := self.decision.ruled_out_by[i]) is not None:
            fewer = self.tried[ruler].varied < one.varied
            told = "more closely with fewer"
            told = told if fewer else f"over {evidence.WORSE:g} times better with as many"
            return f"not considered: {self.tried[ruler].name} follows the curves {told} parameters"
        if self.decision.by_prediction:
            return self._why_by_prediction(i)
        if i == self.at:
            reason = "its residuals are random" if one.structureless else "best supported"
            richest = one.varied >= max(each.varied for each in self.tried)
            richer = "was tried" if richest else f"lowers AICc and BIC by {MARGIN:g}"
            return f"{reason}, and no richer model {richer}"
        bic, aicc = found[i].bic - found[self.at].bic, found[i].aicc - found[self.at].aicc
        told = f"BIC {signed(bic)}, AICc {signed(aicc)}"
        return told if one.varied <= self.best.varied else f"richer without evidence: {told}"

    def _why_by_prediction(self, i: int) -> str:
        """Say why a model was chosen or not, where predictions decide."""
        one, before, gain = self.tried[i], self.decision.before[i], self._gain(i)
        if one.predicted is None:
            said = f"{percent(one.misfit)} of the range is left (no prediction: the time was up)"
        else:
            said = f"predicts held-back samples to {percent(one.predicted)} of the range"
        if before is not None and gain is not None:
            more = one.varied - self.tried[before].varied
            side = "less" if gain >= 0.0 else "more"
            said += f", {percent(abs(gain))} {side} than {self.tried[before].name}"
            if more and i != self.at:
                needed = 1.0 - (1.0 - SHARE) ** more
                said += f" ({counted(more, 'more parameter')} must gain {percent(needed)})"
        return f"{said}; none that was tried gains enough over it" if i == self.at else said

    def choice(self, ended: str) -> list[str]:
        """Say what was chosen, and what each criterion alone would choose."""
        one, tried, found = self.best, self.tried, self.decision.criteria
        if one.structureless:
            reason = "it is the simplest whose residuals are random"
        elif not self.decision.by_prediction:
            reason = "the evidence supports it best"
        elif any(each.predicted is None for each in tried):
            reason = "for its number of parameters it follows the curves best"
        else:
            reason = "for its number of parameters it predicts best what was held back"
        said = [
            f"{one.name} was chosen of {counted(len(tried), 'model')}: {reason}. No more models "
            f"were tried because {ended}."
        ]
        if any(item.range for item in one.result.parameters.values()):
            said.append(
                "Ranges were made of the chosen model alone; states of the others go by their 95 % "
                "intervals."
            )
        if self.decision.by_prediction:
            said.append(
                "With every model systematic residuals remain, so AICc and BIC do not hold. Each "
                f"was fitted without one of {BLOCKS} blocks in time, in turn, and predicted that "
                "block; each further parameter must lower this predicted misfit by "
                f"{percent(SHARE)}."
            )
            return said
        if found[self.at].rank < one.varied:
            said.append(
                f"The curves fix {found[self.at].rank} combinations of its {one.varied} "
                "parameters; AICc and BIC count those."
            )
        for name in ("AICc", "BIC"):
            values = [getattr(each, name.lower()) for each in found]
            least = int(np.argmin(values))
            if (off := values[least] - values[self.at]) < -MARGIN:
                said.append(f"{name} alone would choose {tried[least].name} ({signed(off)}).")
        return said

    def undetermined(self) -> str:
        """Say which parameters of the chosen model the test does not determine."""
        lost = ", ".join(self.best.states("not determined"))
        told = f"The test does not determine {lost} of the chosen model {self.best.name}"
        found = self.decision.criteria
        sound = [i for i, one in enumerate(self.tried) if not one.states("not determined")]
        if not sound:
            return f"{told}; no model of the ladder has all parameters determined."
        if self.decision.by_prediction:
            nearest = min(sound, key=lambda i: self.tried[i].misfit)
            cost = f"misfit of {percent(self.tried[nearest].misfit)} of the range"
        else:
            nearest = min(sound, key=lambda i: found[i].bic)
            cost = f"BIC higher by {found[nearest].bic - found[self.at].bic:.1f}"
        name = self.tried[nearest].name
        return f"{told}; by their 95 % intervals all of {name} are determined, at a {cost}."

    def structure_left(self) -> str:
        """Say where systematic residuals of the chosen model are, and how large."""
        one = self.best
        tests = [min(runs_test(part), neighbours_test(part)) for part in one.curves]
        worst = int(np.argmin(tests))
        found = find_structure(one.curves[worst], one.places[worst])
        told = (
            f"With every model systematic residuals remain: those of {one.counted[worst]} are "
            f"{percent(found.size / one.spans[worst])} of the range, {percent(found.share)} of "
            f"them on {found.place}."
        )
        if found.bent > BENT and found.straight:
            told += " The measured branch is curved where the law is a straight line."
        return told


def signed(value: float) -> str:
    """Write a difference of AICc or BIC with its sign."""
    if not math.isfinite(value):  # too few effective samples for the correction of AICc
        return "not defined"
    return text.signed(value, 1)
