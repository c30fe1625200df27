"""Table, figures and page of the recorded runs of `identification.py`."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402

Array = NDArray[np.float64]

SOLVED = 1.05  # cost over the best known cost at which a problem counts as solved
RUN = ["problem", "coordinates", "method", "seed"]
COLUMNS = [*RUN, "seconds", "evaluations", "cost"]
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
    OWN: (studies.BLUE, "-"),
    "leastsq": ("black", "-"),
    "least_squares": (studies.SKY, "--"),
    "nelder": (studies.GREEN, "-"),
    "powell": ("#999933", "--"),
    "differential_evolution": (studies.VERMILION, "-"),
    "basinhopping": (studies.ORANGE, "--"),
    "dual_annealing": (studies.PURPLE, "-."),
    "ampgo": ("#6b6b6b", ":"),
}
SLOPES = {
    "differences": "`leastsq` and `least_squares` take forward differences with a step of 1e-5; "
    "`least_squares` scales its variables by the Jacobian.",
    "problem": "`leastsq` and `least_squares` are given the derivatives that the project's own "
    "search uses (`Problem.slopes`); `least_squares` scales its variables by the Jacobian.",
}
SHOE = " Shoe foam: first cycle of turbo-comp-1, a measurement by others, arXiv:2602.12694."


@dataclass(frozen=True)
class Setup:
    """What was run: processor and versions, longest time of a run, runs of each method.

    `derivatives` is a key of `SLOPES`; titles and best known costs are by problem.
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
    runs = runs.assign(ratio=runs["cost"] / runs["problem"].map(known))
    ends = runs.groupby(RUN, sort=False).agg(
        misfit_ratio=("ratio", lambda ratios: ratios.iloc[-1] ** 0.5),
        ended_after_s=("seconds", "last"), evaluations=("evaluations", "last"),
    )  # fmt: skip
    reached = runs[runs["ratio"] <= SOLVED].groupby(RUN)["seconds"].first()
    ends.insert(0, "solved_after_s", reached.reindex(ends.index).fillna(np.inf))
    return ends.reset_index()


def tabulate(ends: pd.DataFrame) -> pd.DataFrame:
    """One row for each problem and method: how many seeds it solved, how fast, how far it came."""

    def row(runs: pd.DataFrame) -> pd.Series:
        after, misfit = runs["solved_after_s"], runs["misfit_ratio"]
        pace = runs["evaluations"] / runs["ended_after_s"]
        # inf - inf is no number: quartiles of times by rank, not by interpolation
        low, middle, high = np.quantile(after, (0.25, 0.5, 0.75), method="inverted_cdf")
        return pd.Series({
            "solved": int(np.isfinite(after).sum()), "seeds": len(runs),
            "solved after, quartile 1 (s)": low, "solved after, median (s)": middle,
            "solved after, quartile 3 (s)": high,
            "misfit over best known at the end, median": misfit.median(),
            "misfit over best known at the end, worst": misfit.max(),
            "evaluations per second, median": pace.median(),
        })  # fmt: skip

    table = ends.groupby(RUN[:3], sort=False).apply(row, include_groups=False).reset_index()
    return table.astype({"solved": int, "seeds": int})


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
    ratios = {coordinates: profile(ends, coordinates) for coordinates in shown(ends)}
    finite = [r[np.isfinite(r)] for panel in ratios.values() for r in panel.values()]
    last = 10.0 ** np.ceil(np.log10(1.05 * np.concatenate([[5.0], *finite]).max()))
    with studies.sheet(path, 3.5 * len(ratios), 3.6) as figure:
        panels = figure.subplots(1, len(ratios), sharey=True, squeeze=False)[0]
        for axes, (coordinates, by_method) in zip(panels, ratios.items(), strict=True):
            for name in reversed(by_method):  # the project's own on top
                steps = np.sort(by_method[name][np.isfinite(by_method[name])])
                share = np.arange(steps.size + 1) / by_method[name].size
                axes.step([1.0, *steps, last], [*share, share[-1]], where="post", **_line(name))
            axes.set(xscale="log", xlim=(1.0, last), ylim=(-0.02, 1.02))
            axes.set(
                title=COORDINATES[coordinates], xlabel="processor time over the shortest, τ (–)"
            )
            studies.gridlines(axes)
        panels[0].set_ylabel("share of problem-seeds solved within τ (–)")
        figure.suptitle(
            f"{setup.seeds * len(setup.known)} problem-seeds; solved: cost within 5 % of the best "
            f"known, in at most {setup.budget_s:g} s",
            fontsize=8,
        )
        _legend(figure, set(ends["method"]))


def draw_curves(runs: pd.DataFrame, coordinates: str, setup: Setup, path: Path) -> None:
    """Misfit over the best known against seconds: median and quartiles over the seeds."""
    count = len(setup.known)
    elapsed = np.geomspace(0.01, setup.budget_s, 200)
    among = runs[runs["coordinates"].isin(("own", coordinates))]
    with studies.sheet(path, 7.0, 1.7 * count + 0.9) as figure:
        grid = figure.subplots(count, len(GROUPS), sharex=True, sharey=True, squeeze=False)
        for key, row in zip(setup.known, grid, strict=True):
            for axes, methods in zip(row, GROUPS.values(), strict=True):
                for name in (*methods, OWN):
                    chosen = among[(among["problem"] == key) & (among["method"] == name)]
                    if len(chosen):
                        _band(axes, elapsed, chosen, setup.known[key], name)
                axes.set(xscale="log", yscale="log")
                axes.set(xlim=(elapsed[0], elapsed[-1]), ylim=(0.9, 300.0))
                axes.axhline(1.0, color="0.75", linewidth=0.8, zorder=0)
                studies.gridlines(axes)
            row[0].set_ylabel("misfit over\nbest known (–)")
            row[len(GROUPS) // 2].set_title(setup.titles[key])
        for axes, title in zip(grid[-1], GROUPS, strict=True):
            axes.set_xlabel(f"processor time (s): {title}")
        told = f"{COORDINATES[coordinates]}: median and quartiles of {setup.seeds} seeds"
        figure.suptitle(told, fontsize=8)
        _legend(figure, set(among["method"]))


def _band(axes: Axes, elapsed: Array, runs: pd.DataFrame, known: float, name: str) -> None:
    """Draw one method: what each seed had reached at each second, as median and quartiles."""
    reached = []
    for _, run in runs.groupby("seed", sort=False):
        at = np.searchsorted(run["seconds"].to_numpy(), elapsed, side="right") - 1
        misfit = np.sqrt(run["cost"].to_numpy() / known)
        reached.append(np.where(at >= 0, misfit[at], np.inf))
    low, middle, high = np.quantile(reached, (0.25, 0.5, 0.75), axis=0, method="inverted_cdf")
    there = list(np.isfinite(high))  # from when on three quarters of the seeds have anything
    line = _line(name)
    axes.fill_between(elapsed, low, high, where=there, color=line["color"], alpha=0.15, linewidth=0)
    axes.plot(elapsed, middle, **line)


def _line(name: str) -> dict[str, Any]:
    """Colour, dashes and width of a method's line."""
    colour, dash = STYLES[name]
    return {"color": colour, "linestyle": dash, "linewidth": 2.0 if name == OWN else 1.1}


def _legend(figure: Figure, methods: set[str]) -> None:
    """Put the legend below the panels, in the order of the styles."""
    handles = [Line2D([], [], label=n, **_line(n)) for n in STYLES if n in methods]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, handlelength=3.2)


# ---------------------------------------------------------------- page


def shown(ends: pd.DataFrame) -> list[str]:
    """Coordinates in which methods of lmfit were run."""
    return [coordinates for coordinates in COORDINATES if coordinates in set(ends["coordinates"])]


def findings(ends: pd.DataFrame) -> str:
    """Say in two sentences what the runs say."""
    solved = np.isfinite(ends["solved_after_s"])
    own, out = solved[ends["coordinates"] == "own"], []
    for coordinates in shown(ends):
        counts = solved.groupby([ends["coordinates"], ends["method"]], sort=False).sum()[
            coordinates
        ]
        best = counts.idxmax()
        first = np.mean(profile(ends, coordinates)[OWN] == 1.0)
        out.append(
            f"In *{coordinates}*, `{OWN}` solves {own.sum()} of {len(own)} problem-seeds and is "
            f"the fastest in {first:.0%}; of lmfit's methods `{best}` solves most, {counts[best]} "
            f"of {len(own)}."
        )
    return " ".join(out)


def summary(table: pd.DataFrame, setup: Setup) -> str:
    """Markdown: one row for each method, one column for each problem."""
    rows = []
    for (coordinates, method), own in table.groupby(["coordinates", "method"], sort=False):
        cells = []
        for key in setup.known:
            row = own[own["problem"] == key].iloc[0]
            median = row["solved after, median (s)"]
            after = f"{median:.2f} s" if np.isfinite(median) else "never"
            cells.append(f"{row['solved']} of {row['seeds']}, {after}")
        rows.append([method, coordinates, *cells, f"{own['solved'].sum()} of {own['seeds'].sum()}"])
    titles = [setup.titles[key] for key in setup.known]
    return studies.markdown(["method", "in", *titles, "all"], rows)


def report(runs: pd.DataFrame, setup: Setup, folder: Path) -> None:
    """Write tables, page and figures of recorded runs."""
    lowest = runs.groupby("problem")["cost"].min()
    known = {key: min(cost, float(lowest[key])) for key, cost in setup.known.items()}
    setup = replace(setup, known=known)
    ends = solved_after(runs, known)
    table = tabulate(ends)
    studies.write_csv(table, folder / "identification.csv")
    draw_profiles(ends, setup, folder / "identification_profiles.png")
    for coordinates in shown(ends):
        draw_curves(runs, coordinates, setup, folder / f"identification_{coordinates}.png")
    template = (HERE / "identification.template.md").read_text(encoding="utf-8")
    page = template.format(
        seeds=setup.seeds, problems=len(known), budget=setup.budget_s,
        machine=", ".join(f"{k} {v}" for k, v in setup.machine.items()),
        slopes=SLOPES[setup.derivatives], findings=findings(ends), table=summary(table, setup),
        curves="\n\n".join(
            f"![Misfit against seconds, {COORDINATES[c]}](identification_{c}.png)"
            for c in shown(ends)
        ),
        shoe=SHOE if "shoe-foam" in known else "",
    )  # fmt: skip
    (folder / "identification.md").write_text(page, encoding="utf-8")
    print(findings(ends))
