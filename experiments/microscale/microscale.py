"""Do discrete micro-springs converge to the microscale spring, and do their inner loops close?

Method and answer: README.md. Also written: microscale.png.

    python experiments/microscale/microscale.py
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.special import ndtri

import foamfit as ff

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from studies import BLACK, BLUE, GREY, VERMILION, Array

HERE = Path(__file__).parent

K0, KC, EPS_STAR, SIGMA_PLUS, SPREAD_PLUS, SIGMA_MINUS, SPREAD_MINUS = VALUES = (
    5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77,
)  # fmt: skip
SPRING = ff.MicroscaleSpring(*VALUES)
NUMBERS = (2, 3, 5, 10, 20, 30, 50, 100, 200, 300, 500, 1000)
SHOWN = 10
# Turning points of the stress, Pa: a loop with two inner loops, one nested, and continuation.
TURNS = (0.0, 1.6e5, 6e4, 1.2e5, 8e4, 1.2e5, 6e4, 1.6e5, 2.5e5, 1.5e4, 1.2e5, 4e4, 2.5e5, 0.0)
BETWEEN = 400  # samples between turning points, for the comparison


def followed(n: int, history: Array) -> Array:
    """Return the mean strain of n micro-springs, of equal shares, at each stress of a history."""
    ranks = ndtri((np.arange(n) + 0.5) / n)
    through = SIGMA_PLUS * np.exp(SPREAD_PLUS * ranks)
    back = np.minimum(SIGMA_MINUS * np.exp(SPREAD_MINUS * ranks), through)
    snapped, last, share = np.zeros(n, bool), 0.0, np.empty(history.size)
    for j, stress in enumerate(history):
        snapped = snapped | (stress >= through) if stress >= last else snapped & (stress >= back)
        last, share[j] = stress, snapped.mean()
    on_a, on_c = history / (K0 + history), EPS_STAR + history / (KC + history)
    return on_a + share * (on_c - on_a)


def history(between: int = BETWEEN) -> Array:
    """Return the stresses through all turning points."""
    legs = [np.linspace(a, b, between + 1)[1:] for a, b in pairwise(TURNS)]
    return np.concatenate([[0.0], *legs])


def error(n: int) -> float:
    """Return the largest difference of strain between n micro-springs and the law."""
    stress = history()
    return float(np.abs(followed(n, stress) - SPRING.strain(stress)).max())


def returns(n: int | None) -> float:
    """Return the largest difference of strain where an inner loop closes in stress."""
    turns = np.array(TURNS)
    strain = SPRING.strain(turns) if n is None else followed(n, turns)
    # second visit of a turning point that was not exceeded in between
    return max(abs(strain[b] - strain[a]) for a, b in ((1, 7), (2, 6), (3, 5), (8, 12)))


def rate(errors: dict[int, float]) -> float:
    """Return the slope of log error over log n."""
    return float(np.polyfit(np.log(list(errors)), np.log(list(errors.values())), 1)[0])


def draw(errors: dict[int, float], path: Path) -> None:
    """Draw loops of a few micro-springs on those of the law, and the error against n."""
    with studies.sheet(path, 7.0, 3.0, 150) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.35, 1.0))
        along = history()
        left.plot(100 * SPRING.strain(along), along / 1e3, color=BLACK, lw=1.6, label="the law")
        few = 100 * followed(SHOWN, along)
        left.plot(few, along / 1e3, color=BLUE, lw=0.9, label=f"{SHOWN} micro-springs")
        left.set(xlabel="strain (%)", ylabel="stress (kPa)", title="(a) a loop with inner loops")
        left.legend(loc="upper left")
        n, values = np.array(list(errors)), np.array(list(errors.values()))
        right.loglog(n, values, "o-", color=VERMILION, ms=3, lw=1, label="largest")
        right.loglog(n, 0.5 * values[0] * n[0] / n, "--", color=GREY, lw=0.8, label="1/n")
        right.set(xlabel="micro-springs n", ylabel="difference in strain", title="(b) convergence")
        right.legend()


def main() -> None:
    errors = {n: error(n) for n in NUMBERS}
    draw(errors, HERE / "microscale.png")
    rows = ((n, f"{size:.2e}", f"{size * n:.3f}") for n, size in errors.items())
    studies.write_page(
        HERE, rate=-rate(errors), last=errors[NUMBERS[-1]], most=NUMBERS[-1],
        returns_law=returns(None), returns_chain=max(map(returns, NUMBERS)),
        table=studies.lines(rows),
    )  # fmt: skip


if __name__ == "__main__":
    studies.arguments(__doc__).parse_args()
    main()
