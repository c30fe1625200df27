"""What a test can tell of its parameters: branches reached, sensitivities, information, directions.

Everything here is local: it holds at one point of the parameters, before a fit (a start) or after
it. Sensitivities are counted in standard deviations of the noise per natural size of a parameter,
so that parameters and curves can be compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from foamfit.springs import kernels
from foamfit.springs.parameters import BRANCHES, split_name

if TYPE_CHECKING:
    from foamfit.fitting.objective import Simulated
    from foamfit.fitting.problem import Problem

Array = NDArray[np.float64]

# Shares of a direction below which a parameter has no part in it, and of the largest below which
# it is not named.
PART, NAMED = 0.05, 0.3
# Parameters of a joint change that are named at most.
MOST = 3
FLIGHT = "free flight"


# ---------------------------------------------------------------- branches


def visited(problem: Problem, simulated: Simulated) -> dict[str, tuple[str, ...]]:
    """Branches that each spring went through, in the order of the first visit."""
    seen = {
        i: ["a" if kind == "bistable" else "line"] for i, kind in enumerate(problem.model.kinds)
    }
    for _, spring, _, entered, _ in simulated.motion.switches:
        name = kernels.BRANCH_NAMES[int(entered)]
        if name not in seen[int(spring)]:
            seen[int(spring)].append(name)
    return {f"s{i + 1}": tuple(names) for i, names in seen.items()}


def unreached(problem: Problem, values: Array) -> dict[str, str]:
    """Parameters whose branch was never reached, and that branch."""
    seen = visited(problem, problem.objective.simulate(values, everything=True))
    out = {}
    for name in problem.model.names:
        spring, short = split_name(name)
        branch = BRANCHES.get(short)
        bistable = branch and problem.model.kinds[spring] == "bistable"
        if branch and bistable and branch not in seen[f"s{spring + 1}"]:
            out[name] = branch
    return out


@dataclass(frozen=True)
class Section:
    """Samples `start` to `stop` (excluded) in which no spring changes its branch.

    `branches` names those of the bistable springs from the base up, joined by a dot: "d" or "a·c".
    """

    branches: str
    start: int
    stop: int


def sections(problem: Problem, simulated: Simulated) -> tuple[Section, ...]:
    """Cut the samples of a run at its switches and at the end of contact, in the order of time."""
    soft = [i for i, kind in enumerate(problem.model.kinds) if kind == "bistable"]
    state = dict.fromkeys(soft, "a")
    clock, motion = problem.objective.time, simulated.motion

    def label() -> str:
        return "·".join(state.values()) or "line"

    cuts: list[tuple[int, str]] = [(0, label())]
    for when, spring, _, entered, _ in motion.switches:
        if int(spring) in state:
            state[int(spring)] = kernels.BRANCH_NAMES[int(entered)]
            cuts.append((int(np.searchsorted(clock, when)), label()))
    if np.isfinite(motion.contact_end):
        cuts.append((int(np.searchsorted(clock, motion.contact_end, side="right")), FLIGHT))
    ends = [start for start, _ in cuts[1:]] + [clock.size]
    return tuple(
        Section(name, start, min(stop, clock.size))
        for (start, name), stop in zip(cuts, ends, strict=True)
        if stop > start
    )


# ---------------------------------------------------------------- sensitivities


@dataclass(frozen=True, eq=False)
class Insight:
    """The sensitivities of all counted curves to the parameters that they can tell of.

    Attributes
    ----------
    names : (k,) tuple of str
        Parameters that vary and whose branch was reached.
    values, sizes : (k,) arrays
        Where they stand and their natural sizes, SI.
    curves : tuple of str
        Counted curves, in the order of the rows of `scaled`.
    clock : (n_samples,) array
        Time of the samples, s; their number where the test has no time.
    timed : bool
        Whether the clock is a time.
    scaled : (len(curves) * n_samples, k) array
        By how many standard deviations of its noise a curve moves, sample by sample, if a parameter
        changes by its natural size; to first order. Zero at samples that are not counted.
    sections : tuple of Section
        The stretches of the run between switches.
    silent : tuple of str
        Parameters that vary but whose branch was never reached.
    """

    names: tuple[str, ...]
    values: Array
    sizes: Array
    curves: tuple[str, ...]
    clock: Array
    timed: bool
    scaled: Array
    sections: tuple[Section, ...]
    silent: tuple[str, ...] = ()

    @cached_property
    def _directions(self) -> tuple[Array, Array]:
        """Standard errors along the principal directions, (k,), and these as rows, (k, k).

        The last one is the weakest. The error is infinite where the curves do not move at all.
        """
        k = len(self.names)
        triangle = np.linalg.qr(self.scaled, mode="r") if len(self.scaled) > k else self.scaled
        _, singular, vt = np.linalg.svd(triangle, full_matrices=True)
        singular = np.concatenate([singular, np.zeros(k - singular.size)])
        tiny = 1e-12 * max(float(singular[0]), 1e-300)
        with np.errstate(divide="ignore"):
            return np.where(singular > tiny, 1.0 / singular, np.inf), vt

    @property
    def stderr(self) -> Array:
        """Standard errors that the noise alone leaves, SI, (k,); infinite if nothing is told."""
        return np.sqrt(self._variance) * self.sizes

    @cached_property
    def _variance(self) -> Array:
        errors, vt = self._directions
        seen = np.isfinite(errors)
        out = (vt[seen] ** 2 * errors[seen, None] ** 2).sum(axis=0)
        out[np.any(np.abs(vt[~seen]) > 1e-3, axis=0)] = np.inf
        return np.asarray(out)

    @property
    def correlation(self) -> Array:
        """Correlation of the estimates, (k, k); NaN for what the curves do not tell."""
        errors, vt = self._directions
        seen = np.isfinite(errors)
        covariance = (vt[seen].T * errors[seen] ** 2) @ vt[seen]
        scale = np.sqrt(np.where(np.isfinite(self._variance), self._variance, np.nan))
        return np.asarray(covariance / np.outer(scale, scale))

    def stderr_with(self, quieter: str, factor: float = 0.5) -> Array:
        """Standard errors, SI, (k,), if the noise of one curve were `factor` of what it is."""
        n = self.clock.size
        scaled = self.scaled.copy()
        at = self.curves.index(quieter)
        scaled[at * n : (at + 1) * n] /= factor
        return replace(self, scaled=scaled).stderr

    def along(self, name: str, curve: str) -> Array:
        """Sensitivity of one curve to one parameter, (n_samples,)."""
        n, at = self.clock.size, self.curves.index(curve)
        return np.asarray(self.scaled[at * n : (at + 1) * n, self.names.index(name)])

    def shares(self) -> tuple[tuple[tuple[str, str], ...], Array]:
        """Say which part of which curve fixes which parameter.

        The information on a parameter, all others free, is the square of what is left of its column
        of sensitivities once the other columns are taken out of it (Frisch and Waugh 1933,
        Econometrica 1, 387); being a sum over samples it is shared out among them.

        Returns
        -------
        parts : tuple of (curve, branches)
            In the order of curves and of first visits.
        shares : (k, n_parts) array
            Each row adds up to one; NaN for a parameter that the curves do not tell.
        """
        labels = list(dict.fromkeys(section.branches for section in self.sections))
        inverse = np.linalg.pinv(self.scaled, rcond=1e-12)  # (k, n): own parts, rescaled
        squares = inverse**2
        n, columns, parts = self.clock.size, [], []
        for c, curve in enumerate(self.curves):
            for label in labels:
                inside = np.zeros(n, bool)
                for section in self.sections:
                    if section.branches == label:
                        inside[section.start : section.stop] = True
                columns.append(squares[:, c * n : (c + 1) * n][:, inside].sum(axis=1))
                parts.append((curve, label))
        shares = np.array(columns).T
        shares[~np.isfinite(self._variance)] = np.nan
        with np.errstate(invalid="ignore"):
            return tuple(parts), shares / shares.sum(axis=1, keepdims=True)

    # ------------------------------------------------------------ in words

    def weakest(self) -> tuple[float, dict[str, float]]:
        """Standard error along the weakest direction (natural sizes), and its largest parts.

        The direction is the right singular vector of the smallest singular value of `scaled`; its
        parts are over the largest of them, which is 1.
        """
        errors, vt = self._directions
        direction = vt[-1] / vt[-1][np.argmax(np.abs(vt[-1]))]
        order = np.argsort(-np.abs(direction), kind="stable")
        named = {self.names[i]: float(direction[i]) for i in order if abs(direction[i]) >= NAMED}
        return float(errors[-1]), named

    def sentence(self) -> str:
        """Say what the test tells least, in one sentence; "" if there is nothing to tell of."""
        if not self.names:
            return ""
        error, parts = self.weakest()
        size = "cannot be told at all" if error > 1e3 else f"has a standard error of {error:.2g}"
        names, start = list(parts), "The test says least about"
        if self.silent:
            start = (
                f"The test says nothing of {_listed(list(self.silent))}, and least of the rest of"
            )
        if len(names) == 1:
            of = "" if error > 1e3 else " of its natural size"
            return f"{start} {names[0]}, which {size}{of}."
        joint = ", ".join(
            f"{name} by {part:+.2g}".replace("-", "−") for name, part in parts.items()
        )
        joint += " (in natural sizes)"
        return f"{start} {_listed(names)} together: a joint change of {joint} {size}."

    def combination(self, name: str, loose: float) -> str:
        """Say what the data fix instead of a parameter; "" if it is loose by itself.

        Parameters
        ----------
        name : str
            One of `names`.
        loose : float
            Directions whose standard error (natural sizes) is larger are taken for free.

        Returns
        -------
        str
            If one combination of the parameters that can move together is fixed, that one as a
            product of powers, good to first order; else those that make up for a change of it.
        """
        errors, vt = self._directions
        free = vt[errors > loose]
        group = self._group(free, self.names.index(name))
        if len(group) < 2:
            return ""
        left, singular, _ = np.linalg.svd(free[:, group].T, full_matrices=True)
        moving = int(np.sum(singular > NAMED))
        names = [self.names[i] for i in group]
        if moving == len(group):
            return f"the data say nothing of {_listed(names)}"
        if moving == len(group) - 1:
            # d ln|p| = (size/p) dx, so exponents are the weights of x times p/size.
            powers = left[:, -1] * self.values[group] / self.sizes[group]
            if np.all(self.values[group] != 0.0):
                return f"the data fix only {_product(names, powers)}"
        return self._made_up(name, free, errors[errors > loose])

    def _made_up(self, name: str, free: Array, errors: Array) -> str:
        """Say which parameters make up for one: how they go with it along the free directions."""
        me = self.names.index(name)
        change = (free[:, me] * np.minimum(errors, 1e6) ** 2) @ free
        change = change / change[me]
        change[me] = 0.0
        order = np.argsort(-np.abs(change), kind="stable")
        parts = [i for i in order if abs(change[i]) > NAMED * abs(change[order[0]])]
        told = ", ".join(
            f"{self.names[i]} ({change[i]:+.2g})".replace("-", "−") for i in parts[:MOST]
        )
        more = f" and {len(parts) - MOST} more" if len(parts) > MOST else ""
        return f"a change by one natural size is made up for by {told}{more}"

    def _group(self, free: Array, member: int) -> list[int]:
        """Parameters that can move together with one, itself included, along free directions."""
        movable = np.linalg.norm(free, axis=0) > 2.0 * PART
        linked = (np.abs(free.T @ free) > PART) & np.outer(movable, movable)
        group, fresh = {member}, [member]
        while fresh:
            near = set(np.flatnonzero(linked[fresh.pop()]).tolist()) - group
            group |= near
            fresh += near
        return sorted(group)

    def companion(self, name: str, correlation: float = 0.9) -> str:
        """Say with which parameter one is told together; "" if no correlation is that strong."""
        row = np.nan_to_num(self.correlation[self.names.index(name)])
        row[self.names.index(name)] = 0.0
        at = int(np.argmax(np.abs(row)))
        if abs(row[at]) < correlation:
            return ""
        shown = f"{row[at]:.2f}".replace("-", "−")
        return f"it is told only together with {self.names[at]} (correlation {shown})"


def look(
    problem: Problem,
    values: Array,
    names: tuple[str, ...],
    slopes: Array,
    noise: Mapping[str, float],
) -> Insight:
    """Gather what a test can tell at a point of the parameters.

    Parameters
    ----------
    problem : Problem
        What is fitted.
    values : (n,) array
        The point, SI, in the order of the model's names.
    names : tuple of str
        Parameters that vary and whose branch is reached.
    slopes : (n_data, k) array
        `Problem.slopes` there.
    noise : mapping
        One standard deviation of each counted curve, SI; of noise that is not white, the root of
        its autocorrelation time larger.
    """
    objective = problem.objective
    n, at = objective.time.size, 0
    scaled = np.zeros((len(objective.counted) * n, len(names)))
    for c, curve in enumerate(objective.counted):
        kept = objective.kept(curve)
        weighed = objective.weights[curve] ** 0.5 / objective.scale[curve]
        rows = slopes[at : at + kept.size] * problem.sizes(names, values)
        scaled[c * n + kept] = rows / (weighed * noise[curve])
        at += kept.size
    simulated = objective.simulate(values, everything=True)
    lost = unreached(problem, values)
    return Insight(
        names=names,
        values=np.array([values[problem.index[name]] for name in names]),
        sizes=problem.sizes(names, values),
        curves=objective.counted,
        clock=objective.time,
        timed=problem.measurement.time is not None,
        scaled=scaled,
        sections=sections(problem, simulated),
        silent=tuple(name for name in problem.free() if name in lost),
    )


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _product(names: list[str], powers: Array) -> str:
    """Write Π p_i^e_i with the largest power 1: "s2_k0·s1_k0^0.43/s1_height^0.57"."""
    powers = powers / powers[np.argmax(np.abs(powers))]
    above: list[str] = []
    below: list[str] = []
    for name, power in sorted(zip(names, powers, strict=True), key=lambda item: -abs(item[1])):
        shown = f"{abs(power):.2f}".rstrip("0").rstrip(".")
        if abs(power) < PART:
            continue
        text = name if shown == "1" else f"{name}^{shown}"
        (above if power > 0.0 else below).append(text)
    product = "·".join(above)
    if not below:
        return product
    return f"{product}/({'·'.join(below)})" if len(below) > 1 else f"{product}/{below[0]}"
