"""The branches of the springs along a simulated run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from foamfit.springs.parameters import split_name

if TYPE_CHECKING:
    from foamfit.fitting.objective import Simulated
    from foamfit.fitting.problem import Problem

FLIGHT = "free flight"


def visited(problem: Problem, simulated: Simulated) -> dict[str, tuple[str, ...]]:
    """Return the branches that each spring has visited, in the order of the first visit.

    Each spring starts at rest, even if it is on another branch at the first sample.
    """
    laws = problem.model.laws
    seen = {i: [next(iter(law.branches))] for i, law in enumerate(laws)}
    for _, spring, *numbers, _ in simulated.motion.switches:
        for number in numbers:
            name = laws[int(spring)].named_branch(int(number))
            if name not in seen[int(spring)]:
                seen[int(spring)].append(name)
    return {f"s{i + 1}": tuple(names) for i, names in seen.items()}


def covered(seen: tuple[str, ...]) -> tuple[str, ...]:
    """Return the branches about which visits to `seen` carry information.

    On the reversible branch of a microscale spring some micro-springs snap through as well.
    """
    return (*seen, "snap-through") if "reversible" in seen else seen


def unreached(problem: Problem, simulated: Simulated) -> dict[str, str]:
    """Return the parameters without a prior whose branch was never reached, and that branch."""
    seen, known = visited(problem, simulated), {one.name for one in problem.objective.priors}
    out = {}
    for name in problem.model.names:
        if name in known:
            continue
        spring = split_name(name)[0]
        branch = problem.model.param(name).branch if spring >= 0 else ""
        if branch and branch not in covered(seen[f"s{spring + 1}"]):
            out[name] = branch
    return out


def silent(problem: Problem, simulated: Simulated, names: Iterable[str]) -> set[str]:
    """Return those of the `unreached` parameters that moved no branch which was reached."""
    seen = visited(problem, simulated)

    def moved(name: str) -> bool:
        branch, spring = problem.model.param(name).moves, split_name(name)[0]
        return branch in covered(seen[f"s{spring + 1}"])

    return {name for name in names if not moved(name)}


def _states(problem: Problem, simulated: Simulated) -> list[tuple[int, dict[int, str]]]:
    """Return the branches of the hysteretic springs (0 = base), and the sample where they begin."""
    laws = problem.model.laws
    state = {i: next(iter(law.branches)) for i, law in enumerate(laws) if law.hysteretic}
    out = [(0, dict(state))]
    for when, spring, _, entered, _ in simulated.motion.switches:
        if int(spring) in state:
            state[int(spring)] = laws[int(spring)].named_branch(int(entered))
            out.append((int(np.searchsorted(problem.objective.time, when)), dict(state)))
    return out


def sections(problem: Problem, simulated: Simulated) -> list[str]:
    """Return the branches at each sample, base first ("d", "a·c"), or free flight."""
    clock, contact_end = problem.objective.time, simulated.motion.contact_end
    words = np.empty(clock.size, dtype=object)
    for at, on in _states(problem, simulated):
        words[at:] = "·".join(on.values()) or "line"
    if np.isfinite(contact_end):
        words[int(np.searchsorted(clock, contact_end, side="right")) :] = FLIGHT
    return words.tolist()


def branch_of_samples(problem: Problem, simulated: Simulated) -> NDArray[np.str_]:
    """Return the branches of the springs at each sample in words, (n,).

    For example "loading, spring 1 on d". Loading ends at the peak of the measured stress.
    """
    stress = problem.measurement.stress
    words = np.empty(problem.objective.time.size, dtype=object)
    for at, on in _states(problem, simulated):
        words[at:] = " and ".join(f"spring {i + 1} on {branch}" for i, branch in on.items())
    loading = np.arange(words.size) <= np.argmax(stress)
    return (np.where(loading, "loading, ", "unloading, ").astype(object) + words).astype(str)
