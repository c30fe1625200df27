"""The simplest model that follows the curves, and the evidence for each that was tried.

Models are fitted from the simplest up, each without damping and then with it. They are compared by
AICc and BIC with the effective numbers of samples and of parameters where one of them comes to the
noise, else by how well they predict what they were not fitted to (`trust.evidence`). The comparison
ends where the residuals are random, or where two groups of models in a row bring no gain.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import lmfit
import numpy as np

from foamfit import one_model
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.curves import choose_drive
from foamfit.fitting.problem import make_params
from foamfit.fitting.search import SearchStoppedError, what_stopped
from foamfit.one_model import Found, Options, Progress
from foamfit.results import Fit, Ladder, Rung, rung_name
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, family, split_name
from foamfit.text import counted, percent
from foamfit.trust.best_point import BestPoint
from foamfit.trust.checklist import input_first
from foamfit.trust.evidence import (
    MARGIN,
    SHARE,
    WORSE,
    Decision,
    Tried,
    choose,
    effective_samples,
    reference_of,
)
from foamfit.trust.intervals import Announce, Choice
from foamfit.trust.prediction import BLOCKS, predicted_misfit
from foamfit.trust.residuals.residual_tests import BENT, find_structure, neighbours_test, runs_test

# From the simplest up, in groups: one spring; a linear spring below it or its relaxation; two
# springs; three; two that relax. More springs have more parameters (23 and more) than a loop has
# features.
LADDER = (
    (Model.parse("bistable"), Model.parse("microscale")),
    (
        Model.parse("linear+bistable"),
        Model.parse("linear+microscale"),
        Model.parse("bistable", 1),
        Model.parse("microscale", 1),
    ),
    (Model.parse("bistable+bistable"), Model.parse("microscale+microscale")),
    (Model.parse("linear+bistable+bistable"),),
    (Model.parse("microscale+microscale", 1),),
)
# So many groups in a row without a gain end the comparison.
WITHOUT_GAIN = 2
# Chains with microscale springs, which take minutes in an impact, are not tried where one such
# spring misses the curves by so many times more than one bistable spring.
HOPELESS = 1.1
# Two of them take a minute even under a known motion: they are not tried where one, perhaps with
# relaxation, misses the curves by no more than this share of the range.
CLOSE = 0.01
# Share of the time of a comparison after which what is left is to judge the chosen model.
CHOSEN = 0.9
# Of a model that is compared: ranges and better intervals are made of the chosen one alone. They
# cost as much as its search, and the comparison does not go by them.
COMPARED = Choice("local", ranges=False)


def _dampers(params: lmfit.Parameters) -> list[str]:
    """Names of the dampers that vary."""
    return [name for name in params if split_name(name)[1] == "eta" and params[name].vary]


def _nested(tried: Sequence[Tried], model: Model) -> Tried | None:
    """Of the models whose springs and relaxation a model has too, the one that fits best."""
    kinds = Counter(model.kinds)
    inside = [
        one
        for one in tried
        if Counter(Model.parse(one.result.model).kinds) <= kinds
        and one.result.relaxation <= model.relaxation
    ]
    return min(inside, key=lambda one: one.chisqr, default=None)


def _carry(params: lmfit.Parameters, model: Model, below: Fit | None) -> None:
    """Start from the springs of a simpler model, the top one first; in place.

    A new linear spring starts short and stiff and new relaxation with a share of zero, so that the
    chain does what the simpler one did.
    """
    if below is None:
        return
    values, was = below.params.valuesdict(), list(Model.parse(below.model).kinds)
    for name in NUISANCE:
        if name in params and params[name].vary:
            params[name].value = values[name]
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
        elif spring in sources and family(short) == "g":
            params[name].value = 0.0
        elif spring not in sources and model.kinds[spring] == "linear":
            params[name].value = params[name].min if short == "height" else 0.1 * params[name].max


# ---------------------------------------------------------------- the comparison


def compare_models(
    measurement: Measurement, options: Options, progress: Progress, announce: Announce
) -> Fit:
    """Fit ever richer models until one holds; this is `foamfit.fit` with model="auto".

    The time limit is that of all models together; it and Ctrl-C keep what is done. Models have
    local intervals and states by these alone; the intervals that were asked for, and ranges, are
    made of the chosen one.
    """
    state = _Comparison(measurement, options, progress)
    groups, skipped = _models(measurement)
    tried: list[Tried] = []
    ended, stopped, idle = "there are no richer ones that this test allows", None, 0
    try:
        state.of, number = sum(map(len, groups)), 0
        for group in groups:
            below = len(tried)
            for model in group:
                number += 1
                if why := _hopeless(model, tried):
                    skipped.append(f"{rung_name(model.name, 'none', model.relaxation)}: {why}")
                    continue
                family = state.family(model, number, tried, skipped)
                if state.stopped or any(one.structureless for one in family):
                    break
            if state.stopped:
                break
            if any(one.structureless for one in tried[below:]):
                ended = "the residuals are random"
                break
            if len(tried) > below:
                idle = 0 if _has_gained(tried, below) else idle + 1
            if idle == WITHOUT_GAIN:
                ended = f"{WITHOUT_GAIN} groups of richer models in a row brought no gain"
                break
        stopped = state.stopped
    except KeyboardInterrupt as error:
        if not tried:
            raise
        stopped = what_stopped(error)
    if not tried:
        raise SimulationError(f"{measurement.name}: no model could be tried: {'; '.join(skipped)}")
    best = choose(tried).best
    wanted = options.choice.method != "local" or tried[best].best.misfits
    if stopped is None and wanted:
        label = f"model chosen, {tried[best].name}"
        result, point = one_model.judge(
            state.fits[best], options.choice, announce,
            lambda share, what: progress(CHOSEN + (1.0 - CHOSEN) * share, f"{label}: {what}"),
        )  # fmt: skip
        tried[best] = replace(tried[best], result=result, best=point)  # it may be a better point
    progress(1.0, "done")
    ended = f"it was stopped by {stopped}" if stopped else ended
    return _conclude(tried, ended, stopped, tuple(skipped), time.perf_counter() - state.began)


def _hopeless(model: Model, tried: Sequence[Tried]) -> str:
    """Why a chain with microscale springs cannot win; "" where it may, and of other models."""
    if len(model.kinds) == 1 or "microscale" not in model.kinds:
        return ""
    least = {
        kind: min(
            (one.misfit for one in tried if one.result.model == kind and not one.result.relaxation),
            default=math.nan,
        )
        for kind in ("microscale", "bistable")
    }
    one = min((t.misfit for t in tried if t.result.model == "microscale"), default=math.nan)
    if model.kinds.count("microscale") > 1 and one <= CLOSE:
        return f"one microscale spring misses the curves by {percent(one)} of the range only"
    if not least["microscale"] > HOPELESS * least["bistable"]:
        return ""
    return (
        f"one microscale spring misses the curves by {percent(least['microscale'])} of the range, "
        f"one bistable spring by {percent(least['bistable'])}"
    )


def _has_gained(tried: Sequence[Tried], below: int) -> bool:
    """Whether one of the last models is chosen, or AICc or BIC strongly prefers it to all below."""
    if below == 0:
        return True
    decision = choose(tried)
    if decision.best >= below or decision.by_prediction:
        return decision.best >= below
    return any(
        min(values[below:]) < min(values[:below]) - MARGIN
        for values in (
            [one.aicc for one in decision.criteria],
            [one.bic for one in decision.criteria],
        )
    )


@dataclass(eq=False)
class _Comparison:
    """What every model is fitted with, and what stopped the comparison."""

    measurement: Measurement
    options: Options
    progress: Progress
    of: int = 0  # how many models there are
    stopped: str | None = None
    fits: list[Found] = field(default_factory=list)  # of what was tried, in its order

    def __post_init__(self) -> None:
        """Choose the drive and begin."""
        self.began, limit = time.perf_counter(), self.options.max_time
        self.deadline = None if limit is None else time.monotonic() + limit
        if self.options.drive is None:
            self.options = replace(self.options, drive=choose_drive(self.measurement))

    def family(
        self, model: Model, number: int, tried: list[Tried], skipped: list[str]
    ) -> list[Tried]:
        """Fit one model, the `number`-th, without damping and, unless that is enough, with it.

        What is fitted is added to `tried` at once.
        """
        dampings = ("without", "with") if _dampers(self.params(model)) else ("none",)
        family: list[Tried] = []
        for i, damping in enumerate(dampings):
            part = number - 1 + i / len(dampings), 1.0 / len(dampings)
            left = None if self.deadline is None else max(self.deadline - time.monotonic(), 1e-6)
            if left == 1e-6 and tried:
                self.stopped = "the time limit"
                break
            try:
                found, one = self.rung(model, damping, _nested(tried, model), left, part)
            except SimulationError as error:
                told = str(error).removeprefix(f"{self.measurement.name}: ")
                skipped.append(f"{rung_name(model.name, 'none', model.relaxation)}: {told}")
                break  # a dashpot makes nothing easier to simulate
            family.append(one)
            tried.append(one)
            self.fits.append(found)
            self.stopped = one.result.stopped
            if self.stopped is not None or one.structureless:
                break
        return family

    def params(self, model: Model) -> lmfit.Parameters:
        """Parameters of a model, as they are by default."""
        options = self.options
        return make_params(self.measurement, model, options.drive, time_shift=options.time_shift)

    def rung(
        self, model: Model, damping: str, below: Tried | None, left: float | None,
        part: tuple[float, float],
    ) -> tuple[Found, Tried]:  # fmt: skip
        """Fit one model with or without damping; `part` is where it begins, and what it takes.

        Both count models.
        """
        began = time.perf_counter()
        params = self.params(model)
        _carry(params, model, None if below is None else below.result)
        if damping == "without":
            for name in _dampers(params):
                params[name].set(value=0.0, vary=False)
        label = f"model {int(part[0]) + 1} of {self.of}: "
        label += rung_name(model.name, damping, model.relaxation)

        def tell(share: float, what: str) -> None:
            done = CHOSEN * (part[0] + 0.8 * part[1] * share) / self.of
            self.progress(done, f"{label}: {what}")

        found = one_model.identify(
            self.measurement,
            model.name,
            params,
            replace(self.options, max_time=left, relaxation=model.relaxation),
            tell,
        )
        result, best = one_model.judge(found, COMPARED, lambda _: None)
        predicted = None if result.stopped else self.predicted(best)
        return found, Tried(result, damping, best, time.perf_counter() - began, predicted)

    def predicted(self, best: BestPoint) -> float | None:
        """Misfit of samples that are held back; None if the time is up."""
        try:
            return predicted_misfit(best, self.deadline)
        except SearchStoppedError:
            return None


def _models(measurement: Measurement) -> tuple[list[list[Model]], list[str]]:
    """Models that a test allows, in their groups, and which are left out and why.

    They have as many springs as heights were given, or one, and every mass that was followed; those
    with relaxation need the time.
    """
    heights, inside = measurement.specimen.heights, max(measurement.interior, default=0)
    groups, skipped = list[list[Model]](), []
    for group in LADDER:
        allowed = []
        for model in group:
            count, name = len(model.kinds), rung_name(model.name, "none", model.relaxation)
            if inside >= count:
                skipped.append(f"{name}: it has no mass {inside} inside, whose motion was measured")
            elif heights is not None and count not in (1, len(heights)):
                skipped.append(f"{name}: [specimen] heights are those of {len(heights)} springs")
            elif model.relaxation and measurement.time is None:
                skipped.append(f"{name}: relaxation needs a time column")
            else:
                allowed.append(model)
        if allowed:
            groups.append(allowed)
    if not groups:
        raise InputError(
            f"{measurement.name}: no model of the ladder fits this test: {'; '.join(skipped)}"
        )
    return groups, skipped


# ---------------------------------------------------------------- what it says


def _conclude(
    tried: Sequence[Tried], ended: str, stopped: str | None, skipped: tuple[str, ...], took: float
) -> Fit:
    """Result of the chosen model with the whole comparison."""
    decision = choose(tried)
    best = decision.best
    reference, result = reference_of(tried), tried[best].result
    said, warned = _choice_sentences(tried, decision, ended), []
    if stopped is not None:
        warned.append(
            f"The comparison was stopped by {stopped} on {tried[-1].name}; richer models were not "
            "tried."
        )
    if tried[best].states("not determined"):
        warned.append(_undetermined(tried, decision))
    if result.at_noise is False and not any(rung.structureless for rung in tried):
        warned.append(_structure_left(tried, best))
    ladder = Ladder(
        rungs=tuple(_rung(i, tried, decision) for i in range(len(tried))),
        n_eff=effective_samples(reference),
        noise_from=reference.name,
        ended=ended,
        stopped=stopped,
        skipped=skipped,
        sentences=(*said, *warned),
        cautions=tuple(warned),
        by_prediction=decision.by_prediction,
    )
    return replace(
        result,
        status="warnings" if warned and result.status == "ok" else result.status,
        warnings=input_first((*warned, *result.warnings)),
        ladder=ladder,
        stopped=stopped or result.stopped,
        runtime_s=took,
    )


def _rung(i: int, tried: Sequence[Tried], decision: Decision) -> Rung:
    one, found, before = tried[i], decision.criteria[i], decision.before[i]
    return Rung(
        model=one.result.model,
        damping=one.damping,
        misfit=dict(one.result.misfit),
        chisqr=one.chisqr,
        n_vary=one.varied,
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
        chosen=i == decision.best,
        why=_why(i, tried, decision),
        relaxation=one.result.relaxation,
        predicted_misfit=one.predicted,
        gain=_gain(tried, i, before),
        gain_over=None if before is None else tried[before].name,
    )


def _gain(tried: Sequence[Tried], i: int, before: int | None) -> float | None:
    """Share by which the predicted misfit of a model is below that of another."""
    if before is None:
        return None
    own, other = tried[i].predicted, tried[before].predicted
    return None if own is None or other is None else 1.0 - own / other


def _why(i: int, tried: Sequence[Tried], decision: Decision) -> str:
    """Why a model was chosen or not."""
    best, one = decision.best, tried[i]
    if (ruler := decision.ruled_out_by[i]) is not None:
        fewer = tried[ruler].varied < one.varied
        told = "more closely with fewer" if fewer else f"over {WORSE:g} times better with as many"
        return f"not considered: {tried[ruler].name} follows the curves {told} parameters"
    if decision.by_prediction:
        return _why_by_prediction(i, tried, decision)
    if i == best:
        reason = "its residuals are random" if one.structureless else "best supported"
        richer = f"lowers AICc and BIC by {MARGIN:g}" if len(tried) > 1 else "was tried"
        richer = "was tried" if one.varied >= max(each.varied for each in tried) else richer
        return f"{reason}, and no richer model {richer}"
    found = decision.criteria
    bic, aicc = found[i].bic - found[best].bic, found[i].aicc - found[best].aicc
    told = f"BIC {signed(bic)}, AICc {signed(aicc)}"
    return told if one.varied <= tried[best].varied else f"richer without evidence: {told}"


def _why_by_prediction(i: int, tried: Sequence[Tried], decision: Decision) -> str:
    """Why a model was chosen or not, where what it predicts decides."""
    one, before = tried[i], decision.before[i]
    if one.predicted is None:
        said = f"{percent(one.misfit)} of the range is left (no prediction: the time was up)"
    else:
        said = f"predicts held-back samples to {percent(one.predicted)} of the range"
    gain = _gain(tried, i, before)
    if before is not None and gain is not None:
        more = one.varied - tried[before].varied
        side = "less" if gain >= 0.0 else "more"
        said += f", {percent(abs(gain))} {side} than {tried[before].name}"
        if more and i != decision.best:
            needed = 1.0 - (1.0 - SHARE) ** more
            said += f" ({counted(more, 'more parameter')} must gain {percent(needed)})"
    if i == decision.best:
        said += "; none that was tried gains enough over it"
    return said


def signed(value: float) -> str:
    """Write a difference with its sign."""
    if not math.isfinite(value):  # too few effective samples for the correction of AICc
        return "not defined"
    return f"{value:+.1f}".replace("-", "−")


def _choice_sentences(tried: Sequence[Tried], decision: Decision, ended: str) -> list[str]:
    """What was chosen, and what each criterion alone would choose."""
    best, found = decision.best, decision.criteria
    one = tried[best]
    if one.structureless:
        reason = "it is the simplest whose residuals are random"
    elif not decision.by_prediction:
        reason = "the evidence supports it best"
    elif any(each.predicted is None for each in tried):
        reason = "for its number of parameters it follows the curves best"
    else:
        reason = "for its number of parameters it predicts best what was held back"
    said = [
        f"{one.name} was chosen of {counted(len(tried), 'model')}: {reason}. No more models were "
        f"tried because {ended}."
    ]
    if any(item.range for item in one.result.parameters.values()):
        said.append(
            "Ranges were made of the chosen model alone; states of the others go by their 95 % "
            "intervals."
        )
    if decision.by_prediction:
        said.append(
            "With every model systematic residuals remain, so AICc and BIC do not hold. Each was "
            f"fitted without one of {BLOCKS} blocks in time, in turn, and predicted that block; "
            f"each further parameter must lower this predicted misfit by {percent(SHARE)}."
        )
        return said
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


def _undetermined(tried: Sequence[Tried], decision: Decision) -> str:
    """Sentence on the parameters of the chosen model that the test does not determine."""
    best, found = decision.best, decision.criteria
    lost = ", ".join(tried[best].states("not determined"))
    told = f"The test does not determine {lost} of the chosen model {tried[best].name}"
    sound = [i for i, one in enumerate(tried) if not one.states("not determined")]
    if not sound:
        return f"{told}; no model of the ladder has all parameters determined."
    if decision.by_prediction:
        nearest = min(sound, key=lambda i: tried[i].misfit)
        off = f"misfit of {percent(tried[nearest].misfit)} of the range"
        return f"{told}; {_all_of(tried[nearest])}, at a {off}."
    nearest = min(sound, key=lambda i: found[i].bic)
    higher = found[nearest].bic - found[best].bic
    return f"{told}; {_all_of(tried[nearest])}, at a BIC higher by {higher:.1f}."


def _all_of(one: Tried) -> str:
    """Say that a model that was not chosen has no parameter that is not determined."""
    return f"by their 95 % intervals all of {one.name} are determined"


def _structure_left(tried: Sequence[Tried], best: int) -> str:
    """Sentence on the structure in the residuals of the chosen model."""
    one = tried[best]
    worst = int(np.argmin([min(runs_test(part), neighbours_test(part)) for part in one.curves]))
    found = find_structure(one.curves[worst], one.places[worst])
    told = (
        f"With every model systematic residuals remain: those of {one.counted[worst]} are "
        f"{percent(found.size / one.spans[worst])} of the range, {percent(found.share)} of them on "
        f"{found.place}."
    )
    if found.bent > BENT and found.straight:
        told += " The measured branch is curved where the law is a straight line."
    return told
