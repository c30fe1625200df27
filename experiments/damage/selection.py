"""Which parameters several tests share: chosen by evidence, one parameter after the other.

Groups of tests are looked at together, as the cycles of several specimens: each group is one fit
with shared parameters of its own, and all groups have the same parameters shared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from foamfit.arrays import Array
from foamfit.fitting.links import Links
from foamfit.fitting.together import ITERATIONS, Together, fit_linked
from foamfit.springs.parameters import NUISANCE

Progress = Callable[[float, str], None]

# Steps of the descents that only rank the candidates.
TRIAL = 12
# Rounds of exchanges after a step at most, and how many of a round are fitted to the end.
EXCHANGES, PROMISING = 3, 3


@dataclass(frozen=True, eq=False)
class Step:
    """A choice of own parameters: the fit of each group, and the evidence for it."""

    own: tuple[str, ...]
    fits: tuple[Together, ...]
    bic: float

    @property
    def cost(self) -> float:
        """Sum of squares of all groups."""
        return sum(fit.cost for fit in self.fits)

    @property
    def n_vary(self) -> int:
        """Parameters that vary in all groups."""
        return sum(fit.n_vary for fit in self.fits)


@dataclass(frozen=True, eq=False)
class Selection:
    """The way from all parameters shared to those that each test has of its own.

    `steps` ends with the chosen one, or with one more that the evidence is against; `chosen` is its
    place. `alone` is the sum of squares of the own fits, with `n_alone` parameters.
    """

    steps: tuple[Step, ...]
    chosen: int
    n_eff: int
    alone: float
    n_alone: int
    bic_alone: float

    @property
    def best(self) -> Step:
        """The chosen step."""
        return self.steps[self.chosen]

    def explained(self, step: Step) -> float:
        """Share of what sharing everything costs that a step wins back."""
        worst = self.steps[0].cost
        return (worst - step.cost) / max(worst - self.alone, 1e-300)


def select_own(groups: Sequence[Together], *, progress: Progress | None = None) -> Selection:
    """Choose which parameters each test has of its own, by forward selection.

    Begins with all parameters of the springs shared. In each step every shared parameter is tried
    as an own one, and that of the lowest BIC is taken, as long as BIC falls:
    BIC = n_eff ln(χ²/n) + k ln(n_eff),
    summed over the groups, where n_eff is that of `effective_samples`. Parameters compensate each
    other, so that after each step own ones are exchanged for shared ones as long as BIC falls.

    Parameters
    ----------
    groups : sequence of Together
        Of one model, with the same parameters varying.
    progress : callable, optional
        Told the fraction done and what is going on.

    Returns
    -------
    Selection
    """
    done = 0.0

    def tell(fraction: float, what: str) -> None:
        nonlocal done
        done = max(done, fraction) if fraction == fraction else done  # exchanges take no share
        if progress is not None:
            progress(done, what)

    names = tuple(name for name in groups[0].problems[0].free() if name not in NUISANCE)
    steps, chosen = [step_of(groups, ())], 0
    rounds = len(names) * (len(names) + 1) / 2
    while len(steps[-1].own) < len(names) and chosen == len(steps) - 1:
        now = steps[-1]
        near = [[list(fit.values)] for fit in now.fits]
        rest = [name for name in names if name not in now.own]
        trials = list[Step]()
        for name in rest:
            count = sum(len(names) - i for i in range(len(steps) - 1)) + len(trials)
            tell(min(count / rounds, 1.0), f"shared or own: {name}")
            trials.append(step_of(groups, (*now.own, name), near, TRIAL))
        found = min(trials, key=lambda step: step.bic)
        steps.append(_exchanged(groups, _finished(groups, found), tell))
        chosen += steps[-1].bic < now.bic
    n_alone = sum(group.n_vary for group in groups)
    alone = sum(group.cost for group in groups)
    tell(1.0, "done")
    n_eff = sum(group.n_eff for group in groups)
    score = sum(group.bic(group.n_eff) for group in groups)
    return Selection(tuple(steps), chosen, n_eff, alone, n_alone, score)


def _exchanged(groups: Sequence[Together], step: Step, tell: Progress) -> Step:
    """Exchange an own parameter for a shared one as long as this lowers BIC."""
    shared = step.fits[0].shared
    for _ in range(EXCHANGES if len(step.own) > 1 else 0):
        # Also from the own fits: what was compensated by the parameter that is exchanged must move.
        near = [
            [list(fit.values), list(group.values)]
            for fit, group in zip(step.fits, groups, strict=True)
        ]
        trials = list[Step]()
        for out in step.own:
            kept = tuple(name for name in step.own if name != out)
            tell(math.nan, f"{out} shared, another own")
            trials += [step_of(groups, (*kept, name), near, TRIAL) for name in shared]
        best = step
        for trial in sorted(trials, key=lambda trial: trial.bic)[:PROMISING]:
            best = min(best, _finished(groups, trial), key=lambda one: one.bic)
        if best.bic >= step.bic:
            break
        step, shared = best, best.fits[0].shared
    return step


def _finished(groups: Sequence[Together], trial: Step) -> Step:
    """Fit to the end what was tried."""
    pairs = zip(trial.fits, groups, strict=True)
    starts = [[list(fit.values), *group.starts()] for fit, group in pairs]
    return step_of(groups, trial.own, starts)


def step_of(
    groups: Sequence[Together],
    own: tuple[str, ...],
    starts: Sequence[list[list[Array]]] | None = None,
    iterations: int = ITERATIONS,
) -> Step:
    """Fit all groups with these own parameters.

    `starts` holds those of each group, as `fit_linked` takes them; by default `Together.starts`.
    """
    starts = [group.starts() for group in groups] if starts is None else starts
    names = {name for group in groups for one in group.problems for name in one.free()}
    links = Links({name: "shared" for name in names if name not in (*own, *NUISANCE)})
    fits = tuple(
        fit_linked(group.problems, links, start, iterations=iterations)
        for group, start in zip(groups, starts, strict=True)
    )
    pairs = zip(groups, fits, strict=True)
    return Step(own, fits, sum(fit.bic(group.n_eff) for group, fit in pairs))
