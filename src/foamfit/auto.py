"""Model selection: find the simplest model that describes the curves.

Models are fitted from the simplest up, each without damping and then with damping. If a model
reaches the noise floor, AICc and BIC compare the models, with effective numbers of samples and
parameters; otherwise predictions of held-out samples compare them (`trust.evidence`). The
comparison ends when the residuals are random, or after two groups of models without a gain.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import lmfit

from foamfit import one_model
from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.problem import Problem, make_params
from foamfit.fitting.search import SearchStoppedError, what_stopped
from foamfit.one_model import Found, Options, Progress, part_of
from foamfit.options import FREED
from foamfit.parts import Ladder, Rung, law_in_words
from foamfit.report import render
from foamfit.results import Fit
from foamfit.springs import laws
from foamfit.springs.model import Model, with_options
from foamfit.springs.parameters import split_name
from foamfit.text import percent
from foamfit.trust import evidence
from foamfit.trust.checklist import input_first
from foamfit.trust.evidence import BENT, BLOCKS, MARGIN, SHARE, Tried, misfit_of, predicted_misfit
from foamfit.trust.intervals import Announce, Choice

# Groups of models, from the simplest up: one spring; a linear spring below it, or relaxation (tried
# first except in impacts, where it is slower); one spring that softens after snapping; two springs;
# three springs; two springs with relaxation. Longer chains have more parameters (at least 23) than
# a loop has features. Microscale springs are too slow in chains of three, and bistable springs gain
# nothing in the last group.
_OWN = [law.kind for law in map(laws.law, laws.PAPER) if law.hysteretic and not law.word]
_SLOW = [kind for kind in _OWN if laws.law(kind).remembers]
_QUICK = [kind for kind in _OWN if kind not in _SLOW]
_FREED = [with_options(k, **dict.fromkeys(FREED, True)) for k in _SLOW if laws.options_of(k)]
LADDER = tuple(
    tuple(Model.parse(name, terms) for name, terms in group)
    for group in (
        [(kind, 0) for kind in _OWN],
        [*((f"linear+{kind}", 0) for kind in _OWN), *((kind, 1) for kind in _OWN)],
        [(kind, 1) for kind in _FREED],
        [(f"{kind}+{kind}", 0) for kind in _OWN],
        [(f"linear+{kind}+{kind}", 0) for kind in _QUICK],
        [(f"{kind}+{kind}", 1) for kind in _SLOW],
    )
)
# Several cycles as one history: only springs with memory, as others repeat the same loop.
HISTORY = tuple(
    (Model.parse(kind, terms),)
    for kinds, most in ((_SLOW, 1), (_FREED, 2))
    for kind in kinds
    for terms in range(1, most + 1)
)
# Number of consecutive groups without a gain after which the comparison ends.
WITHOUT_GAIN = 2
# Chains of springs with memory take minutes in an impact. They are skipped if the misfit of one
# such spring exceeds the misfit of one spring without memory by more than this factor.
HOPELESS = 1.1
# Two of them take a minute even under a prescribed motion. They are skipped if the misfit of one,
# with or without relaxation, is at most this fraction of the range.
CLOSE = 0.01
# The search for springs in series stops if the misfit after the first descents exceeds that of a
# model of no more springs by more than this factor.
UNPROMISING = 1.5
# Fraction of the run time that the comparison takes; the rest is for the selected model.
CHOSEN = 0.9
# Intervals while models are compared. Only the selected model gets ranges and better intervals,
# which take as long as a search.
COMPARED = Choice("local", ranges=False)


class _UnpromisingError(Exception):
    """The search for a chain was stopped early; the message says why."""


def _dampers(params: lmfit.Parameters) -> list[str]:
    return [name for name in params if split_name(name)[1] == "eta" and params[name].vary]


def compare_models(
    measurement: Measurement, options: Options, progress: Progress, announce: Announce
) -> Fit:
    """Fit richer and richer models until one describes the curves: `foamfit.fit`, model="auto".

    The time limit applies to all models together; after it, or after Ctrl-C, the finished fits are
    compared. All models have local intervals and states derived from them; only the selected model
    has ranges and the requested intervals.
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
        reasons = "; ".join(state.skipped)
        raise SimulationError(f"{measurement.name}: no model could be tried: {reasons}")
    best = evidence.choose(tried).best
    wanted = options.choice.method != "local" or tried[best].best.misfits
    if state.stopped is None and wanted:
        tell = part_of(progress, CHOSEN, 1.0, f"model chosen, {tried[best].name}: ")
        result, point = one_model.judge(state.fits[best], options.choice, announce, tell)
        tried[best] = replace(tried[best], result=result, best=point)  # it may have improved
    progress(1.0, "done")
    return _conclude(state)


class _Comparison:
    """State of a comparison: the models tried so far, those skipped, and why it ended."""

    def __init__(self, measurement: Measurement, options: Options, progress: Progress) -> None:
        self.measurement, self.progress = measurement, progress
        self.options = replace(options, drive=options.drive_for(measurement))
        self.began, limit = time.perf_counter(), options.max_time
        self.deadline = None if limit is None else time.monotonic() + limit
        self.skipped: list[str] = []  # each skipped model with the reason
        self.unpromising: list[Model] = []  # skipped because of poor first descents
        self.groups = self._models()
        self.of, self.number = sum(map(len, self.groups)), 0  # number of models; current model
        self.tried: list[Tried] = []
        self.fits: list[Found] = []  # same order as `tried`
        self.stopped: str | None = None
        self.ended = "there are no richer ones left to try"

    def _models(self) -> list[list[Model]]:
        """Return the groups of models that the test allows.

        A model has one spring or as many as there are heights, and contains every mass whose motion
        was measured; relaxation needs a time column.
        """
        test, groups = self.measurement, []
        heights, inside = test.specimen.heights, max(test.interior, default=0)

        def in_turn(model: Model) -> tuple[bool, bool]:
            # Along a given motion relaxation is tried first, as it is quick there, and two springs
            # with memory before two without, which need many more starts and are stopped early.
            return not model.relaxation, model.has_several and model.kinds[0] not in _SLOW

        for group in LADDER if test.last_cycle is None else HISTORY:
            allowed = []
            for model in group if self.options.drive == "impact" else sorted(group, key=in_turn):
                why, count = "", len(model.kinds)
                if inside >= count:
                    why = f"it has no mass {inside} inside, whose motion was measured"
                elif heights is not None and count not in (1, len(heights)):
                    why = f"[specimen] heights are those of {len(heights)} springs"
                elif model.relaxation and test.time is None:
                    why = "relaxation needs a time column"
                if not self._skip(model, why):
                    allowed.append(model)
            groups += [allowed] if allowed else []
        if not groups:
            reasons = "; ".join(self.skipped)
            raise InputError(f"{test.name}: no model of the ladder fits this test: {reasons}")
        return groups

    def _skip(self, model: Model, why: str) -> bool:
        """Record the reason why a model is skipped, if there is one; return whether there is."""
        if why:
            named = law_in_words(model.name, model.relaxation)
            self.skipped.append(f"{named}: {why}")
        return bool(why)

    def climb(self) -> None:
        """Fit the groups in turn until residuals are random, nothing is gained, or time is up."""
        idle = 0
        for group in self.groups:
            below = len(self.tried)
            for model in group:
                self.number += 1
                if not self._skip(model, _hopeless(model, self.tried, self.unpromising)):
                    self._family(model)
                if random := any(one.structureless for one in self.tried):
                    self.ended = "the residuals are random"
                if random or self.stopped:
                    return
            if len(self.tried) > below > 0:
                idle = 0 if evidence.choose(self.tried).best >= below else idle + 1
            if idle == WITHOUT_GAIN:
                self.ended = f"{WITHOUT_GAIN} groups of richer models in a row brought no gain"
                return

    def _family(self, model: Model) -> None:
        """Fit one model without damping and, unless its residuals are random, with damping."""
        dampings = ("without", "with") if _dampers(self._params(model)) else ("none",)
        for i, damping in enumerate(dampings):
            left = None if self.deadline is None else max(self.deadline - time.monotonic(), 1e-6)
            if left == 1e-6 and self.tried:
                self.stopped = "the time limit"
                return
            try:
                one = self._fit(model, damping, left, i, len(dampings))
            except (_UnpromisingError, SimulationError) as error:
                if damping == "without" and _is_damped(self.tried):
                    continue
                self.unpromising += [model] if isinstance(error, _UnpromisingError) else []
                self._skip(model, str(error).removeprefix(f"{self.measurement.name}: "))
                return
            self.tried.append(one)
            self.stopped = one.result.stopped
            if self.stopped is not None or one.structureless:
                return

    def _params(self, model: Model) -> lmfit.Parameters:
        options = self.options
        return make_params(self.measurement, model, options.drive, time_shift=options.time_shift)

    def _below(self, model: Model) -> Found | None:
        """Return the best fit of a model with the same hysteretic springs, and nothing more."""

        def hysteretic(model: Model) -> list[str]:
            return sorted(law.word or law.kind for law in model.laws if law.hysteretic)

        def contained(other: Model) -> bool:
            fewer = len(other.kinds) <= len(model.kinds) and other.relaxation <= model.relaxation
            return fewer and hysteretic(other) == hysteretic(model)

        inside = [i for i, one in enumerate(self.fits) if contained(one.problem.model)]
        best = min(inside, key=lambda i: self.tried[i].chisqr, default=None)
        return None if best is None else self.fits[best]

    def _fit(self, model: Model, damping: str, left: float | None, i: int, count: int) -> Tried:
        """Fit one model with or without damping; `i` of its `count` fits come before."""
        began, params = time.perf_counter(), self._params(model)
        if damping == "without":
            for name in _dampers(params):
                params[name].set(value=0.0, vary=False)
        named = law_in_words(model.name, model.relaxation, damping)
        start, end = (CHOSEN * (self.number - 1 + part / count) / self.of for part in (i, i + 0.8))
        tell = part_of(self.progress, start, end, f"model {self.number} of {self.of}: {named}: ")
        options = replace(self.options, max_time=left, relaxation=model.relaxation)
        look = partial(self._look, damping) if len(model.kinds) > 1 else None
        found = one_model.identify(
            self.measurement, model.name, params, options, tell, look, self._below(model)
        )
        (result, best), predicted = one_model.judge(found, COMPARED, lambda _: None), None
        if not result.stopped:
            with suppress(SearchStoppedError):
                predicted = predicted_misfit(best, self.deadline)
        self.fits.append(found)
        return Tried(result, damping, best, time.perf_counter() - began, predicted)

    def _look(self, damping: str, problem: Problem, values: Array) -> None:
        """Stop a fit if its first descents are far worse than no more springs, damped alike."""
        like = (one for one in self.tried if damping in (one.damping, "none"))
        count = problem.model.name.count("+")
        fewer = (one for one in like if one.result.model.count("+") <= count)
        found = misfit_of(problem.objective, problem.objective.residual(values))
        best = min(fewer, key=lambda one: one.misfit, default=None)
        if best is not None and found > UNPROMISING * best.misfit:
            raise _UnpromisingError(
                f"its first descents miss the curves by {percent(found)} of the range, "
                f"{best.name} by {percent(best.misfit)}"
            )


def _is_damped(tried: Sequence[Tried]) -> bool:
    """Return whether a model with damping misses far less than every model without."""
    damped, undamped = (
        min((one.misfit for one in tried if one.damping == damping), default=math.nan)
        for damping in ("with", "without")
    )
    return UNPROMISING * damped < undamped


def _hopeless(model: Model, tried: Sequence[Tried], unpromising: Sequence[Model] = ()) -> str:
    """Return why a slow model need not be tried, or "" if it is to be tried."""

    def least(kinds: Sequence[str], most: float = math.inf) -> tuple[float, str]:
        """Return the least misfit of one spring of these kinds, also as a sentence."""
        alone = (t for t in tried if t.result.model in kinds and t.result.relaxation <= most)
        found = min(alone, key=lambda one: one.misfit, default=None)
        if found is None:
            return math.nan, ""
        title, misfit = laws.law(found.result.model).title, found.misfit
        return misfit, f"one {title} misses the curves by {percent(misfit)} of the range"

    for poor in unpromising:
        if Counter(poor.kinds) <= Counter(model.kinds):
            return f"the first descents with {poor.name} were poor"
    slow = [kind for kind in model.kinds if kind in _SLOW]
    if any(model.options.values()):
        (one, told), (other, against) = least([model.words]), least(_QUICK)
        return f"{told}, {against}" if HOPELESS * one > other else ""
    if len(model.kinds) == 1 or not slow:
        return ""
    near, told = least(slow)
    if len(slow) > 1 and near <= CLOSE:
        return f"{told} only"
    (one, told), (other, against) = least(slow, 0), least(_QUICK, 0)
    return f"{told}, {against}" if one > HOPELESS * other else ""


def _conclude(state: _Comparison) -> Fit:
    """Return the result of the selected model, with the comparison as its `ladder`."""
    tried, stopped = state.tried, state.stopped
    decision = evidence.choose(tried)
    best, criteria = tried[decision.best], decision.criteria
    result, ended = best.result, f"it was stopped by {stopped}" if stopped else state.ended
    told: dict[str, Any] = {"tried": tried, "decision": decision, "best": best, "ended": ended}
    told |= {"stopped": stopped, "lost": best.states("not determined"), "sound": None, "left": None}
    told |= {"blocks": BLOCKS, "share": SHARE, "bent": BENT, "margin": MARGIN}
    sound = [i for i, one in enumerate(tried) if not one.states("not determined")]
    if told["lost"] and sound:
        by_misfit = decision.by_prediction
        nearest = min(sound, key=lambda i: tried[i].misfit if by_misfit else criteria[i].bic)
        higher = criteria[nearest].bic - criteria[decision.best].bic
        told |= {"sound": tried[nearest], "higher": higher}
    if result.at_noise is False and not any(one.structureless for one in tried):
        told |= best.structure()
    said = render.sentences("choice", part="choice", **told)
    warned = render.sentences("choice", part="cautions", **told)
    reference = evidence.reference_of(tried)
    ladder = Ladder(
        rungs=tuple(_rung(i, tried, decision) for i in range(len(tried))),
        n_eff=reference.n_eff,
        noise_from=reference.name,
        ended=ended,
        stopped=stopped,
        skipped=tuple(state.skipped),
        sentences=(*said, *warned),
        cautions=warned,
        by_prediction=decision.by_prediction,
    )
    return replace(
        result,
        status="warnings" if warned and result.status == "ok" else result.status,
        warnings=input_first((*warned, *result.warnings)),
        ladder=ladder,
        stopped=stopped or result.stopped,
        runtime_s=time.perf_counter() - state.began,
    )


def _rung(i: int, tried: Sequence[Tried], decision: evidence.Decision) -> Rung:
    """Return the row of model `i` in the comparison, with the reason for its rank."""
    one, result, place = tried[i], tried[i].result, decision.before[i]
    before, gain = None if place is None else tried[place], None
    if before and one.predicted is not None and before.predicted is not None:
        gain = 1.0 - one.predicted / before.predicted
    told: dict[str, Any] = {"i": i, "tried": tried, "decision": decision, "before": before}
    told |= {"gain": gain, "worse": evidence.WORSE, "share": SHARE, "margin": MARGIN}
    return Rung(
        **{name: getattr(result, name) for name in ("model", "relaxation", "stopped")},
        **{name: getattr(decision.criteria[i], name) for name in ("rank", "aicc", "bic")},
        **{name: getattr(one, name) for name in ("damping", "chisqr", "runs_p", "neighbours_p")},
        **{name: getattr(one, name) for name in ("seconds", "n_eff")},
        misfit=dict(result.misfit),
        n_vary=one.varied,
        not_determined=one.states("not determined"),
        weak=one.states("weak"),
        chosen=i == decision.best,
        why=render.words("why", **told).replace("\n", ""),
        predicted_misfit=one.predicted,
        gain=gain,
        gain_over=before.name if before else None,
    )
