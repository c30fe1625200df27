"""Formats of test files that are read, and messages for files that cannot be used."""

import numpy as np
import pytest

from conftest import DATA, HEADER, SPECIMEN, needs_data, refused, specimen_toml, write_lines
from foamfit.data.csv_file import read_test

COLUMNS, WINDOW = SPECIMEN + "[columns]\n", SPECIMEN + "[window]\n"
SCALE = ' = { column = "stress (MPa)", scale = %s }\n'
LOOP = np.sin(np.linspace(0, np.pi, 41))  # loading from 0 to 1 and unloading to 0


def numbers(separator=",", decimal="."):
    """Return rows of time (ms), stress (up to 2 MPa) and displacement (up to 4 mm)."""
    time_ms = np.arange(41.0)
    table = zip(time_ms, 2 * LOOP, 4 * LOOP, strict=True)
    rows = [separator.join(f"{v:.9g}" for v in row) for row in table]
    return [row.replace(".", decimal) for row in rows]


def write(folder, header=HEADER, rows=None, toml=SPECIMEN):
    rows = numbers() if rows is None else rows
    return write_lines(folder, [header, *rows], toml)


def expect(test):
    """Check that the test contains the loop of `numbers`."""
    assert test.time[-1] == pytest.approx(0.04)
    assert test.stress.max() == pytest.approx(2e6)
    assert test.displacement.max() == pytest.approx(4e-3)
    assert test.motion == "measured"


# What is read.


@pytest.mark.parametrize(
    "header",
    [
        "time (ms),stress (MPa),displacement (mm)",
        "Time [ms],Stress[MPa],DISPLACEMENT (mm)",
        "time_ms,stress_MPa,displacement_mm",
        "time_ms_,stress_MPa_,displacement_mm_",
        "t (ms) , sigma (MPa) , disp (mm)",
        "TIME (MS),STRESS (MPA),DISPLACEMENT (MM)",
        "Time / ms,Nominal stress / N/mm^2,Top displacement / mm",
        "time ms,stress N/mm²,displacement mm",
        "#Time..ms.,Stress..MPa.,Displacement..mm.",
        "Time/ms,Stress/MPa,Displacement/mm",
        "t/ms,nominal stress/N/mm^2,Top displacement /mm",
        "t [ms],σ [MPa],disp [mm]",
        "time (ms),|stress| (MPa),displacement (mm)",
    ],
)
def test_units_stand_in_the_headers(tmp_path, header):
    expect(read_test(write(tmp_path, header)))


def test_a_unit_after_a_slash_counts_for_a_column_of_the_toml(tmp_path):
    toml = COLUMNS + 'time = { column = "Zeit/ms" }\nstress = { column = "Spannung/MPa" }\n'
    toml += 'displacement = { column = "Weg/mm" }\n'
    expect(read_test(write(tmp_path, "Zeit/ms,Spannung/MPa,Weg/mm", toml=toml)))


def test_the_toml_is_read_in_si(tmp_path):
    toml = (
        'name = "foam"\n[specimen]\nheight = "1.190 mm"\ndiameter = "5 mm"\nmass = "5.56 mg"\n'
        'heights = ["0.700 mm", "0.490 mm"]\n[striker]\nmass = "7 g"\nvelocity = "1.75 m/s"\n'
        '[noise]\nstress = "20 kPa"\ndisplacement = "2 um"\n'
    )
    rows = [f"{i},{2 * y},{0.4 * y}" for i, y in enumerate(LOOP)]
    test = read_test(write(tmp_path, rows=rows, toml=toml))
    assert test.name == "foam"
    assert test.specimen.area == pytest.approx(np.pi * 2.5e-3**2)
    assert test.specimen.heights == pytest.approx((7e-4, 4.9e-4))
    assert (test.specimen.mass, test.striker.mass) == pytest.approx((5.56e-6, 7e-3))
    assert (test.noise.stress, test.noise.displacement) == pytest.approx((2e4, 2e-6))
    assert len(test.data_sha256) == 64


# Masses inside that a camera tracked.

INSIDE = "time (ms),stress (MPa),displacement (mm),"
PLAIN = INSIDE + "displacement_1 (mm)"


def inside(*factors, offset=0.0):
    """Return rows of `numbers` with a mass inside for each factor, its peak displacement in mm."""
    return [
        ",".join([row, *(f"{factor * y + offset:.9g}" for factor in factors)])
        for row, y in zip(numbers(), LOOP, strict=True)
    ]


@pytest.mark.parametrize(
    ("header", "scale"),
    [
        ("displacement_1 (mm)", 1),
        ("Displacement 1 [mm]", 1),
        ("displacement_1_um", 1000),
        ("disp_1 (um)", 1000),
        ("camera displacement 01 / mm", 1),
        ("displacement_1 (mil)", 1 / 0.0254),  # a thousandth of an inch
    ],
)
def test_a_mass_inside_is_read(tmp_path, header, scale):
    test = read_test(write(tmp_path, INSIDE + header, inside(1.5 * scale)))
    expect(test)  # the new column is not taken for the top
    assert list(test.interior) == [1]
    np.testing.assert_allclose(test.interior[1], 1.5e-3 * LOOP, atol=1e-11)
    assert f"displacement_1 from {header!r}" in test.notes[0]


# Files that are rejected, with one sentence that names the error.


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ["empty"]),
        (b" \n\n", ["empty"]),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", ["binary"]),
        (HEADER.encode() + b"\n", ["row 1", "no rows of numbers"]),
        (b"1,2,3\n" * 20, ["names the columns"]),
        (b"hello\nworld\n", ["names the columns"]),
    ],
)
def test_refuses_what_is_no_table(tmp_path, content, words):
    path = write(tmp_path)
    path.write_bytes(content)
    refused(path, "test.csv", *words)


@pytest.mark.parametrize("other", ["Force/A", "Load/Height", "stress/strain", "time/force", "1/t"])
def test_a_quotient_of_two_quantities_is_no_channel(tmp_path, other):
    rows = [f"{row},{i}" for i, row in enumerate(numbers())]
    test = read_test(write(tmp_path, f"Time/ms,Stress/MPa,Displacement/mm,{other}", rows))
    expect(test)
    assert any(f"not used: '{other}'" in note for note in test.notes)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("time (ms),stress (xyz),displacement (mm)", ["unknown unit 'xyz'", "stress (MPa)"]),
        ("time (ms),force (mm),displacement (mm)", ["force (mm)", "wrong dimension"]),
        ("time (ms),stress (kPa) (MPa),displacement (mm)", ["unknown unit 'kPa or MPa'"]),
        ("time (ms),stress (kPa),displacement (mm)\nms,MPa,mm", ["unknown unit 'kPa or MPa'"]),
        ("time (ms),stress (9^9^9),displacement (mm)", ["unknown unit '9^9^9'"]),
        ("time (ms),stress (MPa),displacement (px)", ["unit 'px' has the wrong dimension"]),
        ("time (?s),stress (MPa),displacement (mm)", ["unknown unit '?s'"]),
        ("time (ms),force x10 (N),displacement (mm)", ["no column is a stress or a force"]),
        ("time (ms),stress (MPa),displacement setpoint (mm)", ["no column is a displacement"]),
        ("time,stress (MPa),displacement (mm)", ["'time' has no unit", "time (ms)", "[columns]"]),
        ("time (ms),stress,displacement (mm)", ["'stress' has no unit"]),
        ("time (ms),torque (mm),displacement (mm)", ["no column is a stress or a force"]),
        ("time (ms),stress (MPa),torque (N m)", ["no column is a displacement", "[striker]"]),
        ("time (ms),stress (MPa),stress (MPa)", ["'stress (MPa)' (number 2) and"]),
        ("time (ms),left force (N),right force (N)", ["left force (N)", "right force (N)"]),
    ],
)
def test_refuses_headers(tmp_path, header, words):
    refused(write(tmp_path, header), "test.csv", *words)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("7,abc,1", ["row 9", "'stress (MPa)'", "'abc'", "number"]),
        ("7,,1", ["row 9", "'stress (MPa)'", "empty"]),
        ("7,1", ["row 9", "'displacement (mm)'", "empty"]),
        ("7,1,NaN", ["row 9", "'displacement (mm)'", "finite"]),
        ("7,inf,1", ["row 9", "'stress (MPa)'", "finite"]),
        ("7,1,1,1", ["row 9", "4 cells", "3"]),
        ("7;1;1", ["row 9", "one cell"]),
        ("5,1,1", ["row 9", "'time (ms)'", "goes back"]),
        ("6,1,1", ["row 9", "'time (ms)'", "repeats", 'duplicates = "average"']),
        ("7,1_000,1", ["row 9", "'1_000'", "without separators, 1000"]),
        ("7,12 345.5,1", ["row 9", "without separators, 12345.5"]),
    ],
)
def test_refuses_rows_by_their_number(tmp_path, row, words):
    rows = numbers()
    rows[7] = row
    toml = SPECIMEN + '[data]\nduplicates = "refuse"\n'
    refused(write(tmp_path, rows=rows, toml=toml), "test.csv", *words)


@pytest.mark.parametrize(
    ("form", "last", "cut"),
    [
        (".6f", "41,0.01,0.", True),
        (".6f", "41,0.01,0.0123", True),
        (".6f", "41,0.01", True),
        (".3e", "41,0.01,1.234e-0", True),
        (".6f", "41,0.01,0.012345", False),
        (".9g", "41,0.01,0.", True),
        (".9g", "41,0.01,0.01", False),
    ],
)
def test_a_last_row_that_is_cut_is_left_out_and_named(tmp_path, form, last, cut):
    """If writing was interrupted, the last number may be cut, for example 6. instead of 6.428."""
    table = zip(np.arange(41.0), 2 * LOOP, 4 * LOOP, strict=True)
    rows = [",".join(f"{value:{form}}" for value in row) for row in table]
    path = write(tmp_path, rows=[*rows, last])
    path.write_text(path.read_text().removesuffix("\n"))
    test = read_test(path)
    told = f"row 43: the file ends within it, at {last.split(',')[-1]!r}"
    assert (told in map(str, test.rows.dropped)) == cut
    assert test.rows.rows == 42
    path.write_text(path.read_text() + "\n")
    if last.count(",") == 2:
        assert "ends within" not in str(read_test(path).rows)


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ((2, 40), ["strain reaches 4", "height"]),
        ((0, 4), ["'stress (MPa)' is constant; a stress must vary"]),
        ((2, 0), ["'displacement (mm)' is constant"]),
        ((1e290, 4), ["'stress (MPa)' is up to 1e+290", "unit", "scale"]),
    ],
)
def test_refuses_values_that_cannot_be(tmp_path, factors, words):
    rows = [f"{i},{factors[0] * y},{factors[1] * y}" for i, y in enumerate(LOOP)]
    refused(write(tmp_path, rows=rows), "test.csv", *words)


@pytest.mark.parametrize(
    ("header", "factors", "words"),
    [
        (INSIDE + "displacement_1", [1], ["'displacement_1' has no unit", "displacement_1 (mm)"]),
        (INSIDE + "displacement_1 (MPa)", [1], ["as displacement_1", "wrong dimension"]),
        (PLAIN, [0], ["'displacement_1 (mm)' is constant", "a displacement_1 must vary"]),
        (PLAIN, [20], ["displacement_1 reaches 20 mm", "height 10 mm", "unit"]),
        (PLAIN + ",disp 1 (mm)", [1, 2], []),
        (PLAIN + ",displacement_01 (mm)", [1, 2], ["could both be the displacement_1"]),
    ],
)
def test_refuses_masses_inside(tmp_path, header, factors, words):
    path = write(tmp_path, header, inside(*factors))
    if words:
        refused(path, "test.csv", *words)
    else:  # of two columns, the one with the better name is used
        assert read_test(path).interior[1].max() == pytest.approx(1e-3)


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ('[specimen]\narea = "1 mm^2"\n', ["[specimen] height is missing"]),
        ('[specimen]\nheight = "1 mm"\n', ["diameter", "area"]),
        ('[specimen]\nheight = "-1 mm"\narea = "1 mm^2"\n', ["height", "positive"]),
        (SPECIMEN.replace("100 mm", "1e300 mm"), ["area", "1e-30 and 1e+30"]),
        (COLUMNS + "stress" + SCALE % "1e300", ["stress: scale", "1e-30 and 1e+30"]),
        ('[specimen]\nheight = 1.19\narea = "1 mm^2"\n', ["height = 1.19", '"1.19 mm"']),
        ('[specimen]\nheight = "1.19"\narea = "1 mm^2"\n', ["height", "wrong dimension"]),
        ('[specimen]\nheight = "tall"\narea = "1 mm^2"\n', ["height", "not a quantity"]),
        ('[specimen]\nheight = "1 kg"\narea = "1 mm^2"\n', ["height", "wrong dimension"]),
        ('[specimen]\nheight = "1 mmm"\narea = "1 mm^2"\n', ["height", "unknown unit"]),
        ('[specimen]\nheight = "1 mm"\narea = "1 mm^2"\ndiameter = "5 mm"\n', ["disagree"]),
        ("[specimen]\nheight = \n", ["line 2"]),
        (SPECIMEN + 'hight = "1 mm"\n', ["no key 'hight'", "height"]),
        ("[specimn]\n", ["no key 'specimn'", "specimen"]),
        ("specimen = 3\n", ["[specimen]"]),
        ('tests = ["a.csv"]\nmodel = "bistable"\n', ["is a study of several tests", "rename"]),
        ("name = 3\n" + SPECIMEN, ["name = 3"]),
        (SPECIMEN + 'heights = ["1 mm", "2 mm"]\n', ["heights must add up"]),
        (SPECIMEN + '[striker]\nmass = "7 mm"\n', ["[striker] mass", "7 g"]),
        (SPECIMEN + '[noise]\nstress = "-1 Pa"\n', ["[noise] stress", "positive"]),
        (WINDOW + "cycle = 0\n", ["[window] cycle", "from 1"]),
        (WINDOW + "cycle = 2\n", ["cycle 2 cannot be taken: the file has only cycle 1"]),
        (WINDOW + 'start = "1 s"\n', ["[window]", "0 samples"]),
        (COLUMNS + 'force = "Load"\n', ["[columns] force"]),
        (COLUMNS + 'forc = { column = "F" }\n', ["no key 'forc'", "force"]),
        (COLUMNS + 'force = { column = "F" }\n', ["'F' is nowhere", "'time (ms)'"]),
        (COLUMNS + 'force = { column = "F", units = "N" }\n', ["no key 'units'", "unit"]),
        (COLUMNS + 'force = { column = "F", unit = "Q!" }\n', ["'Q!' must be a known unit"]),
        (COLUMNS + 'force = { column = "F", scale = "0" }\n', ["scale = '0'"]),
        (COLUMNS + "force" + SCALE % '"2 N/V"', ["cannot be read as force"]),
    ],
)
def test_refuses_tomls(tmp_path, toml, words):
    refused(write(tmp_path, toml=toml), *words)


# Measured data.


@needs_data
def test_shoe_foam_as_the_instrument_wrote_it(tmp_path):
    more = '[columns]\ndisplacement = { column = "Gap (um)", unit = "um", scale = "-1" }\n'
    raw = DATA / "shoe-foam" / "turbo-comp-1_raw.txt"
    test = read_test(raw, specimen_toml(tmp_path, 10.53, 7.63, more))
    toml = specimen_toml(tmp_path, 10.53, 7.63)
    derived = read_test(raw.with_name("turbo-comp-1_cycle1.csv"), toml)
    assert test.stress.max() == pytest.approx(derived.stress.max(), rel=2e-3)
    assert test.displacement.max() == pytest.approx(derived.displacement.max(), rel=2e-3)
    assert test.time[-1] == pytest.approx(derived.time[-1], abs=0.02)
    assert any("Cycle 1 of 7" in note for note in test.notes)
    plain = read_test(raw, toml)
    assert plain.turned == ("displacement",)
    np.testing.assert_array_equal(plain.displacement, test.displacement)


VOLTS = (
    '[striker]\nmass = "358.39 g"\nvelocity = "0.785 m/s"\n'
    '[columns]\ntime = { column = "X_Value", unit = "s" }\n'
    'force = { column = "Load", unit = "V", scale = "4444.4 N/V" }\n'
)
ACCELERATION = 'acceleration = { column = "Acceleration", unit = "V", scale = "9586.5 m/s^2/V" }\n'


@needs_data
@pytest.mark.parametrize(
    ("more", "motion", "strain"),
    [
        ("", "integrated from force", 0.90),
        (ACCELERATION, "integrated from acceleration", 0.79),
    ],
)
def test_cartilage_as_labview_wrote_it(tmp_path, more, motion, strain):
    raw = DATA / "cartilage-impact" / "test_1_raw.txt"
    test = read_test(raw, specimen_toml(tmp_path, 0.563, 8.5, VOLTS + more))
    assert test.motion == motion
    assert test.displacement.max() / test.specimen.height == pytest.approx(strain, abs=0.05)
    assert test.time[-1] == pytest.approx(1.45e-3, abs=0.15e-3)  # the second bounce is cut
    assert any("announces 100000 samples" in note for note in test.notes)


@needs_data
def test_syntactic_foam_has_no_time_and_no_unloading(tmp_path):
    toml = specimen_toml(tmp_path, 20, 10)
    test = read_test(DATA / "syntactic-foam" / "specimen_3-1.csv", toml)
    assert test.time is None
    assert len(test.stress) == 1186
    assert test.stress.max() == pytest.approx(144.348e6)
    assert any("no unloading" in note for note in test.notes)


def test_a_stray_quote_in_the_header_is_refused(tmp_path):
    """Blanks were replaced by tabs again and again."""
    header = '"time (ms)\tstress (MPa)\tdisplacement (mm)'
    refused(write(tmp_path, header, numbers("\t")), "no row names the columns")


@pytest.mark.parametrize("largest", ["1.7e308", "-1.7e308"])
def test_a_number_beyond_every_unit_is_refused(tmp_path, largest):
    rows = numbers()
    rows[20] = f"20,{largest},4"
    rows[21] = f"21,{largest.removeprefix('-')},4"
    refused(write(tmp_path, rows=rows), "'stress (MPa)' is up to 1.7e+308", "cannot be a stress")


@pytest.mark.parametrize("header", ["Strain%", "ε [%]", "ε/%"])
def test_a_strain_in_per_cent_may_be_a_letter_or_have_no_blank(tmp_path, header):
    test = read_test(write(tmp_path, f"time (ms),stress (MPa),{header}"))
    assert test.displacement.max() / test.specimen.height == pytest.approx(0.04)
