"""The state behind a window of the page, without a browser: files, messages, fits, curves."""

import io
import json
import os
import signal
import threading
import time
import tomllib
import zipfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import foamfit as ff
from conftest import EXPERIMENTS, few_bytes, needs_panel, run, without_pictures, write_lines
from cycled import write_record
from foamfit.data import rig as rig_module
from foamfit.data.toml_file import LONGEST
from foamfit.errors import InputError
from foamfit.page import desk as desk_module, worker as worker_module
from foamfit.page.desk import Desk, preview, remedies, with_column
from foamfit.page.turning import Turning
from foamfit.page.worker import News, Worker
from foamfit.report.folder import load_result
from foamfit.study import cycles as cycles_report, plan as plan_module

TEST = EXPERIMENTS / "foam-1" / "model-2-2.0mps-reconstruction.csv"
GOOD = {
    "[specimen] height": "1.19 mm", "[specimen] diameter": "5 mm",
    "[striker] mass": "7 g", "[striker] velocity": "2 m/s",
}  # fmt: skip


@pytest.fixture
def desk(tmp_path):
    desk = Desk(tmp_path / "window")
    yield desk
    desk.close()


@pytest.fixture
def ready(desk):
    """Prepare a desk with a test that is ready to be fitted."""
    desk.check(*desk.take(TEST))
    return desk


class Here(Worker):
    """A worker without a process, because starting one and drawing its report takes seconds."""

    def __init__(self, job, tell):
        self.job, self.news, self.ended, self._tell = job, News(), None, tell
        self._pipe, there = worker_module.processes().Pipe()
        self.process = SimpleNamespace(join=lambda: None, kill=lambda: None)
        threading.Thread(target=self._listen, daemon=True).start()
        with there:
            there.send(worker_module._fitted(job, worker_module._Teller(there)))
            while self.ended is None:
                time.sleep(0.01)


@pytest.fixture
def without_process(monkeypatch):
    """Run fits of a window in this process, with pictures of a few bytes."""
    monkeypatch.setattr(desk_module, "Worker", Here)
    without_pictures(monkeypatch)
    monkeypatch.setattr(cycles_report.figures, "write_both", few_bytes)
    monkeypatch.setattr(cycles_report, "plot_cycles", lambda *_, **__: None)


def wait(worker, until=lambda worker: worker.ended is not None):
    end = time.monotonic() + 60.0
    while not until(worker):
        assert time.monotonic() < end, vars(worker)
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("test 1.csv", "test 1.csv"),
        ("../../etc/passwd.csv", "passwd.csv"),
        ("..\\..\\boot.csv", "boot.csv"),
        ("<img src=x onerror=alert(1)>.csv", None),
        (".hidden.csv", ".hidden.csv"),
        ("a\x00b\n.csv", "a_b_.csv"),
        (f"{'x' * 500}.csv", None),
        ("Schaum Nº 3 – größer.csv", None),
        (" .csv", None),
    ],
)
def test_a_name_is_that_of_one_file_and_of_the_test(desk, tmp_path, given, shown):
    desk.receive(given, TEST.read_bytes())
    desk.receive("/etc/outside.toml", b"")
    assert [*tmp_path.rglob("*.*")] == [desk.folder / "test.csv"]
    assert desk.given == (shown or given)
    desk.check(GOOD, "")
    assert desk.measurement.name == (desk.given[:-4].strip()[:LONGEST] or "test")
    desk.close()
    assert list(tmp_path.iterdir()) == []


def test_what_is_too_large_or_no_table_is_refused(desk, monkeypatch):
    monkeypatch.setattr(desk_module, "LARGEST", 2**20)
    with pytest.raises(InputError, match=r"a\.csv is larger than 1 MB"):
        desk.receive("a.csv", bytes(2**20 + 1))
    for name in ("picture.png", "…", ""):
        with pytest.raises(InputError, match=f"^{name} is not a table"):
            desk.receive(name, b"\x89PNG")
    assert desk.csv is None
    desk.receive("folder/a Größe.csv", b"1,2\n")
    with pytest.raises(InputError, match=r"^a Größe\.csv: "):  # as the user calls it
        desk.check(GOOD, "")
    desk.worker = SimpleNamespace(job=SimpleNamespace(arguments=[]), end=lambda: None)
    assert desk.command == "foamfit fit 'a Größe.csv' --specimen test.toml"


@pytest.mark.parametrize("order", [("a.csv", "a.toml"), ("a.toml", "a.csv")])
def test_a_table_and_a_toml_that_arrive_together_belong_together(desk, order, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(desk_module.time, "monotonic", lambda: now[0])
    desk.receive("before.csv", b"1,2\n")
    filled = {}
    for name in order:
        now[0] += 10.0 * (name == order[0])
        filled[name] = desk.receive(name, b'name = "a"')
    # A table that comes first clears the fields, and then its TOML fills them.
    assert filled["a.csv"] == (({}, "") if order[0] == "a.csv" else None)
    assert filled["a.toml"] == ({}, 'name = "a"\n')
    assert desk.receive("after.csv", b"1,2\n") == ({}, "")


def test_a_toml_is_split_and_joined_without_loss():
    text = """
name = "a \\"foam\\" \\\\ 1"
[specimen]
height = "1.19 mm"
area = "19.6 mm^2"
heights = ["0.7 mm", "0.49 mm"]
[columns]
force = { column = "Load \\t[x]", unit = "V", scale = "4444.4 N/V" }
displacement = { column = "Gap", counts_down = true }
[window]
cycle = 2
"""
    quantities, rest = desk_module.split_toml(text.encode())
    assert quantities == {"[specimen] height": "1.19 mm", "[specimen] area": "19.6 mm^2"}
    assert desk_module.join_toml(quantities, rest) == tomllib.loads(text)
    with pytest.raises(InputError, match=r"\[specimen\] height is also filled in above"):
        desk_module.join_toml(GOOD, '[specimen]\nheight = "2 mm"')


@pytest.mark.parametrize(
    ("quantity", "value", "told"),
    [
        ("[specimen] height", "5 kg", "wrong dimension"),
        ("[specimen] height", "", "height is missing"),
        ("[specimen] diameter", "", "needs a diameter"),
        ("[striker] velocity", "fast", "velocity"),
    ],
)
def test_a_wrong_quantity_is_named(desk, quantity, value, told):
    desk.take(TEST)
    with pytest.raises(InputError, match=told) as refused:
        desk.check(GOOD | {quantity: value}, "")
    assert desk_module.wrong_quantity(str(refused.value)) == quantity
    assert str(desk.folder) not in str(refused.value)
    assert desk.measurement is None


@pytest.mark.usefixtures("without_process")
def test_cycles_and_what_is_held_are_those_of_the_command(desk, tmp_path):
    record = write_record(tmp_path)
    desk.check(*desk.take(record), ["--cycle", "3,2"])
    assert (desk.measurement.cycle, desk.measurement.cycles) == (3, (1, 2, 3))
    asked = ["--cycle", "3,2", "--fix=s1_kh_minus=2200000.0", "--vary=s1_eta", "--starts", "2"]
    desk.fit(asked)
    assert desk.ending() == ""
    assert desk.command == f"foamfit fit synthetic.csv --specimen test.toml {' '.join(asked)}"
    assert "2 of 3 cycles fitted" in ff.load(desk.result).text()
    told = run("fit", str(record), *asked, "--json", f"--out={tmp_path}/r")
    command = json.loads(told.stdout)["cycles"]
    assert sorted(desk.fits) == [2, 3]
    for number, folder in desk.fits.items():
        page = load_result(folder)
        assert page["parameters"] == command[str(number)]["parameters"]
        assert page["statistics"] == command[str(number)]["statistics"]
        assert page["parameters"]["s1_kh_minus"]["value"] == 2.2e6
        assert page["parameters"]["s1_eta"]["vary"]
        assert desk.measured(number, None).cycle == number
    with zipfile.ZipFile(io.BytesIO(desk.zipped())) as archive:
        assert {"cycles.csv", "cycles.png", "cycle-3/fit.json"} <= {*archive.namelist()}


def test_a_fit_that_is_stopped_keeps_the_best(ready):
    worker = ready.fit(["--starts", "100000"])
    wait(worker, lambda worker: worker.news.misfit)
    assert worker.news.model == "bistable"
    assert set(worker.news.values) >= {"s1_k0", "s1_eta"}
    with pytest.raises(InputError, match="A fit is running"):
        ready.fit([])
    # The data cannot be changed during a fit.
    with pytest.raises(InputError, match="A fit is running"):
        ready.receive("other.csv", b"1,2\n")
    with pytest.raises(InputError, match="A fit is running"):
        ready.check(GOOD, "")
    worker.stop()
    wait(worker)
    assert worker.ended == ""
    assert load_result(ready.result)["stopped"] == "Ctrl-C"
    assert "report.html" in {path.name for path in ready.result.iterdir()}
    assert ready.zipped().startswith(b"PK")


def test_a_worker_that_dies_says_so(ready):
    worker = ready.fit(["--starts", "100000"])
    os.kill(worker.process.pid, signal.SIGKILL)
    wait(worker)
    assert ready.ending() == "The process of the fit has died by SIGKILL; start the fit again."
    assert ready.result is None


def compiling():
    """Compile for a minute; at module level so that it can be pickled."""
    time.sleep(60.0)


def test_what_compiles_at_first_use_is_waited_for_and_ends_with_the_page(monkeypatch):
    monkeypatch.setattr(worker_module.cache, "compiled", lambda _: False)
    monkeypatch.setattr(worker_module, "_compile", compiling)
    first_use = worker_module.FirstUse()
    wait(first_use, lambda one: one.process.pid is not None)
    assert not first_use.done.done()
    first_use.close()
    assert first_use.done.result(timeout=30.0) is None


@pytest.mark.usefixtures("without_process")
def test_a_fit_that_cannot_be_says_why(ready):
    with pytest.raises(InputError, match="'--relaxation': -1 is not in the range"):
        ready.fit(["--relaxation", "-1"])
    worker = ready.fit(["--fix", "s1_k1=1"])
    assert "parameter 's1_k1' is not one of the model bistable" in worker.ended
    assert "\n" not in worker.ended


def test_a_closed_window_ends_its_fit(ready):
    worker = ready.fit(["--starts", "100000"])
    wait(worker, lambda worker: worker.news.what != "starting")
    ready.close()
    wait(worker)
    with pytest.raises(ProcessLookupError):
        os.kill(worker.process.pid, 0)


@pytest.mark.parametrize("drive", ["impact", "displacement"])
def test_turned_curves_are_those_of_a_simulation(drive):
    measurement = ff.read_test(TEST)
    if drive == "displacement":  # prescribe the motion as measured, without smoothing
        noise = replace(measurement.noise, displacement=0.0)
        measurement = replace(measurement, noise=noise)
    turning = Turning(measurement, "bistable", drive=drive)
    before = turning.turn({})
    drawn = turning.turn({"s1_k0": 1.3 * turning.named["s1_k0"]})
    spring = ff.BistableSpring(**{n[3:]: v for n, v in turning.named.items() if n[:3] == "s1_"})
    chain = ff.Chain([spring], [1.19e-3], measurement.specimen.area)
    drives = {
        "impact": ff.Impact(7e-3, 2.0),
        # without contact below zero
        "displacement": ff.DisplacementDrive(np.maximum(measurement.displacement, 0.0)),
    }
    response = ff.simulate(chain, drives[drive], measurement.time)
    strain, stress = drawn.curves["stress_strain"]
    size = np.ptp(measurement.stress)
    np.testing.assert_allclose(stress, response.base_stress, rtol=0.0, atol=1e-5 * size)
    along = response.strain if drive == "impact" else measurement.displacement / 1.19e-3
    np.testing.assert_allclose(strain, along, rtol=0.0, atol=1e-5)
    assert not np.allclose(stress, before.curves["stress_strain"][1], atol=1e-2 * size)


@needs_panel
def test_the_notebook_shows_a_history(tmp_path):
    from foamfit.page.curves import Curves

    record = ff.read_test(write_record(tmp_path), cycles=(1, 3))
    curves = Curves(Turning(record, "microscale", mullins=True))
    assert "cycles 1 to 3: misfit" in curves.sliders.told
    assert np.isfinite(curves._turned.data["stress_strain_x"]).sum() > 600
    curves.put({"s1_k0": -1.0})  # not admissible
    assert curves.sliders.wrong


@needs_panel
def test_ticks_say_what_a_fit_holds_and_varies():
    from foamfit.page.curves import Curves

    curves = Curves(Turning(ff.read_test(TEST), "bistable"))
    assert curves.chosen() == ({}, [])
    moves = {"s1_k0": 5.0, "site_eta": 7.0}  # MPa, Pa s
    curves._moved(SimpleNamespace(data={"moves": moves}))
    assert curves.chosen() == ({"site_eta": 7.0}, [])  # fixed by default, here at another value
    curves._moved(SimpleNamespace(data={"held": {"s1_k0": True, "s1_eta": True, "no_one": True}}))
    held, varied = curves.chosen()
    assert (held["s1_k0"], set(held), varied) == (5e6, {"s1_k0", "s1_eta", "site_eta"}, [])
    curves._moved(SimpleNamespace(data={"held": {"s1_k0": False, "site_eta": False}}))
    assert (set(curves.chosen()[0]), curves.chosen()[1]) == ({"s1_eta"}, ["site_eta"])
    # Ticks agree with the defaults of a chain: dashpots fixed, onsite damper varied.
    curves.found = {"s2_kc": {"ci95": [80e6, 85e6], "range": None}}
    curves.show(Turning(ff.read_test(TEST), "linear+bistable"))
    bars = {r["name"]: r["interval"] for r in curves.sliders.rows if "interval" in r}
    assert bars == {"s2_kc": [80.0, 85.0]}  # in MPa, the unit of the slider
    assert not any("range" in row for row in curves.sliders.rows)
    assert curves.chosen() == ({}, [])


ROWS = [f"{0.01 * k},{k},{0.02 * k}" for k in range(60)]


def test_a_file_is_drawn_without_its_specimen(tmp_path):
    found = preview(write_lines(tmp_path, ["time (s),force (N),displacement (mm)", *ROWS]), "")
    assert found.headers == ("time (s)", "force (N)", "displacement (mm)")
    assert found.picture.startswith(b"\x89PNG")


def test_a_file_with_unclear_columns_has_its_headers_and_is_drawn_with_them(tmp_path):
    path = write_lines(tmp_path, ["when,Load (kN),Crosshead", *ROWS])
    found = preview(path, "")
    assert found.headers == ("when", "Load (kN)", "Crosshead")
    assert found.picture is None
    assert "Use Crosshead in mm as displacement" in remedies(found.why)
    rest = with_column("", "displacement", {"column": "Crosshead", "unit": "mm"})
    rest = with_column(rest, "time", {"column": "when", "unit": "s"})
    assert preview(path, rest).picture is not None


def test_what_is_no_table_shows_nothing(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("hello\n", encoding="utf-8")
    assert preview(path, "") == preview(tmp_path / "missing.csv", "") == ((), None, "")


def test_the_entries_that_a_message_proposes_are_remedies():
    message = (
        "column 'Load' has no unit; write it in the header like 'force (kN)' or in [columns] like "
        'force = { column = "Load", unit = "kN" } or displacement = { column = "…", unit = "mm" }'
    )
    entry = {"column": "Load", "unit": "kN"}
    assert remedies(message) == {"Use Load in kN as force": ("force", entry)}


def test_an_entry_is_replaced_and_removed_and_the_rest_stays():
    rest = 'name = "a"\n[columns]\nforce = { column = "F" }\n'
    new = with_column(rest, "force", {"column": 2, "unit": "kN"})
    assert 'name = "a"' in new
    assert '"F"' not in new
    assert "columns" not in with_column(new, "force", {})
    with pytest.raises(InputError, match="not valid TOML"):
        with_column("[columns", "force", {"column": "F"})


def test_a_fit_offers_its_card_and_the_plan_of_the_next_test(desk, tmp_path, monkeypatch):
    ff.fit(ff.read_test(TEST), starts=2, intervals="local").save(tmp_path / "fit", report=False)
    monkeypatch.setattr(Desk, "fits", {0: tmp_path / "fit"})
    monkeypatch.setattr(plan_module, "DRAWS", 10)  # most of the time
    monkeypatch.setattr(rig_module, "VELOCITIES", 8)
    names = zipfile.ZipFile(io.BytesIO(desk.card(0))).namelist()
    assert {"foam.k", "foam.k.json"} <= set(names)
    assert b"which test next?" in desk.planned(0)
