"""Which steps does the solver take through one impact? The figure of the solver in the theory.

Method. The published model-1 is struck at 2 m/s. The run is repeated with a bound of 1, 2, … steps,
whose ends are where it is cut off. Synthetic: a simulation of published parameters.

    python experiments/error_vs_runtime/steps.py        # writes docs/_static/steps.png, in seconds
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import foamfit as ff
from foamfit.solve.compiled import loop
from foamfit.solve.plan import NO_DIRECTIONS, plan

sys.path.insert(0, str(Path(__file__).parents[1]))
from studies import BLUE, ORANGE

OUT = Path(__file__).parents[2] / "docs" / "_static" / "steps.png"
HEIGHT, AREA = 1.19e-3, 1.9635e-5
IMPACT = ff.Impact(7e-3, 2.0)
RTOL = 1e-6


def step_ends(chain: ff.Chain, time: np.ndarray) -> np.ndarray:
    """Return the times at which the steps of an impact end, s."""
    ends: list[float] = []
    rows, heights = chain.arrays[:2]
    for most in range(2, 200):
        scene = plan(chain, IMPACT, time, max_steps=most)._replace(implicit=False)
        out, log, endings = np.empty((1, 2, time.size)), np.empty((0, 5)), np.empty(loop.ENDINGS)
        reals = scene._reals(rows, heights, RTOL, 0.0)
        scene._integrate(rows, heights, b"\0", NO_DIRECTIONS, out, log, endings, reals)
        ends.append(endings[loop.ENDED])
        if endings[loop.OUTCOME] == 0.0:
            break
    return np.unique(ends)


def main() -> None:
    """Draw the figure."""
    chain = ff.Chain([ff.published["foam-1/model-1"].bistable], [HEIGHT], AREA)
    time = np.linspace(0.0, 8e-4, 1601)
    got = ff.simulate(chain, IMPACT, time, RTOL)
    ends = step_ends(chain, time)
    figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    axes.plot(1e3 * time, 1e-6 * got.base_stress, color=BLUE, label="dense output")
    at_ends = np.interp(ends, time, got.base_stress)
    axes.plot(1e3 * ends, 1e-6 * at_ends, "o", color=BLUE, markersize=4, label="ends of steps")
    for k, (when, _, left, entered, _) in enumerate(got.switches):
        axes.axvline(1e3 * when, color=ORANGE, linewidth=1, label="" if k else "change of branch")
        names = chain.laws[0].named_branch(int(left)), chain.laws[0].named_branch(int(entered))
        axes.annotate(
            "{} → {}".format(*names), (1e3 * when, 0.97), xycoords=("data", "axes fraction"),
            xytext=(3, 0), textcoords="offset points", va="top", color=ORANGE, fontsize=9,
        )  # fmt: skip
    axes.set(xlabel="time (ms)", ylabel="base stress (MPa)", xlim=(0.0, 0.8), ylim=(-0.3, 5.9))
    axes.legend(frameon=False, loc="center right")
    OUT.parent.mkdir(exist_ok=True)
    figure.savefig(OUT, dpi=150)


if __name__ == "__main__":
    main()
