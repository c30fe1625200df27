"""What does wear do to a running-shoe foam? Five specimens of a new heel against five of a worn.

    FOAMFIT_DATA=path/to/data python experiments/twins/twins.py

The measurements are not part of this repository: shoe-foam-twins/ are compressions of ten
specimens, six to seven cycles each (arXiv:2602.12694, LivingMatterLab/CANN on GitHub), with a
specimens.csv of diameters and heights. The study goes the way of a user: a TOML beside each test,
`foamfit.batch` over all tests and cycles, `foamfit.joint` of the new and of the worn ones.

Writes README.md, batch.csv, wear.csv, new_against_worn.png and by_cycle.png beside this file.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy import stats

import foamfit as ff
from foamfit.report.figures import BLUE, GREY, VERMILION, drawing, save
from foamfit.report.readable import readable_unit
from foamfit.springs.parameters import unit_of
from foamfit.text import listed, percent, significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from specimens import twins, write_specimen  # noqa: E402

SOURCE = "measurements: arXiv:2602.12694, LivingMatterLab/CANN"
GROUPS, COLOURS = ("new", "worn"), {"new": BLUE, "worn": VERMILION}
FIRST, LATER = 1, 5  # cycles that the page has tables of
STUDY = """\
name = "shoe foam, {group} heel, cycle {cycle}"
tests = ["{group}-heel-comp-*_raw.txt"]
model = "microscale"
relaxation = 1
drive = "displacement"
cycle = {cycle}

[parameters]
{parameters}
"""
LAW = (
    "k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus", "g1", "tau1"
)  # fmt: skip
# No test tells kc from eps_star (r = 1.00), and all ten say that eps_star is one value by evidence:
# it is found from all of them and held in the fits of the groups, so that their kc compare.
HELD = "s1_eps_star"
SCATTERING = tuple(f"s1_{name}" for name in LAW if f"s1_{name}" != HELD)
ENERGY, PEAK = "dissipated energy", "peak stress"
UNITS = {ENERGY: (1e3, "kJ/m³"), PEAK: (1e3, "kPa")}
POWER = 0.8
LEVEL = 0.05  # of what is said to stand out, all comparisons of a cycle together
POINTS = 200  # of a mean loop
# Measured strain and stress of each specimen by group; joint.json by cycle and group.
Loops = Mapping[str, Sequence[tuple[np.ndarray, np.ndarray]]]
Found = Mapping[int, Mapping[str, Mapping[str, Any]]]


# ------------------------------------------------------------------------------- fits


def place_tests(data: Path, folder: Path) -> None:
    """Link the tests into a folder, with the TOML of each beside it."""
    for test, height, diameter in twins(data):
        stem = f"{test}_raw"
        (folder / f"{stem}.txt").symlink_to((data / f"{stem}.txt").resolve())
        write_specimen(folder / f"{stem}.toml", height, diameter)


def fit_each(folder: Path) -> pd.DataFrame:
    """Fit every cycle of every test on its own; rows of summary.csv with specimen and cycle."""
    found = ff.batch(
        folder, out=folder / "runs", model="microscale", relaxation=1, drive="displacement",
        cycle="all", intervals="local", report=False,
    )  # fmt: skip
    split = found["test"].str.extract(r"^(?P<specimen>.*)_raw(?:/cycle-(?P<cycle>\d+))?$")
    return pd.concat([split, found.drop(columns=["test", "file"])], axis=1)


def fit_together(folder: Path, cycle: int) -> dict[str, dict[str, Any]]:
    """Fit one cycle of all specimens, of the new and of the worn together; joint.json of each."""
    found = {"all": fit_study(folder, "*", cycle, '"auto"')}
    held = found["all"]["parameters"][HELD]
    if held["kind"] != "shared":
        sys.exit(f"cycle {cycle}: the evidence is for {HELD} {held['kind']}, not shared")
    for group in GROUPS:
        found[group] = fit_study(folder, group, cycle, repr(held["value"]))
    return found


def fit_study(folder: Path, group: str, cycle: int, held: str) -> dict[str, Any]:
    """Fit one study; content of joint.json."""
    study = folder / "study.toml"
    parameters = "\n".join(f'{name} = "scatter"' for name in SCATTERING)
    study.write_text(
        STUDY.format(group=group, cycle=cycle, parameters=f"{parameters}\n{HELD} = {held}")
    )
    return ff.joint(study).to_json_dict()


def loops(folder: Path, cycle: int) -> Loops:
    """Measured strain and stress of one cycle of each specimen, by group."""
    out = {}
    for group in GROUPS:
        tests = [ff.read_test(p, cycle=cycle) for p in sorted(folder.glob(f"{group}-*_raw.txt"))]
        out[group] = [(t.displacement / t.specimen.height, t.stress) for t in tests]
    return out


def mean_loop(group: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...]:
    """Mean strain, mean stress and its standard deviation, at equal shares of the largest strain.

    The first half is the loading, the second the unloading.
    """
    share = np.linspace(0.0, 1.0, POINTS)
    strains, stresses = [], []
    for strain, stress in group:
        turn, top = int(np.argmax(strain)), float(strain.max())
        up = np.interp(share, np.maximum.accumulate(strain[: turn + 1]) / top, stress[: turn + 1])
        back = np.maximum.accumulate(strain[turn:][::-1]) / top
        down = np.interp(share, back, stress[turn:][::-1])
        # Below where the unloading ends there is nothing to interpolate.
        down[share < back[0]] = np.nan
        strains.append(top * np.concatenate([share, share[::-1]]))
        stresses.append(np.concatenate([up, down[::-1]]))
    return np.mean(strains, axis=0), np.mean(stresses, axis=0), np.std(stresses, axis=0, ddof=1)


def lost(loop: tuple[np.ndarray, np.ndarray]) -> float:
    """Energy that a loop dissipates, J/m³."""
    return float(np.trapezoid(loop[1], loop[0]))


def peak(loop: tuple[np.ndarray, np.ndarray]) -> float:
    """The largest stress of a loop, Pa."""
    return float(loop[1].max())


# ------------------------------------------------------------------------------- comparison


@dataclass(frozen=True)
class Group:
    """Values of one quantity in the specimens of a group, their common value and spread.

    `mean`, `stderr` and `spread` are of the logarithm. `ends` are the 95 % intervals of the single
    values, `sure` says whether each is determined.
    """

    values: tuple[float, ...]
    mean: float
    stderr: float
    spread: float
    ends: tuple[tuple[float, float] | None, ...] = ()
    sure: tuple[bool, ...] = ()

    @classmethod
    def of(cls, values: Sequence[float]) -> Group:
        """Measured values, whose errors are nothing beside their spread."""
        logs = np.log(values)
        spread = float(np.std(logs, ddof=1))
        return cls(tuple(values), float(np.mean(logs)), spread / math.sqrt(len(logs)), spread)

    @classmethod
    def of_joint(cls, item: Mapping[str, Any]) -> Group:
        """A scattering parameter of joint.json, its spread apart from errors of measurement."""
        tests = list(item["tests"].values())
        return cls(
            tuple(one["value"] for one in tests),
            math.log(item["value"]),
            item["stderr"] / item["value"],
            item["scatter"],
            tuple(one["ci95"] and tuple(one["ci95"]) for one in tests),
            tuple(one["state"] == "determined" for one in tests),
        )

    @property
    def common(self) -> float:
        """The common value: the median specimen's."""
        return math.exp(self.mean)

    @property
    def ci95(self) -> tuple[float, float]:
        """Its 95 % interval, with Student's t."""
        half = float(stats.t.ppf(0.975, len(self.values) - 1)) * self.stderr
        return math.exp(self.mean - half), math.exp(self.mean + half)

    @property
    def edges(self) -> tuple[float, float]:
        """One standard deviation between specimens to either side of the common value."""
        return math.exp(self.mean - self.spread), math.exp(self.mean + self.spread)


@dataclass(frozen=True)
class Change:
    """A quantity in the worn group over that in the new one, less one (Welch's test of logarithms).

    `size` is the change over the spread between specimens, both of the logarithm; `adjusted` is p
    with all comparisons of a cycle counted.
    """

    name: str
    new: Group
    worn: Group
    change: float
    ci95: tuple[float, float]
    p: float
    size: float
    adjusted: float = math.nan

    @property
    def stands_out(self) -> bool:
        """Whether there is a change in spite of the scatter, all comparisons counted."""
        return self.adjusted < LEVEL


def change_of(name: str, new: Group, worn: Group) -> Change:
    """Compare two groups."""
    difference, error = worn.mean - new.mean, math.hypot(new.stderr, worn.stderr)
    freedom = error**4 / sum(g.stderr**4 / (len(g.values) - 1) for g in (new, worn))
    half = float(stats.t.ppf(0.975, freedom)) * error
    p = 2.0 * float(stats.t.sf(abs(difference) / error, freedom))
    spread = math.hypot(new.spread, worn.spread) / math.sqrt(2.0)
    size = abs(difference) / spread if spread > 0.0 else math.inf
    ends = math.expm1(difference - half), math.expm1(difference + half)
    return Change(name, new, worn, math.expm1(difference), ends, p, size)


def counted_together(changes: Sequence[Change]) -> list[Change]:
    """The changes by their size, largest first, with p adjusted for their number (Holm 1979)."""
    out, least = list[Change](), 0.0
    for i, one in enumerate(sorted(changes, key=lambda one: one.p)):
        least = max(least, min((len(changes) - i) * one.p, 1.0))
        out.append(replace(one, adjusted=least))
    return sorted(out, key=lambda one: -one.size)


def wear(found: Mapping[str, Mapping[str, Any]], measured: Loops) -> list[Change]:
    """What differs between the joint fits of two groups, and what their loops say without a law."""
    out = [
        change_of(name, *(Group.of([one(loop) for loop in measured[g]]) for g in GROUPS))
        for name, one in ((ENERGY, lost), (PEAK, peak))
    ]
    for name in SCATTERING:
        new, worn = (Group.of_joint(found[group]["parameters"][name]) for group in GROUPS)
        out.append(change_of(name, new, worn))
    return counted_together(out)


# ------------------------------------------------------------------------------- in words


def shown_change(one: Change) -> str:
    """Write a change with its 95 % interval."""
    value, low, high = (f"{100 * end:+.0f}".replace("-", "−") for end in (one.change, *one.ci95))
    return f"{value} % ({low} to {high} %)"


def verdict(one: Change) -> str:
    """Whether a change stands out of the scatter between specimens."""
    if one.stands_out:
        return "stands out"
    return f"a hint, p = {significant(one.p, 1)}" if one.p < LEVEL else "within scatter"


def headline(changes: Sequence[Change]) -> str:
    """Name what stands out."""
    there = [one.name.removeprefix("s1_") for one in changes if one.stands_out]
    if not there:
        return "no change stands out of the scatter between specimens"
    return f"{listed(there)} {'stands' if len(there) == 1 else 'stand'} out of the scatter"


def unit_for(one: Change) -> tuple[float, str]:
    """Factor and name of the unit in which a quantity reads well."""
    return UNITS.get(one.name) or readable_unit(one.new.common, unit_of(one.name))


def title(one: Change) -> str:
    unit = unit_for(one)[1]
    return f"{one.name.removeprefix('s1_')}{f' ({unit})' if unit else ''}"


# ------------------------------------------------------------------------------- pictures


def draw_wear(changes: Sequence[Change], measured: Loops, cycle: int, path: Path) -> None:
    """The mean loops, and each quantity new against worn."""
    with drawing(7.6, 6.4) as figure:
        grid = figure.add_gridspec(3, 4)
        draw_loops(figure.add_subplot(grid[0, :2]), measured)
        places = [grid[0, 2], grid[0, 3], *(grid[r, c] for r in (1, 2) for c in range(4))]
        for place, one in zip(places, changes, strict=True):
            draw_change(figure.add_subplot(place), one)
        figure.suptitle(
            f"Running-shoe foam, cycle {cycle}, new heel against worn: {headline(changes)}; "
            "largest change over spread first\n"
            "points: specimens with 95 % intervals, hollow if not well determined; line and band: "
            "common value and its 95 % interval;\n"
            f"dashed: spread between specimens. {SOURCE[0].upper()}{SOURCE[1:]}",
            x=0.01, ha="left", fontsize=7.5,
        )  # fmt: skip
    save(figure, path)


def draw_loops(ax: Axes, measured: Loops) -> None:
    for group, colour in COLOURS.items():
        strain, stress, spread = mean_loop(measured[group])
        for part in (slice(None, POINTS), slice(POINTS, None)):
            low, high = (stress[part] - spread[part]) / 1e3, (stress[part] + spread[part]) / 1e3
            ax.fill_between(strain[part], low, high, color=colour, alpha=0.15, linewidth=0)
        ax.plot(strain, stress / 1e3, color=colour, linewidth=1.2, label=group)
    ax.set_title("mean loops ± standard deviation")
    ax.set(xlabel="strain", ylabel="stress (kPa)")
    ax.legend(loc="upper left")


def draw_change(ax: Axes, one: Change) -> None:
    """One quantity: specimens, common value and spread of both groups."""
    factor, _ = unit_for(one)
    for x, (name, group) in enumerate((("new", one.new), ("worn", one.worn))):
        colour = COLOURS[name]
        span = [x - 0.36, x + 0.36]
        low, high = (end / factor for end in group.ci95)
        ax.fill_between(span, low, high, color=colour, alpha=0.18, linewidth=0, zorder=0)
        ax.plot(span, [group.common / factor] * 2, color=colour, linewidth=1.6, zorder=1)
        for edge in group.edges:
            ax.plot(span, [edge / factor] * 2, "--", color=colour, linewidth=0.7, zorder=1)
        at = x + np.linspace(-0.24, 0.24, len(group.values))
        for i, value in enumerate(group.values):
            ends = group.ends[i] if group.ends else None
            if ends is not None:
                ax.plot([at[i]] * 2, [end / factor for end in ends], color=GREY, linewidth=0.8)
            sure = not group.sure or group.sure[i]
            ax.plot(at[i], value / factor, "o", color=colour, markersize=3.4,
                    markerfacecolor=colour if sure else "white", markeredgewidth=0.8)  # fmt: skip
    ax.set_xlim(-0.55, 1.55)
    ax.set_xticks([0, 1], GROUPS)
    ax.set_title(
        f"{title(one)}\n{shown_change(one)}\n{one.size:.1f} spreads: {verdict(one)}",
        fontsize=7, fontweight="bold" if one.stands_out else "normal",
    )  # fmt: skip
    ax.locator_params(axis="y", nbins=5)


def draw_cycles(by_cycle: Mapping[int, Sequence[Change]], path: Path) -> None:
    """Common values of new and worn against the cycle."""
    cycles = list(by_cycle)
    with drawing(7.6, 4.0) as figure:
        axes = figure.subplots(2, 5, sharex=True).ravel()
        for ax, name in zip(axes, (ENERGY, PEAK, *SCATTERING), strict=True):
            there = [next(one for one in by_cycle[n] if one.name == name) for n in cycles]
            factor, _ = unit_for(there[0])
            for group, off in (("new", -0.1), ("worn", 0.1)):
                ones = [getattr(one, group) for one in there]
                x, colour = np.array(cycles) + off, COLOURS[group]
                ends = np.array([one.ci95 for one in ones]) / factor
                ax.vlines(x, ends[:, 0], ends[:, 1], color=colour, linewidth=0.9)
                ax.plot(x, [one.common / factor for one in ones], color=colour, linewidth=0.7)
                for at, one, change in zip(x, ones, there, strict=True):
                    ax.plot(at, one.common / factor, "o", color=colour, markersize=3.6,
                            markerfacecolor=colour if change.stands_out else "white",
                            label=group if at < 1.5 else None)  # fmt: skip
            ax.set_title(title(there[0]))
            ax.set_xticks(cycles)
            ax.set_ylim(bottom=0.0)
        for ax in axes[5:]:
            ax.set_xlabel("cycle")
        figure.suptitle(
            "New (blue) and worn (red) by cycle: common value of five specimens with its 95 % "
            "interval, filled where wear stands out of the scatter\n"
            f"{SOURCE[0].upper()}{SOURCE[1:]}",
            x=0.01, ha="left", fontsize=7.5,
        )  # fmt: skip
    save(figure, path)


# ------------------------------------------------------------------------------- the page


def change_rows(changes: Sequence[Change]) -> str:
    """Rows of the page's table of changes."""
    out = []
    for one in changes:
        factor, cells = unit_for(one)[0], []
        for group in (one.new, one.worn):
            told = [significant(v / factor, 3) for v in (group.common, *group.ci95)]
            cells += [f"{told[0]} ({told[1]} to {told[2]})", percent(group.spread)]
        out.append(
            f"| {title(one)} | {' | '.join(cells)} | {shown_change(one)} | "
            f"{significant(one.size, 2)} | {significant(one.p, 2)} | "
            f"{significant(one.adjusted, 2)} | {verdict(one)} |"
        )
    return "\n".join(out)


def batch_rows(table: pd.DataFrame) -> str:
    """By group and cycle: fits, misfits, states that are determined."""
    out = []
    table = table.assign(group=table["specimen"].str.split("-").str[0])
    for (group, cycle), part in table.groupby(["group", "cycle"], dropna=False):
        fitted = part[part["misfit_stress_strain"].notna()]
        off = fitted["misfit_stress_strain"]
        states = [part[f"s1_{name}_state"].eq("determined").sum() for name in LAW]
        told = f"{percent(off.min())} to {percent(off.max())}" if len(off) else "–"
        acceptable = part["status"].isin(["ok", "warnings"]).sum()
        out.append(
            f"| {group} | {cycle} | {acceptable} of {len(part)} | {told} | "
            f"{' | '.join(str(count) for count in states)} |"
        )
    return "\n".join(out)


def refusals(table: pd.DataFrame) -> str:
    wrong = table[~table["status"].isin(["ok", "warnings"])]
    told = [f"- {r.specimen}, cycle {r.cycle}: {r.status}, {r.error}" for r in wrong.itertuples()]
    return "\n".join(told) or "Every test and cycle has a fit; none was refused."


def joint_rows(found: Found) -> str:
    """Rows of the page's table of joint fits."""
    out = []
    for cycle, by_group in found.items():
        for group, content in by_group.items():
            off = [test["misfit"]["stress_strain"] for test in content["tests"].values()]
            held, score = content["parameters"][HELD], content["statistics"]
            weak = [
                f"`{name.removeprefix('s1_')}` {content['parameters'][name]['state']}"
                for name in SCATTERING
                if content["parameters"][name]["state"] != "determined"
            ]
            bics = {one["kind"]: f"{one['bic']:.0f}" for one in content["evidence"]}
            out.append(
                f"| {cycle} | {group} | {len(off)} | {score['n_vary']} | {percent(min(off))} to "
                f"{percent(max(off))} | {held['value']:.3f}"
                f"{'' if group == 'all' else ', held'} | {bics.get('shared', '–')} / "
                f"{bics.get('own', '–')} | {', '.join(weak) or 'none'} |"
            )
    return "\n".join(out)


def power(size: float, count: int) -> float:
    """Chance that a change of so many spreads is seen (p < 0.05) with so many specimens each."""
    freedom, shift = 2 * count - 2, size * math.sqrt(count / 2.0)
    edge = float(stats.t.ppf(0.975, freedom))
    return float(stats.nct.sf(edge, freedom, shift) + stats.nct.cdf(-edge, freedom, shift))


def needed(size: float) -> int:
    """Specimens in each group that show a change of so many spreads, four times in five."""
    return next(count for count in range(2, 10_000) if power(size, count) >= POWER)


def one_way(changes: Mapping[int, Sequence[Change]]) -> str:
    """Name what is lower, and what is higher, in the worn group in every cycle."""
    signs = dict[str, set[bool]]()
    for ones in changes.values():
        for one in ones:
            signs.setdefault(one.name, set()).add(one.change > 0.0)
    lower = listed(code(name) for name in signs if signs[name] == {False})
    higher = listed(code(name) for name in signs if signs[name] == {True})
    return f"lower in the worn heel in every cycle are {lower}; higher are {higher}"


def told(changes: Sequence[Change]) -> str:
    """Name what stands out, what may, and what does not."""
    parts = {
        "Stands out of the scatter between specimens": [o for o in changes if o.stands_out],
        "A hint (p below 0.05 on its own)": [
            o for o in changes if o.p < LEVEL and not o.stands_out
        ],
        "Within the scatter": [o for o in changes if o.p >= LEVEL],
    }
    lines = []
    for words, ones in parts.items():
        said = "; ".join(f"{code(one.name)} {shown_change(one)}" for one in ones)
        lines.append(f"- {words}: {said or 'nothing'}.")
    return "\n".join(lines)


def code(name: str) -> str:
    """Write the name of a parameter as such."""
    return name if name in UNITS else f"`{name.removeprefix('s1_')}`"


def write_tables(table: pd.DataFrame, changes: Mapping[int, Sequence[Change]]) -> None:
    """Write batch.csv and wear.csv."""
    errors = [name for name in table if name.endswith("_stderr")]
    table.drop(columns=errors).to_csv(HERE / "batch.csv", index=False, float_format="%.5g")
    rows = []
    for cycle, ones in changes.items():
        for one in ones:
            row: dict[str, Any] = {"cycle": cycle, "quantity": one.name}
            for name, group in (("new", one.new), ("worn", one.worn)):
                low, high = group.ci95
                row |= {name: group.common, f"{name}_lo": low, f"{name}_hi": high}
                row[f"{name}_spread"] = group.spread
            row |= {"change": one.change, "change_lo": one.ci95[0], "change_hi": one.ci95[1]}
            row |= {"change_over_spread": one.size, "p": one.p, "p_adjusted": one.adjusted}
            rows.append(row)
    pd.DataFrame(rows).to_csv(HERE / "wear.csv", index=False, float_format="%.4g")


def write_page(made: Made, changes: Mapping[int, Sequence[Change]], free: Sequence[Change]) -> None:
    """Write README.md."""
    table, found, seconds, largest = made.table, made.found, made.seconds, changes[FIRST][0]
    by_size = [one for one in free if one.name in SCATTERING]
    off = table["misfit_stress_strain"]
    everywhere = [
        code(name)
        for name in (ENERGY, PEAK, *SCATTERING)
        if all(o.stands_out for ones in changes.values() for o in ones if o.name == name)
    ]
    page = (HERE / "page.template.md").read_text(encoding="utf-8")
    (HERE / "README.md").write_text(
        page.format(
            first=FIRST,
            later=LATER,
            last=max(changes),
            fits=len(table),
            fitted=int(table["status"].isin(["ok", "warnings"]).sum()),
            refusals=refusals(table),
            misfit_low=percent(off.min()),
            misfit_high=percent(off.max()),
            misfit_median=percent(off.median()),
            batch=batch_rows(table),
            names=" | ".join(f"`{name}`" for name in LAW),
            dashes=" | ".join("---" for _ in LAW),
            joint=joint_rows(found),
            told_first=told(changes[FIRST]),
            told_later=told(changes[LATER]),
            everywhere=", ".join(everywhere) or "nothing",
            one_way=one_way(changes),
            largest=code(largest.name),
            largest_size=significant(largest.size),
            needed=needed(largest.size),
            shown=percent(power(largest.size, 5)),
            free="; ".join(
                f"{code(one.name)} {shown_change(one)}, p = {significant(one.p)}"
                for one in by_size[:2]
            ),
            free_spread=", ".join(
                percent(made.free[group]["parameters"]["s1_kc"]["scatter"]) for group in GROUPS
            ),
            held_spread=", ".join(
                percent(found[FIRST][group]["parameters"]["s1_kc"]["scatter"]) for group in GROUPS
            ),
            wear_first=change_rows(changes[FIRST]),
            wear_later=change_rows(changes[LATER]),
            batch_seconds=f"{seconds['batch']:.0f}",
            joint_seconds=f"{seconds['joint']:.0f}",
        ),
        encoding="utf-8",
    )


@dataclass(frozen=True)
class Made:
    """All that is fitted: the batch, the joint fits by cycle, and of the first with HELD free.

    Also the measured loops by cycle, and seconds.
    """

    table: pd.DataFrame
    found: Found
    free: Mapping[str, Mapping[str, Any]]
    measured: Mapping[int, Loops]
    seconds: Mapping[str, float]


def measure(data: Path, folder: Path) -> Made:
    """Make all fits."""
    began = time.perf_counter()
    place_tests(data, folder)
    table = fit_each(folder)
    took = time.perf_counter() - began
    print(f"batch: {len(table)} fits in {took:.0f} s", flush=True)
    counts = table["cycle"].dropna().astype(int).value_counts()
    # A cycle that few records have is no group.
    full = sorted(n for n, count in counts.items() if count == table["specimen"].nunique())
    found = dict[int, dict[str, dict[str, Any]]]()
    free = {group: fit_study(folder, group, FIRST, '"own"') for group in GROUPS}
    for n in full:
        found[n] = fit_together(folder, n)
        print(f"cycle {n} together", flush=True)
    seconds = {"batch": took, "joint": time.perf_counter() - began - took}
    return Made(table, found, free, {n: loops(folder, n) for n in full}, seconds)


def write(made: Made) -> None:
    """Write tables, pictures and page of what was found."""
    changes = {n: wear(made.found[n], made.measured[n]) for n in made.found}
    draw_wear(changes[FIRST], made.measured[FIRST], FIRST, HERE / "new_against_worn.png")
    draw_cycles(changes, HERE / "by_cycle.png")
    write_tables(made.table, changes)
    write_page(made, changes, wear(made.free, made.measured[FIRST]))


def main() -> None:
    data = Path(os.environ.get("FOAMFIT_DATA", "")) / "shoe-foam-twins"
    if not data.is_dir():
        sys.exit(f"there is no {data}; set FOAMFIT_DATA to the folder with shoe-foam-twins/")
    with tempfile.TemporaryDirectory() as temporary:
        made = measure(data, Path(temporary))
    write(made)


if __name__ == "__main__":
    from unchanged import keep_unchanged

    with keep_unchanged(HERE):
        main()
