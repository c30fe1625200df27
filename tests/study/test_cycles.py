"""Separate fits of the cycles of a record, and the folder of their results."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fabricated
import foamfit as ff
from conftest import (
    DATA,
    few_bytes,
    needs_data,
    run,
    run_refused,
    specimen_toml,
    thinned,
    without_pictures,
)
from cycled import ONSETS, SETS, write_record
from foamfit.study import cycles as cycles_report


@pytest.fixture(scope="module")
def record(tmp_path_factory) -> Path:
    return write_record(tmp_path_factory.mktemp("record"))


@pytest.fixture(scope="module")
def found(record):
    return ff.fit_cycles(record, cycles=(1, 2, 3, 7), starts=4, intervals="local")


def test_each_cycle_is_fitted_from_its_own_contact(found):
    assert found.recorded == (1, 2, 3)
    assert list(found.results) == [1, 2, 3]
    for result, onset, gone in zip(found.results.values(), ONSETS, SETS, strict=True):
        assert result.measurement.start_strain == pytest.approx(gone, abs=1e-3)
        assert result.params["s1_eps_a"].value == pytest.approx(onset, abs=2e-3)
        assert result.misfit["stress_strain"] < 0.01
    # Up to the limit all loops are drawn.
    several = replace(found, results=dict.fromkeys(range(1, 9), found.results[1]))
    lines = [line for ax in cycles_report.plot_cycles(several).axes for line in ax.lines]
    assert sum(line.get_label() == "_measured" for line in lines) == 8


def test_a_cycle_that_is_not_there_is_a_row_with_its_sentence(found):
    assert list(found.refused) == [7]
    assert "cycle 7 cannot be taken: the file has cycles 1 to 3" in found.refused[7]
    row = found.by_cycle.loc[7]
    assert row["status"] == "refused"
    assert row["error"] == found.refused[7]
    assert np.isnan(row["s1_k0"])


@pytest.mark.parametrize("at", ["reading", "fit"])
def test_ctrl_c_keeps_what_was_found(record, monkeypatch, at):
    tried, real = [], cycles_report.fit

    def fit(*words, **options):
        tried.append(1)
        if at == "fit" and len(tried) == 2:  # like an interrupted fit
            return replace(real(*words, **options), stopped="Ctrl-C")
        if at == "reading" and len(tried) == 2:
            raise KeyboardInterrupt
        return real(*words, **options)

    monkeypatch.setattr(cycles_report, "fit", fit)
    kept = ff.fit_cycles(record, starts=2, intervals="local")
    assert list(kept.results) == {"reading": [1], "fit": [1, 2]}[at]
    assert all("Ctrl-C" in why for why in kept.refused.values())
    assert len(kept.results) + len(kept.refused) == 3


def test_the_folder_holds_every_cycle_and_replaces_an_older_one(found, tmp_path, monkeypatch):
    without_pictures(monkeypatch)
    monkeypatch.setattr(cycles_report, "plot_cycles", lambda *_, **__: None)
    monkeypatch.setattr(cycles_report.figures, "write_both", few_bytes)
    folder = tmp_path / "out"
    found.results[1].save(folder)  # folder of a fit of one cycle
    found.save(folder)
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "cycle-1", "cycle-2", "cycle-3",
        "cycles.csv", "cycles.json", "cycles.pdf", "cycles.png", "table.tex",
    }  # fmt: skip
    assert json.loads((folder / "cycle-2" / "fit.json").read_text())["data"]["cycle"] == 2
    with (folder / "cycles.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["cycle"] for row in rows] == ["1", "2", "3", "7"]
    assert float(rows[2]["start_strain"]) == found.results[3].measurement.start_strain
    assert float(rows[0]["s1_k0"]) == found.results[1].parameters["s1_k0"].value
    assert rows[0]["s1_k0_state"] == "determined"
    assert float(rows[1]["dissipated_energy"]) > 0.0
    content = json.loads((folder / "cycles.json").read_text())
    assert content["refused"]["7"] == found.refused[7]
    found.save(folder)
    found.results[1].save(folder)
    assert "cycles.csv" not in {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("cycle", ["0", "x", "1,,2", "-1", "1.5", ""])
def test_what_is_no_cycle_is_refused(record, tmp_path, cycle):
    told = run_refused("fit", record, "--cycle", cycle, "--out", tmp_path / "out")
    assert "must be a number from 1 up, several as 1,2,10, or all" in told
    assert not (tmp_path / "out").exists()


def test_one_cycle_is_fitted_as_any_test(record, tmp_path, monkeypatch):
    without_pictures(monkeypatch)
    result = run("fit", record, "--cycle", 2, "--starts", 2, "--out", tmp_path / "out")
    assert "cycle 2 of 3 in the record, start strain" in result.stdout
    content = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert content["data"]["start_strain"] == pytest.approx(0.02, abs=1e-3)
    assert any("Contact of cycle 2 starts" in note for note in content["data"]["notes"])


def test_cycles_of_different_models_are_one_table():
    plain, relaxing = fabricated.microscale_result(), fabricated.microscale_result()
    terms = {n: p for n, p in plain.parameters.items() if n not in ("s1_g1", "s1_tau1")}
    fits = {1: replace(plain, parameters=terms), 2: relaxing}
    *_, first, second = ff.CycleFits("foam", "auto", (1, 2), fits, {}).text().splitlines()
    assert first.split()[-2:] == ["–", "–"]
    assert "–" not in second


@needs_data
def test_two_cycles_of_a_shoe_foam(tmp_path):
    """Measurements: arXiv:2602.12694."""
    toml = specimen_toml(tmp_path, 9.903, 7.667)
    record = DATA / "shoe-foam-twins" / "new-heel-comp-1_raw.txt"
    path = thinned(record, tmp_path, 4)
    options = {"model": "microscale", "relaxation": 1, "starts": 4, "intervals": "local"}
    found = ff.fit_cycles(path, toml, cycles=(1, 4), **options)
    assert found.recorded == (1, 2, 3, 4, 5, 6)
    strains = found.by_cycle["start_strain"]
    assert strains[1] == 0.0
    assert 0.01 < strains[4] < 0.03
    assert all(off < 0.0065 for off in found.by_cycle["misfit_stress_strain"])


def test_words_are_no_numbers_of_cycles(tmp_path):
    path = write_record(tmp_path)
    for wrong in ("all", [1.5], [0]):
        with pytest.raises(ff.InputError, match=r"cycles: a number = .* whole number from 1 up"):
            ff.fit_cycles(path, cycles=wrong, model="linear")
    for wrong in ("x", 1.5, [1, 0]):
        with pytest.raises(ff.InputError, match=r"cycle = .* whole number from 1 up"):
            ff.batch(path, cycle=wrong, model="linear", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
