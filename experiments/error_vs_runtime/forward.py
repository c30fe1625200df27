"""How much time does a simulation of given accuracy take? Error against run time, by scene.

Method and answer: README.md. All solvers of a scene alternate in one process, and processor time is
measured, so that a busy machine affects all of them equally; ratios compare medians of one run. A
table and a figure per scene and summary.csv go to `forward/`.

    python experiments/error_vs_runtime/forward.py                      # all: about 5 minutes
    python experiments/error_vs_runtime/forward.py one_spring_impact    # some scenes, no page
"""

import math
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from timeit import timeit
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

import foamfit as ff
from foamfit.solve.plan import plan
from foamfit.springs.chain import Drive

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
import with_scipy
from independent import follow
from studies import BLACK, BLUE, GREEN, ORANGE, SKY, VERMILION, Array

HERE = Path(__file__).parent
Answer = tuple[Array, Array]  # displacement of the top (m) and base stress (Pa), (n,) each

SAMPLES, LENGTH = 501, 0.8e-3
MASS = 7e-3
MODEL_2, MODEL_3 = ff.published["foam-1/model-2"], ff.published["foam-1/model-3"]
HEIGHT, AREA = MODEL_2.chain.height, MODEL_2.chain.area

PUBLIC, KERNEL, SCIPY, HEYOKA = "foamfit simulate", "foamfit kernel", "SciPy", "heyoka"
WANTED = 2e-6  # the error at which solvers are compared
ROUNDS = 15  # turns of all solvers of a scene
SHORTEST = 2e-3  # s; shorter runs are timed in groups
BRIEF = 1e-2  # s; shorter runs are preceded by an untimed run
FLOOR = 1e-16  # a zero error is drawn here
TIMES = ["median (s)", "lower quartile (s)", "upper quartile (s)"]
# Markers also distinguish solvers, besides colours.
SOLVERS: dict[str, dict[str, Any]] = {
    PUBLIC: {"color": BLUE, "marker": "o", "linewidth": 1.6},
    KERNEL: {"color": VERMILION, "marker": "D", "linewidth": 1.6},
    HEYOKA: {"color": GREEN, "marker": "*", "markersize": 6},
    f"{SCIPY} DOP853": {"color": BLACK, "marker": "s"},
    f"{SCIPY} LSODA": {"color": SKY, "marker": "^"},
    f"{SCIPY} Radau": {"color": ORANGE, "marker": "v"},
}


def powers(first: int, last: int) -> tuple[float, ...]:
    return tuple(10.0**-k for k in range(first, last))


class Scene(NamedTuple):
    """A chain under a drive, and the settings of each solver.

    `own` and `outside` are tolerances of foamfit and of SciPy; without the latter SciPy is left
    out. No setting is tried after one that takes `longest` (s).
    """

    name: str
    title: str
    chain: ff.Chain
    drive: Drive
    time: Array
    own: Sequence[float] = powers(2, 13)
    outside: Sequence[float] = powers(3, 13)
    longest: float = 0.3


def graded(count: int, mass: float = 0.0, eta: float = 0.0) -> ff.Chain:
    """Return springs of foam-1/model-2 with k0, k_c, Δσ, k_h±, ε_a, ε_c varied by ±10 %, shuffled.

    No two of them switch at the same stress. `mass` (kg) is divided among the nodes between them.
    """
    rng = np.random.default_rng(count)
    steps = 0.1 * (2.0 * (np.arange(count) + 0.5) / count - 1.0)
    base = MODEL_2.bistable
    springs = [
        ff.BistableSpring(
            base.k0 * f, base.kc * f, base.dsigma * f, base.eps_a * g, base.eps_c * g,
            base.kh_plus * f, base.kh_minus * f, eta,
        )
        for f, g in zip(1 + rng.permutation(steps), 1 + rng.permutation(steps), strict=True)
    ]  # fmt: skip
    masses = [mass / max(count - 1, 1)] * (count - 1) + [0.0]
    return ff.Chain(springs, [HEIGHT / count] * count, AREA, masses)


def scenes() -> list[Scene]:
    """Return scenes of bistable springs, and of a microscale spring like shoe foam."""
    t = np.linspace(0.0, LENGTH, SAMPLES)
    one, two = ff.Chain([MODEL_2.bistable], [HEIGHT], AREA), MODEL_3.chain
    law = (5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77)
    height, area = 25e-3, 1.6e-3
    plain, slow, quick = (
        ff.MicroscaleSpring(*law, relaxation=each) for each in ((), [(0.5, 0.2)], [(0.5, 0.01)])
    )
    struck, pressed = np.linspace(0.0, 0.08, SAMPLES), np.linspace(0.0, 2.0, 1280)
    motion = 0.6 * height * np.sin(np.pi * pressed) ** 2 * np.where(pressed < 1.0, 1.0, 0.8)
    on_linear = ff.Chain([ff.LinearSpring(5e6), quick], [0.2 * height, 0.8 * height], area)
    return [
        Scene("one_spring_impact", "one spring, impact at 2.0 m/s", one, ff.Impact(MASS, 2.0), t),
        Scene("two_springs_mass_impact",
              "two springs with the specimen's mass between, onsite damper, impact at 2.3 m/s",
              two, ff.Impact(MASS, 2.3), t, outside=powers(3, 12), longest=1.0),
        Scene("10_springs_mass_impact",
              "10 springs with dashpots of 2 Pa·s and 9 masses between, impact at 2.2 m/s",
              graded(10, MODEL_2.specimen_mass, 2.0), ff.Impact(MASS, 2.2), t,
              outside=powers(5, 11), longest=0.6),
        Scene("1000_springs_impact", "1000 springs, impact at 2.2 m/s", graded(1000),
              ff.Impact(MASS, 2.2), t, own=(1e-6, 1e-10), outside=(), longest=4.0),
        Scene("microscale_impact", "one microscale spring, impact at 1.5 m/s",
              ff.Chain([plain], [height], area), ff.Impact(2.0, 1.5), struck),
        Scene("microscale_relaxation_displacement",
              "one microscale spring with a relaxation term, displacement drive of two cycles",
              ff.Chain([slow], [height], area), ff.DisplacementDrive(motion), pressed, outside=()),
        Scene("linear_microscale_relaxation_impact",
              "a microscale spring with a relaxation term on a linear one, impact at 1.5 m/s",
              on_linear, ff.Impact(2.0, 1.5), struck),
    ]  # fmt: skip


def solvers(scene: Scene) -> dict[str, dict[float, Callable[[], Answer]]]:
    """Return all solvers of a scene, and the runs of each by tolerance.

    They are `simulate` and the bare `Plan.run` that a fit calls, SciPy's integrators, and for an
    impact on one bistable spring heyoka, if it is installed.
    """
    given = scene.chain, scene.drive, scene.time

    def public(rtol: float) -> Answer:
        response = ff.simulate(*given, rtol)
        return response.displacement[-1], response.base_stress

    runs = {name: {rtol: partial(run, rtol) for rtol in scene.own}
            for name, run in ((PUBLIC, public), (KERNEL, kernel(*given)))}  # fmt: skip
    if scene.outside:
        impact = with_scipy.Impact(*given)
        for method in with_scipy.METHODS:
            own = {rtol: partial(impact.run, method, rtol) for rtol in scene.outside}
            runs[f"{SCIPY} {method}"] = own
    if scene.name == "one_spring_impact" and find_spec("heyoka"):
        import with_heyoka

        tolerances = (*scene.own, 1e-15)
        runs[HEYOKA] = {tol: with_heyoka.Impact(*given, tol).run for tol in tolerances}
    return runs


def kernel(chain: ff.Chain, drive: Drive, time: Array) -> Callable[..., Answer]:
    """Return the bare simulation that a fit calls, as a function of rtol."""
    made, (rows, heights, *_) = plan(chain, drive, time), chain.arrays

    def run(rtol: float = 1e-6) -> Answer:
        motion = made.run(rows, heights, rtol, everything=False)
        return motion.displacement[-1], motion.base_stress

    return run


def reference(scene: Scene) -> Answer:
    """Return the result of the judge of the stability study, some 14 digits."""
    most = 10_000_000 * len(scene.chain.springs)
    truth = follow(scene.chain, scene.drive, scene.time, most=most)
    assert not truth.why
    return truth.displacement[-1], truth.base_stress


def error_of(answer: Answer, truth: Answer) -> float:
    """Return the largest error over range of top displacement and base stress."""
    pairs = zip(answer, truth, strict=True)
    misses = [np.abs(got - want).max() / np.ptp(want) for got, want in pairs]
    return float(max(misses)) if np.isfinite(misses).all() else math.inf


def seconds(run: Callable[[], object], times: int = 1) -> float:
    """Return the processor time of a run, s."""
    return timeit(run, timer=time.process_time, number=times) / times


def measure(scene: Scene) -> pd.DataFrame:
    """Return error and time of every solver in a scene at every tolerance; they take turns."""
    truth, found = reference(scene), list[tuple[dict[str, Any], Callable[[], Answer], float]]()

    def timed(run: Callable[[], Answer], first: float) -> float:
        if first < BRIEF:  # the previous run has displaced the caches
            run()
        return seconds(run, max(1, round(SHORTEST / first)))

    for solver, runs in solvers(scene).items():
        for tolerance, run in runs.items():
            try:
                error, first = error_of(run(), truth), seconds(run)  # the first compiles
            except (RuntimeError, ff.SimulationError):  # unstable, or past a pole
                continue
            if error < 1.0:
                about = {"solver": solver, "setting": f"rtol = {tolerance:.0e}", "error": error}
                found.append((about, run, first))
            if first > scene.longest:
                break
    took = [[timed(run, first) for _, run, first in found] for _ in range(ROUNDS)]
    quartiles = pd.DataFrame(np.percentile(took, [50, 25, 75], axis=0).T, columns=TIMES)
    return pd.DataFrame(about for about, *_ in found).join(quartiles)


def draw_scene(table: pd.DataFrame, title: str, path: Path) -> None:
    """Plot error over median time of every solver of a scene, with quartiles of time."""
    with studies.sheet(path, 5.6, 3.1) as figure:
        ax = figure.add_subplot()
        ax.axhline(WANTED, color="0.75", linewidth=0.8, zorder=0)
        for solver, look in SOLVERS.items():
            part = table[table["solver"] == solver]
            if len(part):
                middle, low, high = (part[name] for name in TIMES)
                look = {"linewidth": 1.0, "markersize": 4, **look}
                error = part["error"].clip(lower=FLOOR)
                spread = [middle - low, high - middle]
                ax.errorbar(middle, error, xerr=spread, elinewidth=0.6, label=solver, **look)
        ax.set(xscale="log", yscale="log", xlabel="processor time of one run (s)")
        ax.set(ylim=(FLOOR / 3, 1.0), yticks=[10.0**k for k in range(-16, 1, 2)])
        ax.set_ylabel("largest error over range (–)")
        studies.gridlines(ax)
        figure.suptitle(textwrap.fill(title, 60), fontsize=8)
        ax.annotate(
            f"{WANTED:.0e}".replace("e-0", "e-"), (ax.get_xlim()[1], WANTED), (-2, 2), color="0.5",
            ha="right", textcoords="offset points", fontsize=6.5,
        )  # fmt: skip
        figure.legend(loc="outside right center")


def compare(scene: Scene, table: pd.DataFrame) -> dict[str, object]:
    """Return one row of the summary: the fastest setting of each solver with an error < WANTED."""
    reached, row = table[table["error"] < WANTED], dict[str, object](scene=scene.title)
    columns = {"simulate": PUBLIC, "kernel": KERNEL, "SciPy": SCIPY, "heyoka": HEYOKA}
    for column, family in columns.items():
        part = reached[reached["solver"].str.startswith(family)]
        row[f"{column} (s)"] = part[TIMES[0]].min()
    for name in ("simulate", "kernel"):
        row[f"SciPy / {name}"] = row["SciPy (s)"] / row[f"{name} (s)"]
    return row


def main() -> None:
    """Measure and draw the scenes; write the page if all were asked for."""
    parser = studies.arguments(__doc__, HERE)
    parser.add_argument("scenes", nargs="*", help="names; left out = all, and the page")
    options = parser.parse_args()
    threadpool_limits(1)  # processor time of one thread
    folder, rows, figures = options.out / "forward", list[dict[str, object]](), list[str]()
    folder.mkdir(parents=True, exist_ok=True)
    for scene in scenes():
        if scene.name not in (options.scenes or [scene.name]):
            continue
        table = measure(scene)
        studies.write_csv(table, folder / f"{scene.name}.csv")
        draw_scene(table, scene.title, folder / f"{scene.name}.png")
        figures.append(f"![Error against run time: {scene.title}](forward/{scene.name}.png)")
        rows.append(compare(scene, table))
        print(rows[-1], flush=True)
    if options.scenes:
        return
    summary = pd.DataFrame(rows)
    studies.write_csv(summary, folder / "summary.csv")
    optional = [HEYOKA] if find_spec(HEYOKA) else []
    studies.write_page(
        HERE, options.out, wanted=f"{WANTED:g}", table=studies.shown(summary),
        where=studies.circumstances("NumPy", "SciPy", "numba", "foamfit", *optional),
        figures="\n\n".join(figures),
    )  # fmt: skip


if __name__ == "__main__":
    main()
