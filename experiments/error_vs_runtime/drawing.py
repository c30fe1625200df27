"""One style for all figures of error and run time: a colour and a mark for each solver."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from foamfit.report.figures import STYLE

# Okabe and Ito's colours; the mark tells solvers apart where colours do not.
SOLVERS: dict[str, dict[str, Any]] = {
    "foamfit simulate": {"color": "#0072B2", "marker": "o", "linewidth": 1.6},
    "foamfit kernel": {"color": "#D55E00", "marker": "D", "linewidth": 1.6},
    "SciPy DOP853": {"color": "black", "marker": "s"},
    "SciPy LSODA": {"color": "#56B4E9", "marker": "^"},
    "SciPy Radau": {"color": "#6b6b6b", "marker": "v"},
    "velocity Verlet": {"color": "#E69F00", "marker": "x", "linestyle": "--"},
    "Heun": {"color": "#E69F00", "marker": "x", "linestyle": "--"},
    "exponential recursion": {"color": "#E69F00", "marker": "x", "linestyle": "--"},
    "Runge-Kutta 4": {"color": "#009E73", "marker": "+", "linestyle": "--"},
    "implicit midpoint": {"color": "#CC79A7", "marker": "1", "linestyle": "--"},
}
DRIVES = {
    "stress drive": {"color": "#0072B2", "marker": "o"},
    "displacement drive": {"color": "#D55E00", "marker": "D"},
    "impact, no spring snaps": {"color": "#009E73", "marker": "^"},
    "impact, every spring snaps": {"color": "black", "marker": "s"},
}
FLOOR = 1e-16  # an error of zero is drawn there


def draw_scene(table: pd.DataFrame, title: str, wanted: float, path: Path) -> None:
    """Error over median time of every solver of a scene; a bar spans the quartiles of time."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.2, 3.1), layout="constrained")
        ax = figure.add_subplot()
        ax.axhline(wanted, color="0.75", linewidth=0.8, zorder=0)
        for solver, look in SOLVERS.items():
            part = table[table["solver"] == solver]
            if not len(part):
                continue
            middle = part["median (s)"]
            spread = [middle - part["lower quartile (s)"], part["upper quartile (s)"] - middle]
            look = {"linewidth": 1.0, "markersize": 4, **look}
            error = part["error"].clip(lower=FLOOR)
            ax.errorbar(middle, error, xerr=spread, elinewidth=0.6, label=solver, **look)
        ax.set(xscale="log", yscale="log")
        ax.set_ylim(FLOOR / 3, 1.0)
        ax.set_yticks([10.0**k for k in range(-16, 1, 2)])
        ax.set_xlabel("processor time of one run (s)")
        ax.set_ylabel("largest error over range (–)")
        ax.grid(color="0.93", linewidth=0.5)
        ax.set_axisbelow(True)
        figure.suptitle(textwrap.fill(title, 60), fontsize=8)
        x = ax.get_xlim()[1]
        ax.annotate(
            f"{wanted:.0e}".replace("e-0", "e-"), (x, wanted), (-2, 2), color="0.5", ha="right",
            textcoords="offset points", fontsize=6.5,
        )  # fmt: skip
        figure.legend(loc="outside right center")
        figure.savefig(path, dpi=200)


def draw_scaling(table: pd.DataFrame, path: Path) -> None:
    """Time over springs and over samples."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 3.0), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for ax, over in zip(axes, ("springs", "samples"), strict=True):
            for drive, look in DRIVES.items():
                for solver, line in (("foamfit simulate", "-"), ("foamfit kernel", ":")):
                    rows = (table["drive"] == drive) & (table["over"] == over)
                    part = table[rows & (table["solver"] == solver)]
                    label = drive if line == "-" else None
                    ax.plot(
                        part[over], part["median (s)"], linestyle=line, markersize=3.5,
                        linewidth=1.0, label=label if over == "springs" else None, **look,
                    )  # fmt: skip
            ax.set(xscale="log", yscale="log", xlabel=f"{over} (–)")
            ax.grid(color="0.93", linewidth=0.5)
            ax.set_axisbelow(True)
        axes[0].set_title("501 samples")
        axes[1].set_title("one spring")
        axes[0].set_ylabel("processor time of one run (s)")
        axes[0].plot([], [], color="0.4", label="simulate")
        axes[0].plot([], [], color="0.4", linestyle=":", label="kernel that the fit calls")
        figure.legend(loc="outside lower center", ncols=3)
        figure.savefig(path, dpi=200)
