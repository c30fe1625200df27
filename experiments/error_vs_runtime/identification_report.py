"""Table, figures and page of the recorded runs of `identification.py`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from foamfit.report.figures import STYLE

Array = NDArray[np.float64]

SOLVED = 1.05  # cost over the best known cost at which a problem counts as solved
COLUMNS = ["problem", "coordinates", "method", "seed", "seconds", "evaluations", "cost"]
OWN = "foamfit.fit"
LEAST_SQUARES = ("leastsq", "least_squares")
GROUPS = {
    "least squares": LEAST_SQUARES,
    "direct": ("nelder", "powell"),
    "global": ("differential_evolution", "basinhopping", "dual_annealing", "ampgo"),
}
METHODS = tuple(name for group in GROUPS.values() for name in group)
COORDINATES = {
    "si": "lmfit.Parameters in SI, bounds of make_params",
    "box": "lmfit.Parameters in the coordinates of foamfit's search",
}
# Colours that all can tell apart (Okabe & Ito, and two more); lines differ in their dashes too.
STYLES: dict[str, tuple[str, str]] = {
    OWN: ("#0072B2", "-"),
    "leastsq": ("black", "-"),
    "least_squares": ("#56B4E9", "--"),
    "nelder": ("#009E73", "-"),
    "powell": ("#999933", "--"),
    "differential_evolution": ("#D55E00", "-"),
    "basinhopping": ("#E69F00", "--"),
    "dual_annealing": ("#CC79A7", "-."),
    "ampgo": ("#6b6b6b", ":"),
}


@dataclass(frozen=True)
class Setup:
    """What was run, and where.

    Attributes
    ----------
    machine : dict of str
        Processor and versions.
    budget_s : float
        Longest time of a run, s.
    seeds : int
        Runs of each method on each problem.
    derivatives : str
        Whose the derivatives of leastsq and least_squares were: a key of `SLOPES`.
    titles, known : dict
        Of each problem that was run: its title and its best known cost.
    """

    machine: dict[str, str]
    budget_s: float
    seeds: int
    derivatives: str
    titles: dict[str, str]
    known: dict[str, float]

    @classmethod
    def read(cls, path: Path) -> Setup:
        """Read what `write` wrote."""
        return cls(**json.loads(path.read_text()))

    def write(self, path: Path) -> None:
        """Write it as JSON."""
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")


# ---------------------------------------------------------------- table


def solved_after(runs: pd.DataFrame, known: dict[str, float]) -> pd.DataFrame:
    """One row for each run: seconds until it was solved (inf if never) and how it ended."""
    rows = []
    keys = ["problem", "coordinates", "method", "seed"]
    for (problem, coordinates, method, seed), run in runs.groupby(keys, sort=False):
        reached = run[run["cost"] <= SOLVED * known[str(problem)]]
        rows.append(
            {
                "problem": problem,
                "coordinates": coordinates,
                "method": method,
                "seed": seed,
                "solved_after_s": reached["seconds"].iloc[0] if len(reached) else np.inf,
                "misfit_ratio": (run["cost"].iloc[-1] / known[str(problem)]) ** 0.5,
                "ended_after_s": run["seconds"].iloc[-1],
                "evaluations": run["evaluations"].iloc[-1],
            }
        )
    return pd.DataFrame(rows)


def tabulate(ends: pd.DataFrame) -> pd.DataFrame:
    """One row for each problem and method: how many seeds it solved, how fast, how far it came."""
    rows = []
    keys = ["problem", "coordinates", "method"]
    for (problem, coordinates, method), runs in ends.groupby(keys, sort=False):
        # inf - inf is no number: quartiles of times by rank, not by interpolation
        low, middle, high = np.quantile(
            runs["solved_after_s"], (0.25, 0.5, 0.75), method="inverted_cdf"
        )
        rows.append(
            {
                "problem": problem,
                "coordinates": coordinates,
                "method": method,
                "solved": int(np.isfinite(runs["solved_after_s"]).sum()),
                "seeds": len(runs),
                "solved after, quartile 1 (s)": low,
                "solved after, median (s)": middle,
                "solved after, quartile 3 (s)": high,
                "misfit over best known at the end, median": runs["misfit_ratio"].median(),
                "misfit over best known at the end, worst": runs["misfit_ratio"].max(),
                "evaluations per second, median": (
                    runs["evaluations"] / runs["ended_after_s"]
                ).median(),
            }
        )
    return pd.DataFrame(rows)


def profile(ends: pd.DataFrame, coordinates: str) -> dict[str, Array]:
    """Performance ratios of each method over all problem-seeds (Dolan & Moré 2002, eq. 1).

    The ratio is the time a method took to solve a problem from a seed, over the shortest time of
    all methods there; inf where it did not.
    """
    among = ends[ends["coordinates"].isin(("own", coordinates))]
    times = among.pivot_table(
        index=["problem", "seed"], columns="method", values="solved_after_s", sort=False
    ).replace(np.nan, np.inf)
    best = times.min(axis=1)
    ratios = times.div(best.where(np.isfinite(best), 1.0), axis=0)
    return {name: ratios[name].to_numpy() for name in STYLES if name in ratios}


# ---------------------------------------------------------------- figures


def draw_profiles(ends: pd.DataFrame, setup: Setup, path: Path) -> None:
    """Share of problem-seeds solved within a factor of the shortest time."""
    shown = [c for c in COORDINATES if c in set(ends["coordinates"])]
    ratios = {coordinates: profile(ends, coordinates) for coordinates in shown}
    finite = [r[np.isfinite(r)] for panel in ratios.values() for r in panel.values()]
    last = 10.0 ** np.ceil(np.log10(1.05 * np.concatenate([[5.0], *finite]).max()))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(3.5 * len(shown), 3.6), layout="constrained")
        panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
        for axes, coordinates in zip(panels, shown, strict=True):
            for name in reversed(ratios[coordinates]):  # the project's own on top
                mine = ratios[coordinates][name]
                steps = np.sort(mine[np.isfinite(mine)])
                share = np.arange(steps.size + 1) / mine.size
                axes.step([1.0, *steps, last], [*share, share[-1]], where="post", **_line(name))
            axes.set(xscale="log", xlim=(1.0, last), ylim=(-0.02, 1.02))
            axes.set_title(COORDINATES[coordinates])
            axes.set_xlabel("processor time over the shortest, τ (–)")
            _grid(axes)
        panels[0].set_ylabel("share of problem-seeds solved within τ (–)")
        figure.suptitle(
            f"{setup.seeds * len(setup.known)} problem-seeds; solved: cost within 5 % of the best "
            f"known, in at most {setup.budget_s:g} s",
            fontsize=8,
        )
        _legend(figure, set(ends["method"]))
        figure.savefig(path, dpi=200)


def draw_curves(runs: pd.DataFrame, coordinates: str, setup: Setup, path: Path) -> None:
    """Misfit over the best known against seconds: median and quartiles over the seeds."""
    count = len(setup.known)
    elapsed = np.geomspace(0.01, setup.budget_s, 200)
    among = runs[runs["coordinates"].isin(("own", coordinates))]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 1.7 * count + 0.9), layout="constrained")
        grid = figure.subplots(count, len(GROUPS), sharex=True, sharey=True, squeeze=False)
        for key, row in zip(setup.known, grid, strict=True):
            for axes, (title, methods) in zip(row, GROUPS.items(), strict=True):
                for name in (*methods, OWN):
                    chosen = among[(among["problem"] == key) & (among["method"] == name)]
                    if len(chosen):
                        _band(axes, elapsed, chosen, setup.known[key], name)
                axes.set(
                    xscale="log", yscale="log", xlim=(elapsed[0], elapsed[-1]), ylim=(0.9, 300.0)
                )
                axes.axhline(1.0, color="0.75", linewidth=0.8, zorder=0)
                _grid(axes)
                if key == list(setup.known)[-1]:
                    axes.set_xlabel(f"processor time (s): {title}")
            row[0].set_ylabel("misfit over\nbest known (–)")
            row[len(GROUPS) // 2].set_title(setup.titles[key])
        figure.suptitle(
            f"{COORDINATES[coordinates]}: median and quartiles of {setup.seeds} seeds", fontsize=8
        )
        _legend(figure, set(among["method"]))
        figure.savefig(path, dpi=200)


def _band(axes: Axes, elapsed: Array, runs: pd.DataFrame, known: float, name: str) -> None:
    """Draw one method: what each seed had reached at each second, as median and quartiles."""
    reached = []
    for _, run in runs.groupby("seed", sort=False):
        at = np.searchsorted(run["seconds"].to_numpy(), elapsed, side="right") - 1
        misfit = np.sqrt(run["cost"].to_numpy() / known)
        reached.append(np.where(at >= 0, misfit[at], np.inf))
    low, middle, high = np.quantile(reached, (0.25, 0.5, 0.75), axis=0, method="inverted_cdf")
    there = np.isfinite(high)  # from when on three quarters of the seeds have anything
    line = _line(name)
    axes.fill_between(
        elapsed, low, high, where=list(there), color=line["color"], alpha=0.15, linewidth=0
    )
    axes.plot(elapsed, middle, **line)


def _line(name: str) -> dict[str, Any]:
    """Colour, dashes and width of a method's line."""
    colour, dash = STYLES[name]
    return {"color": colour, "linestyle": dash, "linewidth": 2.0 if name == OWN else 1.1}


def _grid(axes: Axes) -> None:
    axes.grid(color="0.93", linewidth=0.5)
    axes.set_axisbelow(True)


def _legend(figure: Figure, methods: set[str]) -> None:
    """Put the legend below the panels, in the order of the styles."""
    handles = [Line2D([], [], label=n, **_line(n)) for n in STYLES if n in methods]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, handlelength=3.2)


# ---------------------------------------------------------------- page

PAGE = """\
# Identification: misfit against run time

Made by `python experiments/error_vs_runtime/identification.py`; `--redraw` draws the recorded runs
again. {seeds} seeds for each of {problems} problems; a run takes at most {budget:g} s on one
thread, in seconds of processor time (on an idle machine, of elapsed time).

Machine: {machine}.

Everyone minimises the same residual, is stopped after the same time, and starts again when it ends
early: a method of lmfit from the next random point of the seed, `foamfit.fit` with another seed.
`foamfit.fit` first descends on the measured loop, which is another residual; until that is done it
has nothing to show here. A global method may need more time than this; `--budget` gives it.
*Solved* is a cost (sum of squares) within 5 % of the best known, which is the lowest of three long
searches of `foamfit.fit` and of all these runs. *si*: the `lmfit.Parameters` that
`foamfit.make_params` gives. *box*: `lmfit.Parameters` in the coordinates of foamfit's own search,
lent to all, where every point is an admissible chain. {slopes}

{findings}

![Performance profiles](identification_profiles.png)

*Performance profiles (Dolan & Moré, Math. Program. 91, 201, 2002): the share of problem-seeds that
a method solves within a factor τ of the shortest time. Left edge: how often it is the fastest;
right edge: how often it solves at all.*

Seeds solved, and seconds until then (median over all seeds; never: fewer than half were solved):

{table}

Quartiles, final misfits and evaluations per second are in
[identification.csv](identification.csv).

{curves}

*Reconstruction: simulated from published parameters with 1 % noise, not measured.{shoe}*
"""
SLOPES = {
    "differences": "`leastsq` and `least_squares` take forward differences with a step of 1e-5; "
    "`least_squares` scales its variables by the Jacobian.",
    "problem": "`leastsq` and `least_squares` are given the derivatives that the project's own "
    "search uses (`Problem.slopes`); `least_squares` scales its variables by the Jacobian.",
}
SHOE = " Shoe foam: first cycle of turbo-comp-1, a measurement by others, arXiv:2602.12694."


def findings(ends: pd.DataFrame) -> str:
    """Say in two sentences what the runs say."""
    out = []
    for coordinates in COORDINATES:
        among = ends[ends["coordinates"] == coordinates]
        if among.empty:
            continue
        own = ends[ends["coordinates"] == "own"]["solved_after_s"]
        solved = among.groupby("method", sort=False)["solved_after_s"].agg(
            lambda times: int(np.isfinite(times).sum())
        )
        best = solved.idxmax()
        ratios = profile(ends, coordinates)
        first = np.mean(ratios[OWN] == 1.0)
        out.append(
            f"In *{coordinates}*, `{OWN}` solves {int(np.isfinite(own).sum())} of {len(own)} "
            f"problem-seeds and is the fastest in {first:.0%}; of lmfit's methods "
            f"`{best}` solves most, {solved[best]} of {len(own)}."
        )
    return " ".join(out)


def page(ends: pd.DataFrame, table: pd.DataFrame, setup: Setup) -> str:
    """The page: what was done, on what machine, what came out."""
    shown = [c for c in COORDINATES if c in set(ends["coordinates"])]
    curves = (f"![Misfit against seconds, {COORDINATES[c]}](identification_{c}.png)" for c in shown)
    return PAGE.format(
        seeds=setup.seeds,
        problems=len(setup.known),
        budget=setup.budget_s,
        machine=", ".join(f"{k} {v}" for k, v in setup.machine.items()),
        slopes=SLOPES[setup.derivatives],
        findings=findings(ends),
        table=_summary(table, setup),
        curves="\n\n".join(curves),
        shoe=SHOE if "shoe-foam" in setup.known else "",
    )


def _summary(table: pd.DataFrame, setup: Setup) -> str:
    """Markdown: one row for each method, one column for each problem."""
    lines = [
        f"| method | in | {' | '.join(setup.titles[key] for key in setup.known)} | all |",
        f"| --- | --- |{' --- |' * (len(setup.known) + 1)}",
    ]
    for (coordinates, method), rows in table.groupby(["coordinates", "method"], sort=False):
        cells = []
        for key in setup.known:
            row = rows[rows["problem"] == key].iloc[0]
            median = row["solved after, median (s)"]
            after = f"{median:.2f} s" if np.isfinite(median) else "never"
            cells.append(f"{row['solved']} of {row['seeds']}, {after}")
        cells.append(f"{rows['solved'].sum()} of {rows['seeds'].sum()}")
        lines.append(f"| {method} | {coordinates} | {' | '.join(cells)} |")
    return "\n".join(lines)


def report(runs: pd.DataFrame, setup: Setup, folder: Path) -> None:
    """Write tables, page and figures of recorded runs."""
    lowest = runs.groupby("problem")["cost"].min()
    known = {key: min(cost, float(lowest[key])) for key, cost in setup.known.items()}
    setup = replace(setup, known=known)
    ends = solved_after(runs, known)
    table = tabulate(ends)
    table.to_csv(folder / "identification.csv", index=False, float_format="%.4g")
    (folder / "identification.md").write_text(page(ends, table, setup))
    draw_profiles(ends, setup, folder / "identification_profiles.png")
    for coordinates in COORDINATES:
        if coordinates in set(ends["coordinates"]):
            draw_curves(runs, coordinates, setup, folder / f"identification_{coordinates}.png")
    print(findings(ends))
