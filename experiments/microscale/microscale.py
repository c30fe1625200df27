"""Do discrete micro-springs converge to the microscale spring, and do their inner loops close?

Method. n micro-springs in series, at the ranks (j - 1/2)/n, each with branches a and c of one
spring and snap stresses of its own, are followed from event to event: between events the stress
alone says the strain, and at an event one micro-spring snaps. Stress is prescribed, with partial
unloading and partial reloading. The law of `foamfit.MicroscaleSpring` is what they should come to.

Answer. Their largest difference in strain falls as 1/n, and inner loops close to 1e-15: README.md.

    python experiments/microscale/microscale.py
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

import foamfit as ff

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402

Array = NDArray[np.float64]

SPRING = ff.MicroscaleSpring(
    k0=5.5e5, kc=2.5e5, eps_star=0.08, sigma_plus=1.3e5, spread_plus=0.4, sigma_minus=5.5e4,
    spread_minus=0.77,
)  # fmt: skip
NUMBERS = (2, 3, 5, 10, 20, 30, 50, 100, 200, 300, 500, 1000)
SHOWN = 10
# Turning points of the stress, Pa: a loop, two inner loops in it, one in an inner loop, and on.
TURNS = (0.0, 1.6e5, 6e4, 1.2e5, 8e4, 1.2e5, 6e4, 1.6e5, 2.5e5, 1.5e4, 1.2e5, 4e4, 2.5e5, 0.0)
BETWEEN = 400  # samples between turning points, for comparing


class Chain:
    """Micro-springs in series, each on branch a or c; the lowest ranks are on c."""

    def __init__(self, spring: ff.MicroscaleSpring, n: int) -> None:
        ranks = norm.ppf((np.arange(n) + 0.5) / n)
        self.spring, self.n, self.snapped = spring, n, 0
        self.plus = spring.sigma_plus * np.exp(spring.spread_plus * ranks)
        # one that would come back at a higher stress than it snaps at does both at the same
        self.minus = np.minimum(self.plus, spring.sigma_minus * np.exp(spring.spread_minus * ranks))

    def strain(self, stress: float) -> float:
        """Mean strain of the micro-springs at a stress."""
        s, p = self.spring, self.snapped / self.n
        on_a, on_c = stress / (s.k0 + stress), s.eps_star + stress / (s.kc + stress)
        return (1.0 - p) * on_a + p * on_c

    def event(self, stress: float, target: float) -> float | None:
        """Stress of the next event on the way from a stress to another, if there is one."""
        if target > stress:
            there = self.snapped < self.n and self.plus[self.snapped] <= target
            return max(float(self.plus[self.snapped]), stress) if there else None
        there = self.snapped > 0 and self.minus[self.snapped - 1] > target
        return min(float(self.minus[self.snapped - 1]), stress) if there else None

    def follow(self, history: Array) -> tuple[Array, Array, Array]:
        """Strain at each stress of a history, and strain and stress before and after each event."""
        out, path, stress = np.empty(history.size), [(0.0, 0.0)], 0.0
        for j, target in enumerate(history):
            up = target > stress
            while (at := self.event(stress, float(target))) is not None:
                path.append((self.strain(at), at))
                self.snapped += 1 if up else -1
                path.append((self.strain(at), at))
                stress = at
            stress = float(target)
            out[j] = self.strain(stress)
            path.append((out[j], stress))
        return out, *np.array(path).T


def history(between: int = BETWEEN) -> Array:
    """Stresses through all turning points."""
    legs = [np.linspace(a, b, between + 1)[1:] for a, b in pairwise(TURNS)]
    return np.concatenate([[0.0], *legs])


def errors(n: int) -> tuple[float, float]:
    """Largest and RMS difference of strain between n micro-springs and the law."""
    stress = history()
    miss = Chain(SPRING, n).follow(stress)[0] - SPRING.strain(stress)
    return float(np.abs(miss).max()), float(np.sqrt(np.mean(miss**2)))


def returns(n: int | None) -> float:
    """Largest difference of strain where an inner loop comes back to the stress it left at."""
    turns = np.array(TURNS)
    strain = SPRING.strain(turns) if n is None else Chain(SPRING, n).follow(turns)[0]
    # the second visit of a turning point, with nothing beyond it in between
    return max(abs(strain[b] - strain[a]) for a, b in ((1, 7), (2, 6), (3, 5), (8, 12)))


def rate(table: list[tuple[int, float, float]], column: int) -> float:
    """Slope of a straight line through the logarithms of an error and of n."""
    n, error = np.log([row[0] for row in table]), np.log([row[column] for row in table])
    return float(np.polyfit(n, error, 1)[0])


def draw(table: list[tuple[int, float, float]], path: Path) -> None:
    """The loops of a few micro-springs on those of the law, and the error against their number."""
    black, blue, vermilion, grey = studies.BLACK, studies.BLUE, studies.VERMILION, studies.GREY
    with studies.sheet(path, 7.0, 3.0, 150) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.35, 1.0))
        _, strain, stress = Chain(SPRING, SHOWN).follow(np.array(TURNS))

        along = history()
        left.plot(100 * SPRING.strain(along), along / 1e3, color=black, lw=1.6, label="the law")
        left.plot(100 * strain, stress / 1e3, color=blue, lw=0.9, label=f"{SHOWN} micro-springs")
        left.set(xlabel="strain (%)", ylabel="stress (kPa)", title="(a) a loop with inner loops")
        left.legend(loc="upper left")
        n = np.array([row[0] for row in table])
        for column, color, label in ((1, vermilion, "largest"), (2, blue, "RMS")):
            values = [row[column] for row in table]
            right.loglog(n, values, "o-", color=color, ms=3, lw=1, label=label)
        right.loglog(n, 0.3 * table[0][1] * n[0] / n, "--", color=grey, lw=0.8, label="1/n")
        right.set(xlabel="micro-springs n", ylabel="difference in strain", title="(b) convergence")
        right.legend()


def main() -> None:
    table = [(n, *errors(n)) for n in NUMBERS]
    names = ("micro-springs", "largest difference", "RMS difference")
    rows = [dict(zip(names, row, strict=True)) for row in table]
    studies.write_csv(rows, HERE / "microscale.csv", 6)
    draw(table, HERE / "microscale.png")
    lines = ((n, f"{a:.2e}", f"{b:.2e}", f"{a * n:.3f}") for n, a, b in table)
    studies.write_page(
        HERE, rate_largest=-rate(table, 1), rate_rms=-rate(table, 2), last=table[-1][1],
        most=NUMBERS[-1], returns_law=returns(None),
        returns_chain=max(returns(n) for n in NUMBERS), table=studies.lines(lines),
    )  # fmt: skip


if __name__ == "__main__":
    studies.arguments(__doc__).parse_args()
    studies.run(main, HERE)
