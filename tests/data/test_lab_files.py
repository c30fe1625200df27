"""Files as testing machines and oscilloscopes write them.

The layouts are those of the instruments; all values are synthetic.
"""

import gzip
import sys
from functools import partial

import numpy as np
import pytest

from conftest import SPECIMEN, STRIKER, refused, run, run_refused, write_lines
from foamfit.data.csv_file import read_test

COLUMNS = SPECIMEN + "[columns]\n"
N = 161
TIME = np.linspace(0, 30, N)  # s
LOOP = np.sin(np.linspace(0, np.pi, N))
TURN = np.arange(N) > N // 2
FORCE = 200 * LOOP * np.where(TURN, LOOP, 1.0)  # N, up to 2 MPa; lower in unloading
MOTION = 4 * LOOP  # mm
write = partial(write_lines, newline="\r\n")


def rows(*columns, sep=",", decimal=".", form=".6f"):
    lines = (sep.join(format(v, form) for v in row) for row in zip(*columns, strict=True))
    return [line.replace(".", decimal) for line in lines]


def expect(test, time=TIME[-1]):
    """Check that the test contains the synthetic loop."""
    assert test.stress.max() == pytest.approx(2e6, rel=1e-5)
    assert test.displacement.max() == pytest.approx(4e-3, rel=1e-5)
    assert (None if test.time is None else test.time[-1]) == pytest.approx(time)


def asked(test):
    return [note for note in test.notes if note.startswith("Check:")]


# ------------------------------------------------------------------------- testing machines


def test_bluehill_universal(tmp_path):
    head = [
        "Results Table 1",
        "",
        '"Time","Displacement","Force","Compressive strain (Displacement)","Compressive stress"',
        '"(s)","(mm)","(kN)","(%)","(MPa)"',
    ]
    body = rows(TIME, MOTION, FORCE / 1e3, 10 * MOTION, FORCE / 100, form=".9f")
    lines = [*head, *('"' + row.replace(",", '","') + '"' for row in body)]
    expect(test := read_test(write(tmp_path, lines)))
    assert "strain from 'Compressive strain (Displacement) (%)'" in test.notes[0]
    named = 'strain = { column = "Compressive strain (Displacement)" }\n'
    expect(test := read_test(write(tmp_path, lines, COLUMNS + named)))
    assert "displacement from" not in test.notes[0]
    assert any("displacement 'Displacement (mm)' is left out; it differs" in n for n in test.notes)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "utf-16", "mac_roman"])
@pytest.mark.parametrize(
    ("header", "units", "columns"),
    [
        ("Prüfzeit;Standardkraft;Standardweg", "s;N;mm", (TIME, FORCE, MOTION)),
        ("Prüfzeit;Druckspannung;Stauchung", "s;N/mm^2;%", (TIME, FORCE / 100, 10 * MOTION)),
        ("Prüfzeit;Druckspannung;Stauchung", "s;MPa;mm", (TIME, FORCE / 100, MOTION)),
        ("Zeit in s;Kraft in N;Weg in mm", None, (TIME, FORCE, MOTION)),
        ("Prüfzeit, s;Prüfkraft, N;Weg, mm", None, (TIME, FORCE, MOTION)),
    ],
)
def test_a_german_testing_machine(tmp_path, encoding, header, units, columns):
    head = ["Prüfprotokoll;Druckversuch", "Prüfer;Mustermann", "", header]
    lines = [*head, *([units] if units else []), *rows(*columns, sep=";", decimal=",")]
    expect(read_test(write(tmp_path, lines, encoding=encoding)))


@pytest.mark.parametrize("unit", ["V", ""])
def test_a_german_voltage_is_no_stress(tmp_path, unit):
    lines = [f"Zeit (s);Spannung ({unit});Weg (mm)", *rows(TIME, FORCE, MOTION, sep=";")]
    refused(write(tmp_path, lines), "no column is a stress or a force", "Spannung")


# ------------------------------------------------------------------------------- separators


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize(
    "head",
    [
        ["time (s)  force (N)  displacement (mm)"],
        ["time (s) force (N) displacement (mm)"],
        ["# time_s force_N displacement_mm"],
        ["Compression test of a foam", "", "Time      Force     Displacement", "s N mm"],
        ["Time      Force     Displacement", "(s)       (N)       (mm)", "-----     -----   ----"],
    ],
)
def test_columns_may_be_separated_by_blanks(tmp_path, head, decimal):
    lines = [*head, *rows(TIME, FORCE, MOTION, sep="   ", decimal=decimal)]
    expect(test := read_test(write(tmp_path, lines)))
    assert test.rows.rows == N


@pytest.mark.parametrize(
    ("head", "day", "sep", "decimal"),
    [
        ("Time", "", ",", "."),
        ("Time (hh:mm:ss)", "2026-05-03 ", "\t", "."),
        ("Zeit", "3/5/2026 ", ";", ","),
        ("Time", "03-May-2026 ", ",", "."),
        ("Elapsed time (mm:ss.0)", None, "\t", "."),  # past the hour
    ],
)
def test_a_time_of_day(tmp_path, head, day, sep, decimal):
    others = rows(FORCE, MOTION, sep=sep, decimal=decimal)
    body = [
        (f"{day}{t // 3600:.0f}:" if day is not None else "")
        + f"{t // 60 % 60:02.0f}:{t % 60:07.4f}{sep}".replace(".", decimal) + row
        for t, row in zip(9 * 3600 + 59 * 60 + 41 + TIME, others, strict=True)
    ]  # fmt: skip
    path = write(tmp_path, [sep.join([head, "force (N)", "displacement (mm)"]), *body])
    expect(read_test(path))
    path.write_text(path.read_text().replace(f":41{decimal}1875", ":61"))
    refused(path, "row 3", "59:61'; it must be a number or a time like 0:01:30")


def test_a_time_of_day_in_twelve_hours_past_midnight(tmp_path):
    """A clock of a laboratory PC: 11:59:59.5 PM, then 12:00:00.0 AM."""
    halves = [
        f"{(t // 3600 + 11) % 12 + 1:.0f}:{t // 60 % 60:02.0f}:{t % 60:07.4f} {half}"
        for t in 23 * 3600 + 59 * 60 + 58.5 + TIME
        for half in ["PM" if t < 24 * 3600 else "AM"]
    ]
    body = [f"{t},{more}" for t, more in zip(halves, rows(FORCE, MOTION), strict=True)]
    path = write(tmp_path, ["Timestamp,force (N),displacement (mm)", *body])
    assert "12:00:00" in path.read_text()
    assert "11:59:59" in path.read_text()
    expect(read_test(path))


@pytest.mark.parametrize("missing", ["NaN,NaN", "#N/A,#N/A", ",nan"])
def test_rows_without_a_measured_number(tmp_path, missing):
    body = rows(TIME, FORCE, MOTION)
    for place in (N, 40, 0):
        body.insert(place, f"{TIME[min(place, N - 1)] + 0.01},{missing}")
    path = write(tmp_path, ["time (s),force (N),displacement (mm)", *body])
    test = read_test(path)
    assert test.displacement.max() == pytest.approx(4e-3, rel=1e-5)
    assert test.rows.rows == N + 3
    path.write_text(path.read_text().replace(missing, "1.0,NaN"))
    refused(path, "row 2", "'NaN'; it must be a finite number")


def test_a_clock_coarser_than_the_rows(tmp_path):
    """Averages of the rows with one stamp, one or several, had times off by half a step."""
    coarse = rows(np.floor(TIME / 0.5) * 0.5, FORCE, MOTION)
    test = read_test(write(tmp_path, ["time (s),force (N),displacement (mm)", *coarse]))
    assert test.time.size >= N - 2
    assert np.diff(test.time) == pytest.approx(TIME[1], rel=0.01)
    assert any("clock is coarser than the rows" in note for note in test.notes)


def test_columns_of_fixed_width(tmp_path):
    width = "{:>10}{:>18}{:>22}{:>8}"
    head = [
        width.format("Test time", "Standard force", "Top displacement", "Cycles"),
        width.format("(s)", "(N)", "(mm)", ""),
    ]
    body = [
        width.format(f"{t:.2f}", f"{f:.5f}", f"{w:.6f}", 1)
        for t, f, w in zip(TIME, FORCE, MOTION, strict=True)
    ]
    expect(read_test(write(tmp_path, [*head, *body])))
    gap = [*body[:20], body[20][:10] + 18 * " " + body[20][28:], *body[21:]]
    refused(write(tmp_path, [*head, *gap]), "row 23", "'Standard force (N)' is empty")
    for first in (0, 100):  # R does not name the column of row numbers
        numbered = [f"{i} {row}" for i, row in enumerate(rows(TIME, FORCE, MOTION, sep=" "), first)]
        refused(write(tmp_path, ["time_s force_N displacement_mm", *numbered]), "row 2 has 4 cells")


@pytest.mark.parametrize("sep", [",", ";", "\t", " ", "|"])
def test_without_headers_columns_have_numbers(tmp_path, sep):
    lines = rows(FORCE, TIME, MOTION, sep=sep)
    refused(write(tmp_path, lines), "no row names the columns", "time = { column = 1, unit")
    toml = COLUMNS + (
        'time = { column = 2, unit = "s" }\nforce = { column = 1, unit = "N" }\n'
        'displacement = { column = 3, unit = "mm" }\n'
    )
    test = read_test(write(tmp_path, lines, toml))
    expect(test)
    assert "force from 'column 1' in N" in test.notes[0]
    assert test.rows.rows == N
    refused(write(tmp_path, lines, toml.replace("3", "7")), "column 7", "has 3 columns")
    refused(write(tmp_path, lines, toml.replace("= 3", "= 0")), "column = 2")
    refused(write(tmp_path, lines, toml.replace("N", "mm")), "'column 1'", "wrong dimension")


@pytest.mark.parametrize(
    ("names", "encoding"),
    [("Aika [s],Voima [N],Siirtymä [mm]", "utf-8"), ("時間 [s],荷重 [N],変位 [mm]", "cp932"),
     ("Âðåìÿ [s],Ñèëà [N],Õîä [mm]", "latin-1")],  # of Время, Сила, Ход in cp1251
)  # fmt: skip
def test_a_header_not_understood_is_quoted_with_the_lines_that_help(tmp_path, names, encoding):
    lines, quoted = [names, *rows(TIME, FORCE, MOTION)], [f'"{n}"' for n in names.split(",")]
    channels = zip(("time", "force", "displacement"), quoted, strict=True)
    helping = [f"{channel} = {{ column = {name} }}" for channel, name in channels]
    there = "there are " + ", ".join(quoted[:2]).replace('"', "'")
    said = refused(write(tmp_path, lines, encoding=encoding), there, *helping)
    assert ("save the file as UTF-8" in said) == (encoding != "utf-8")
    expect(read_test(write(tmp_path, lines, COLUMNS + "\n".join(helping), encoding=encoding)))
    lines[0] = "Aika,Voima,Siirtymä"
    refused(write(tmp_path, lines), "'Voima'", 'force = { column = "…", unit = "N" }')


def test_tests_side_by_side_are_chosen_by_number(tmp_path):
    short = rows(TIME, FORCE, MOTION)
    long = rows(*(np.interp(np.linspace(0, 30, N + 9), TIME, v) for v in (TIME, FORCE / 2, MOTION)))
    body = [f"{a},{b}" for a, b in zip(short + 9 * [",,"], long, strict=True)]
    name = "Time (s),Force (N),Displacement (mm)"
    lines = ["Specimen 1,,,Specimen 2,,", f"{name},{name}", *body]
    refused(write(tmp_path, lines), "'Time (s)' (number 1)", "(number 4)", "time = { column = 1 }")

    def chosen(first):
        names = ("time", "force", "displacement")
        return COLUMNS + "".join(f"{c} = {{ column = {k} }}\n" for k, c in enumerate(names, first))

    test = read_test(write(tmp_path, lines, chosen(1)))
    expect(test)
    assert (test.rows.rows, test.rows.used) == (N + 9, N)
    assert "no numbers in the columns" in test.rows.dropped[0].why
    test = read_test(write(tmp_path, lines, chosen(4)))
    assert test.stress.max() == pytest.approx(1e6, rel=1e-2)
    assert "force from 'Force (N)' (number 5)" in test.notes[0]
    twice = COLUMNS + 'time = { column = 1 }\nforce = { column = "Force (N)" }\n'
    refused(write(tmp_path, lines, twice), "'Force (N)' is twice", "column = 2 or 5")


# ------------------------------------------------------------------------------ oscilloscopes

VOLTS = FORCE / 100  # V at 100 N/V
SCALED = (
    'force = { column = "%s", scale = "100 N/V" }\n'
    'displacement = { column = "%s", scale = "10 mm/V" }\n'
)


PICO = ["Time,Channel A,Channel B", "(ms),(V),(mV)", ""]
KEYSIGHT = ["x-axis,1,2", "second,Volt,Volt"]
TEKTRONIX = ["Model,MSO54", "Horizontal Units,s", "Vertical Units,V,mV", "Record Length,161", "",
             "TIME,CH1,CH2"]  # fmt: skip


@pytest.mark.parametrize(
    ("head", "scales", "form", "names"),
    [
        (PICO, (1.0, 100.0), ".6f", ("Channel A", "Channel B")),
        (KEYSIGHT, (1e-3, 0.1), "+.9E", ("1", "2")),
        (KEYSIGHT, (1e-3, 0.1), "+.9E", ("1 (Volt)", "2 (Volt)")),
        (TEKTRONIX, (1e-3, 100.0), ".9f", ("CH1", "CH2")),
    ],
)
def test_an_oscilloscope(tmp_path, head, scales, form, names):
    lines = [*head, *rows(scales[0] * TIME, VOLTS, scales[1] * MOTION, form=form)]
    test = read_test(write(tmp_path, lines, COLUMNS + SCALED % names))
    expect(test, TIME[-1] / 1e3)
    assert "times 100 N/V" in test.notes[0]
    refused(write(tmp_path, lines), "no column is a stress or a force")


@pytest.mark.parametrize("name", ["Channel A", "Kanal C", "CH F", "Input K"])
def test_the_name_of_a_channel_is_no_unit(tmp_path, name):
    lines = [f"Time (s),{name},displacement (mm)", *rows(TIME, VOLTS, MOTION)]
    entry = f'force = {{ column = "{name}", scale = "100 N/V"'
    path = write(tmp_path, lines, COLUMNS + entry + " }\n")
    refused(path, "has no unit", entry.split(",")[0], '"V"')
    expect(read_test(write(tmp_path, lines, COLUMNS + entry + ', unit = "V" }\n')))


@pytest.mark.parametrize("end", ["", ","])
def test_rigol(tmp_path, end):
    head = ["X,CH1,CH2,Start,Increment" + end, "Sequence,VOLT,VOLT,-1.0e-03,5.0e-04" + end]
    lines = [*head, *(row + ",," for row in rows(np.arange(N), VOLTS, MOTION / 10))]
    test = read_test(write(tmp_path, lines, COLUMNS + SCALED % ("CH1", "CH2")))
    expect(test, (N - 1) * 5e-4)
    assert test.origins["contact_time"] == pytest.approx(-1e-3)
    for damaged in ("Increment", "-1.0e-03"):
        refused(write(tmp_path, [line.replace(damaged, "?") for line in lines]), "no column is a")


def test_tds(tmp_path):
    said = [
        "Record Length,1.610000e+02", "Sample Interval,5.0e-04", "Trigger Point,1.0e+01", ",", ",",
        ",", "Source,CH1", "Vertical Units,V", "Vertical Scale,5.0e-01", "Vertical Offset,0.0e+00",
        "Horizontal Units,s", "Horizontal Scale,2.5e-04", "Pt Fmt,Y", "Yzero,0.0e+00",
        "Probe Atten,1.0e+00", "Model Number,TDS2014", "Serial Number,C000000", "Firmware,v22.01",
    ]  # fmt: skip
    body = rows(TIME / 1e3, VOLTS, form="013.9f")
    left = said + [","] * (N - len(said))
    lines = [f"{a},,{b}," for a, b in zip(left, body, strict=True)]
    toml = COLUMNS + 'force = { column = "CH1", scale = "100 N/V" }\n'
    test = read_test(write(tmp_path, lines, toml + STRIKER))
    assert test.stress.max() == pytest.approx(2e6, rel=1e-5)
    assert test.time[-1] == pytest.approx(TIME[-1] / 1e3, rel=0.05)
    assert test.rows.rows == N


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ('unit = "mV", scale = "0.5 N/mV"', "times 0.5 N/mV"),
        ('unit = "mV", scale = "2 mV/N"', "over the sensitivity 2 mV/N"),
        ('unit = "mV", scale = "0.002 V/N"', "over the sensitivity 0.002 V/N"),
    ],
)
def test_a_scale_and_a_sensitivity(tmp_path, entry, told):
    lines = ["Time (s),Load cell,displacement (mm)", *rows(TIME, 2 * FORCE, MOTION)]
    toml = COLUMNS + f'force = {{ column = "Load cell", {entry} }}\n'
    test = read_test(write(tmp_path, lines, toml))
    expect(test)
    assert told in test.notes[0]


def test_the_sensitivity_of_an_accelerometer(tmp_path):
    # A force of 200 N decelerates 1 kg by 20.394 times standard gravity; 10 mV/g.
    millivolts = 10 * FORCE / 9.80665
    lines = ["Time (ms),Channel A,displacement (mm)", *rows(TIME, millivolts, MOTION)]
    entry = '[columns]\nacceleration = { column = "Channel A", scale = "10 mV/g"'
    toml = SPECIMEN + STRIKER + entry
    refused(write(tmp_path, lines, toml + " }\n"), 'unit = "mV", scale = "10 mV/g"')
    test = read_test(write(tmp_path, lines, toml + ', unit = "mV" }\n'))
    assert test.stress.max() == pytest.approx(2e6, rel=1e-4)


# --------------------------------------------------------------- compressed files and workbooks

PLAIN = ["time (s),force (N),displacement (mm)", *rows(TIME, FORCE, MOTION)]


def test_a_gzip_file(tmp_path, monkeypatch):
    path = write(tmp_path, PLAIN)
    packed = tmp_path / "test.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    test = read_test(packed)
    expect(test)
    assert test.name == "test"
    packed.write_bytes(packed.read_bytes()[:-20])
    refused(packed, "not a complete gzip file")
    monkeypatch.setattr("foamfit.data.tables.layouts._LARGEST", 1000)
    packed.write_bytes(gzip.compress(path.read_bytes()))
    refused(packed, "unpacks to more than")


def workbook(folder, sheets, toml=SPECIMEN):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, lines in sheets.items():
        sheet = book.create_sheet(name)
        for line in lines:
            sheet.append(line)
    book.save(folder / "test.xlsx")
    (folder / "test.toml").write_text(toml)
    return folder / "test.xlsx"


HEAD = [["Druckversuch\nan Schaum"], [], ["Prüfzeit", "Kraft\n[N]", "Weg"], ["s", None, "mm"]]
CELLS = [*HEAD, *([t, f, w] for t, f, w in zip(TIME, FORCE, MOTION, strict=True))]


def test_a_workbook(tmp_path):
    test = read_test(workbook(tmp_path, {"Ergebnisse": [["Probe", "Fmax"], [1, 200]], "1": CELLS}))
    expect(test)
    assert test.rows.rows == N
    texts = [[str(cell or "").replace(".", ",") for cell in row] for row in CELLS]
    expect(read_test(workbook(tmp_path, {"1": texts})))
    two = {"Probe 1": CELLS, "Probe 2": [*HEAD, *([a, b / 2, c] for a, b, c in CELLS[4:])]}
    refused(workbook(tmp_path, two), "2 sheets", "'Probe 2'", '[data] sheet = "Probe 1"')
    chosen = SPECIMEN + '[data]\nsheet = "Probe 2"\n'
    assert read_test(workbook(tmp_path, two, chosen)).stress.max() == pytest.approx(1e6, rel=1e-5)
    path = workbook(tmp_path, two, chosen.replace("e 2", "e 3"))
    refused(path, "no sheet 'Probe 3'", "'Probe 1'")
    path = write(tmp_path, PLAIN, chosen)
    refused(path, "not an Excel workbook", "leave [data] sheet out")
    (tmp_path / "test.xlsx").write_bytes(b"PK\x03\x04 no workbook")
    refused(tmp_path / "test.xlsx", "not a readable Excel workbook")


def test_a_workbook_without_the_extra(tmp_path, monkeypatch):
    path = workbook(tmp_path, {"1": CELLS})
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    assert 'pip install "foamfit[excel]"' in run_refused("check", path)


# ------------------------------------------------------------- ambiguous columns and units

STRAIN = MOTION / 10


def strained(folder, header, strain, stress=FORCE / 100, toml=SPECIMEN):
    lines = [f"time (s),{header}", *rows(TIME, stress, strain, form=".12f")]
    return write(folder, lines, toml)


@pytest.mark.parametrize(
    ("name", "strain", "measure"),
    [
        ("true strain", -np.log(1 - STRAIN), "logarithmic"),
        ("true strain", np.log(1 - STRAIN), "logarithmic"),
        ("Strain (true)", -np.log(1 - STRAIN), "logarithmic"),
        ("Strain [%] (logarithmic)", -100 * np.log(1 - STRAIN), "logarithmic"),
        ("Hencky strain (%)", -100 * np.log(1 - STRAIN), "logarithmic"),
        ("log. strain", -np.log(1 - STRAIN), "logarithmic"),
        ("wahre Dehnung", -np.log(1 - STRAIN), "logarithmic"),
        ("Green-Lagrange strain (%)", 50 * (1 - (1 - STRAIN) ** 2), "Green–Lagrange"),
    ],
)
def test_other_strains_are_converted_and_said(tmp_path, name, strain, measure):
    test = read_test(strained(tmp_path, f"stress (MPa),{name}", strain))
    expect(test)
    assert any(f"converted from the {measure} strain" in note for note in test.notes)


def test_strains_that_cannot_be_are_refused(tmp_path):
    path = strained(tmp_path, "stress (MPa),Green strain", 2 * STRAIN)
    refused(path, "Green–Lagrange strain reaches 0.8", "below 0.5")
    path = strained(tmp_path, "stress (MPa),Almansi strain", STRAIN)
    refused(path, "no column is a displacement or a strain", "'Almansi strain'")


@pytest.mark.parametrize(
    "name", ["true stress (MPa)", "Cauchy stress (MPa)", "Stress (true) (MPa)"]
)
def test_a_true_stress_is_refused_or_left_for_the_force(tmp_path, name):
    path = strained(tmp_path, f"{name},strain", STRAIN)
    refused(path, repr(name), "true (Cauchy) stress", "nominal (engineering) stress")
    lines = [f"time (s),{name},force (N),strain", *rows(TIME, FORCE / 60, FORCE, STRAIN)]
    test = read_test(write(tmp_path, lines))
    expect(test)
    assert repr(name) in test.notes[0].partition("not used")[2]


@pytest.mark.parametrize(
    "name", ["Transverse strain (%)", "Lateral strain", "Strain (radial)", "Strain 2 (transverse)"]
)
def test_a_transverse_strain_is_not_the_axial_one(tmp_path, name):
    path = strained(tmp_path, f"stress (MPa),{name}", STRAIN)
    refused(path, "no column is a displacement or a strain", repr(name))
    lines = [f"time (s),stress (MPa),{name},Extension (mm)"]
    path = write(tmp_path, [*lines, *rows(TIME, FORCE / 100, STRAIN / 2, MOTION)])
    expect(read_test(path))


def test_two_clocks_with_a_striker(tmp_path):
    head = "time (ms),force (N),camera time (ms),displacement (mm)"
    for other, same in ((TIME + 3.0, True), (1.02 * TIME, False), (TIME % 7, True)):
        path = write(tmp_path, [head, *rows(TIME, FORCE, other, MOTION)], SPECIMEN + STRIKER)
        if same:  # the clocks differ only in their origin, or one is not a time
            assert not any("times that differ" in note for note in read_test(path).notes)
            continue
        refused(path, "'time (ms)' and 'camera time (ms)'", "differ by 600 µs", "[motion]")
        slow = read_test(write(tmp_path, path.read_text().splitlines()))
        assert any("times that differ" in note for note in asked(slow))
        entry = '[columns]\ntime = { column = "time (ms)" }\n'
        read_test(write(tmp_path, path.read_text().splitlines(), SPECIMEN + STRIKER + entry))


@pytest.mark.parametrize(("sep", "decimal"), [(",", "."), (";", "."), (";", ",")])
def test_thousands_are_not_read_as_decimals(tmp_path, sep, decimal):
    force = [f"{f:,.0f}".replace(",", decimal) for f in 6 * FORCE]
    cells = zip((f"{t:.1f}".replace(".", decimal) for t in TIME), force, rows(MOTION), strict=True)
    body = [sep.join((t, f, w.replace(".", decimal))) for t, f, w in cells]
    path = write(tmp_path, [f"time (s){sep}force (N){sep}displacement (mm)", *body])
    refused(path, "'force (N)'", "separate thousands")
    full = [sep.join((t, f"1.{i:03d}{decimal}5", w)) for i, (t, _, w) in enumerate(
        row.split(sep) for row in body)]  # fmt: skip
    path = write(tmp_path, [f"time (s){sep}force (N){sep}displacement (mm)", *full])
    refused(path, "without separators, 1000,5" if decimal == "," else "must be a number")


def test_three_decimals_are_no_thousands(tmp_path):
    body = [f"{t:.6f},{f:.6f},{w:.3f}" for t, f, w in zip(TIME, FORCE, MOTION + 10, strict=True)]
    test = read_test(write(tmp_path, [PLAIN[0], *body]))
    assert test.displacement.max() == pytest.approx(4e-3, rel=1e-3)


@pytest.mark.parametrize(
    ("lines", "toml", "words"),
    [
        (PLAIN, ('"10 mm"', '"10 Mm"'), ["height is 1e+07 m", "peak strain is 4e-10"]),
        (PLAIN, ("mm^2", "Mm^2"), ["area is 1e+14 m²", "peak stress is 2e-12 Pa"]),
        (PLAIN, ("mm^2", "um^2"), ["peak stress is 2e+12 Pa", "modulus"]),
        ([PLAIN[0].replace("(N)", "(MN)"), *PLAIN[1:]], ("", ""), ["peak stress is 2e+12 Pa"]),
        ([PLAIN[0].replace("(mm)", "(nm)"), *PLAIN[1:]], ("", ""), ["peak strain is 4e-07"]),
        ([PLAIN[0].replace("(s)", "(ns)"), *PLAIN[1:]], ("", ""), ["duration is 3e-08 s"]),
    ],
)
def test_a_unit_that_is_far_off_is_questioned(tmp_path, lines, toml, words):
    told = asked(read_test(write(tmp_path, lines, SPECIMEN.replace(*toml))))
    for word in words:
        assert any(word in note for note in told), told


def test_a_record_that_runs_backwards(tmp_path):
    refused(write(tmp_path, [PLAIN[0], *PLAIN[:0:-1]]), "runs backwards", "order of its rows")
    header, *body = (line.partition(",")[2] for line in PLAIN)
    out = run("check", str(write(tmp_path, [header, *body[::-1]])))
    assert "the record runs backwards" in " ".join(out.stdout.split())
    test = read_test(write(tmp_path, [header, *body[: N // 2][::-1]]))
    assert any("starts under load" in note for note in asked(test))


def test_force_and_motion_swapped(tmp_path):
    out = run("check", str(write(tmp_path, [PLAIN[0], *rows(TIME, 50 * MOTION, FORCE / 50)])))
    assert "force and motion are swapped" in " ".join(out.stdout.split())


# ---------------------------------------------------------------------- warnings of check


@pytest.mark.parametrize(
    ("header", "factor", "told"),
    [
        ("strain (%)", 10.1, "they agree to 1 % of the range"),
        ("strain (%)", 12.0, "Check: the displacement is used, but the strain is 1.2 times"),
    ],
)
def test_strain_and_displacement_are_compared(tmp_path, header, factor, told):
    lines = [f"{PLAIN[0]},{header}", *rows(TIME, FORCE, MOTION, factor * MOTION)]
    test = read_test(write(tmp_path, lines))
    expect(test)
    assert any(told in note for note in test.notes)


def test_a_striker_without_a_time_is_warned_of(tmp_path):
    untimed = [line.partition(",")[2] for line in PLAIN]
    expect(test := read_test(write(tmp_path, untimed, SPECIMEN + STRIKER)), None)
    assert any("there is a [striker] but no time column" in n for n in asked(test))
    expect(test := read_test(write(tmp_path, ["Dauer" + PLAIN[0][4:], *PLAIN[1:]])), None)
    assert 'like time = { column = "Dauer (s)" }' in asked(test)[0]
