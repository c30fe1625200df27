"""Scene files: a chain and a drive, read for `foamfit simulate`, and the CSV of the response."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data import toml_file as toml
from foamfit.data.csv_file import read_history
from foamfit.errors import InputError, naming
from foamfit.files import csv_bytes, read_whole, write_file
from foamfit.solve.simulation import Response
from foamfit.springs import laws
from foamfit.springs.chain import Chain, DisplacementDrive, Drive, Impact, StressDrive
from foamfit.springs.laws.record import COMMON, Param
from foamfit.springs.published import published
from foamfit.springs.spring import Spring

RESPONSE = "time (s),base stress (Pa),strain"  # first columns of the CSV of a response
_MOST_SAMPLES = 1_000_000
_Keys = dict[str, toml.Check]
# Check of a quantity whose sign the chain or the drive checks.
_any = partial(toml.Quantity, positive=False)


def _of(param: Param) -> toml.Quantity:
    return _any(param.unit.replace(" ", "*"), param.example or f"1 {param.unit}".strip())


def _one_of(words: Iterable[str]) -> toml.Rule:
    *known, last = words
    return toml.Rule(lambda v: v in (*known, last), f"{', '.join(known)} or {last}")


_MASS = _any("kg", "7 g")
_TERM = {key: _of(COMMON[key]) for key in ("g", "tau")}
_EXAMPLE = '{ g = 0.5, tau = "0.2 s" }'
_RELAXATION = toml.Several(
    toml.Table(_TERM, _EXAMPLE, tuple(_TERM)), f"of terms like [{_EXAMPLE}]", "term"
)
_CHAIN: _Keys = {
    "area": _any("m**2", "19.6 mm^2"),
    "diameter": _any("m", "5 mm"),
    "springs": toml.anything,
    "site_damping": _any("Pa*s", "0 Pa*s"),
}
_SPRING: _Keys = {"kind": toml.anything, "height": _of(COMMON["height"]), "mass": _MASS}
_IMPACT: _Keys = {
    "kind": toml.anything,
    "mass": _MASS,
    "velocity": _any("m/s", "1.75 m/s"),
    "gravity": _any("m/s**2", "9.81 m/s^2"),
}
_TIME: _Keys = {
    "end": toml.Quantity("s", "1 ms"),
    "samples": toml.Rule(
        lambda v: type(v) is int and 2 <= v <= _MOST_SAMPLES,
        f"a whole number from 2 to {_MOST_SAMPLES}",
    ),
}
_FILE: _Keys = {
    "kind": toml.anything,
    "file": toml.Rule(lambda v: isinstance(v, str), 'a CSV like "drive.csv"'),
}


def read_scene(path: Path) -> tuple[Chain, Drive, Array]:
    """Read chain, drive and sample times (s); `foamfit simulate --help` lists the keys."""
    document = toml.load_toml(path, "give the TOML file of a scene")
    toml.check_keys(f"{path}:", document, ["chain", "drive", "time"])
    with naming(path):
        chain, table = _chain(_table(document, "chain")), _table(document, "drive")
        kind = _one_of(("impact", "stress", "displacement"))(table.get("kind"), "[drive] kind")
        if kind == "impact":
            samples = toml.checked(_table(document, "time"), _TIME, "[time]", ["end"])
            time = np.linspace(0.0, samples["end"], samples.get("samples", 501))
            striker = toml.checked(table, _IMPACT, "[drive]", ["mass", "velocity"])
            del striker["kind"]
            with naming("[drive]"):
                return chain, Impact(**striker), time
        file = toml.checked(table, _FILE, "[drive]", ["file"])["file"]
        if "time" in document:
            raise InputError("[time] must be left out, the samples are those of the drive.")
    time, values = read_history(path.parent / file, kind)
    return chain, StressDrive(values) if kind == "stress" else DisplacementDrive(values), time


def _table(document: dict[str, Any], name: str) -> dict[str, Any]:
    if not isinstance(document.get(name), dict):
        raise InputError(f"the table [{name}] is missing; see foamfit simulate --help.")
    return document[name]  # type: ignore[no-any-return]


def _chain(table: dict[str, Any]) -> Chain:
    if "published" in table:
        toml.check_keys("[chain]", table, ["published"])
        return published[_one_of(published)(table["published"], "[chain] published")].chain
    found = toml.checked(table, _CHAIN, "[chain]", [] if "diameter" in table else ["area"])
    if {"diameter", "area"} <= found.keys():
        raise InputError("[chain] has both a diameter and an area; give one of them.")
    area = found["area"] if "area" in found else math.pi / 4.0 * found["diameter"] ** 2
    tables = found.get("springs")
    if not isinstance(tables, list) or not tables or not all(isinstance(t, dict) for t in tables):
        raise InputError("[chain] needs springs, each under [[chain.springs]], base first.")
    springs, heights, masses = zip(*(_spring(t, i) for i, t in enumerate(tables, 1)), strict=True)
    with naming("[chain]"):
        return Chain(springs, heights, area, masses, site_damping=found.get("site_damping", 0.0))


def _spring(table: dict[str, Any], number: int) -> tuple[Spring, float, float]:
    """Return a spring, its height, m, and the mass above it, kg."""
    where = f"[chain] spring {number}"
    law = laws.law(_one_of(laws.kinds())(table.get("kind"), f"{where}: kind"))
    every = laws.options_of(law.kind)
    wide = laws.law(laws.with_options(law.kind, every))  # with all parameters that options can free
    law = wide if set(wide.own) - set(law.own) & set(table) else law
    keys = _SPRING | {name: _of(param) for name, param in law.by_name.items()}
    keys |= {"relaxation": _RELAXATION} if law.hysteretic else {}
    needed = [name for name, param in law.by_name.items() if param.neutral is None]
    found = toml.checked(table, keys, f"{where}:", [*needed, "height"])
    values: list[Any] = [found.get(name, param.neutral) for name, param in law.by_name.items()]
    terms = [(term["g"], term["tau"]) for term in found.get("relaxation", ())]
    with naming(where):
        return law.make(values, terms), found["height"], found.get("mass", 0.0)


def check_target(path: Path) -> None:
    """Raise InputError if the path is a file other than the response of an earlier run."""
    if path.is_file() and not read_whole(path, len(RESPONSE)).startswith(RESPONSE.encode()):
        raise InputError(f"{path} exists and is not a response of foamfit; choose another name")


def write_response(response: Response, path: Path) -> None:
    """Write a response as CSV in SI units, one row per sample; an older file stays on failure."""
    nodes = range(1, len(response.displacement) + 1)
    header = [*RESPONSE.split(","), *(f"displacement_{i} (m)" for i in nodes)]
    columns = [response.time, response.base_stress, response.strain, *response.displacement]
    write_file(path, csv_bytes([header, *np.transpose(columns).tolist()]))
