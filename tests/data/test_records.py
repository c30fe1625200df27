"""Kinds of records that are read, and the fate of each of their rows."""

import itertools
import time

import numpy as np
import pytest

import fabricated
from conftest import HEADER, SPECIMEN, STRIKER, refused, run, write_lines as write
from foamfit.data.calibration import contradictions
from foamfit.data.csv_file import read_test
from foamfit.data.energy import audit
from foamfit.errors import InputError
from foamfit.fitting.curves import check_drive
from foamfit.report.summary import describe, render_report, summary_text


def table(*columns, header=HEADER):
    rows = zip(*columns, strict=True)
    return [header, *(",".join(f"{value:.9g}" for value in row) for row in rows)]


def loop(n=101, top=4.0):
    """Return time (ms), stress (MPa) and displacement (mm) of one loading and unloading."""
    shape = np.sin(np.linspace(0.0, np.pi, n))
    return np.arange(float(n)), 0.5 * top * shape, top * shape


def accounted(test):
    """Check that every row is used or counted with its reason, and return the counts."""
    count = test.rows
    assert count.rows == count.used + sum(item.rows for item in count.dropped)
    for item in count.dropped:
        assert item.rows <= item.last - item.first + 1
        assert item.why
    return count


# ---------------------------------------------------------------------------------- every row


@pytest.mark.parametrize("at", [60, 800])  # inside and outside of the header search
def test_a_repeated_header_is_refused_with_both_rows(tmp_path, at):
    lines = table(*loop(1284))
    lines.insert(at, HEADER.replace(",", ", "))
    refused(write(tmp_path, lines), f"row {at + 1} repeats the header of row 1")


def test_two_tables_in_a_file_are_refused(tmp_path):
    lines = [*table(*loop()[:2], header="time (ms),stress (MPa)"), *table(*loop())]
    refused(write(tmp_path, lines), "rows 2 to 102 contain numbers above the header in row 103")


def test_duplicate_time_stamps_are_averaged_and_counted(tmp_path):
    clock, stress, displacement = loop()
    for values in (clock, stress, displacement):
        values[[31, 41, 42]] = values[[30, 40, 40]]
    stress[[41, 42]] += 0.001, 0.002
    lines = table(clock, stress, displacement)
    test = read_test(write(tmp_path, lines))
    count = accounted(test)
    assert (count.rows, count.used) == (101, 98)
    (item,) = count.dropped
    assert (item.rows, item.first, item.last) == (3, 33, 44)
    assert "time stamp of the row before" in item.why
    assert test.time.size == 98
    assert test.stress[40 - 1] == pytest.approx(1e6 * stress[40:43].mean())
    refused(
        write(tmp_path, lines, SPECIMEN + '[data]\nduplicates = "refuse"\n'), "row 33", "repeats"
    )
    refused(write(tmp_path, lines, SPECIMEN + "[data]\nduplicates = 3\n"), "average, refuse")


def triangles(tops, n=80, low=0.02):
    """Return displacement (mm) of triangles with the given peaks, with rests at both ends."""
    corners = [0.0, *(level for top in tops for level in (top, low * max(tops)))]
    parts = [np.linspace(a, b, n, endpoint=False) for a, b in itertools.pairwise(corners)]
    return np.concatenate([*parts, [corners[-1]]])


def record(kind):
    """Return the lines of a record with rows that must be dropped for a reason given by `kind`."""
    rng = np.random.default_rng(0)
    clock, stress, displacement = loop(601)
    if kind in ("impact", "window"):
        stress = np.concatenate([np.zeros(200), stress, np.zeros(300)])
        displacement = np.concatenate([np.zeros(200), displacement, np.zeros(300)])
        stress += 0.002 * rng.standard_normal(stress.size)
    elif kind == "cycles":
        displacement = triangles([4.0, 4.0, 4.0])
        stress = 0.5 * displacement
    elif kind == "spikes":
        stress += 0.002 * rng.standard_normal(stress.size)
        stress[[150, 400]] += 1.0
        displacement[400] = 0.0
    clock = np.arange(float(stress.size))
    return table(clock, stress, displacement)


@pytest.mark.parametrize(
    ("kind", "toml", "why"),
    [
        ("impact", STRIKER, {"before contact starts", "after contact ends"}),
        ("window", '[window]\nend = "0.9 s"\n', {"outside [window] start and end"}),
        ("cycles", "[window]\ncycle = 2\n", {"before cycle 2", "after cycle 2"}),
        ("spikes", "", {"a spike or gap of the stress, bridged by a straight line"}),
    ],
)
def test_every_row_that_is_not_used_has_its_reason(tmp_path, kind, toml, why):
    lines = record(kind)
    test = read_test(write(tmp_path, lines, SPECIMEN + toml))
    count = accounted(test)
    assert count.rows == len(lines) - 1
    assert why <= {item.why for item in count.dropped}
    left_out = np.any([found.left_out for found in test.outliers.values()], axis=0)
    assert count.used == test.stress.size - np.count_nonzero(left_out)
    told = describe(test, audit(test))
    assert f"{count.rows} in the file, {count.used} used" in told
    assert all(f"Not used: {str(item)[:20]}" in told for item in count.dropped)


def test_the_rows_stand_in_the_terminal_and_in_the_result(tmp_path):
    clock, stress, displacement = loop()
    for values in (clock, stress, displacement):
        values[7] = values[6]
    path = write(tmp_path, table(clock, stress, displacement))
    assert "101 in the file, 100 used." in run("check", str(path)).stdout
    result = fabricated.result(measurement=read_test(path))
    told = summary_text(result)
    assert "rows: 101 read, 100 used; not used: 1 (the time stamp of the row before" in told
    assert "warning: 1 of 101 rows" in told
    assert "rows: Not used: row 9: the time" in summary_text(result, verbose=True)
    data = result.to_json_dict()["data"]
    assert (data["rows"], data["used"]) == (101, 100)
    (item,) = data["dropped"]
    assert item == {"rows": 1, "first": 9, "last": 9, "why": item["why"]}
    assert "101 in the file" in render_report(result, fabricated.no_figures())


# ------------------------------------------------------------------------ what a record can be


def cycles(path):
    return next((note for note in path.notes if note.startswith("Cycle")), "")


@pytest.mark.parametrize(
    ("tops", "cycle", "count"),
    [([0.8, 1.6, 2.4, 4.0], 1, 4), ([0.8, 1.6, 2.4, 4.0], 4, 4), ([4.0, 0.8, 4.0], 2, 3)],
)
def test_cycles_of_any_amplitude_are_counted(tmp_path, tops, cycle, count):
    displacement = triangles(tops)
    lines = table(np.arange(float(displacement.size)), displacement**1.5 / 4, displacement)
    test = read_test(write(tmp_path, lines, SPECIMEN + f"[window]\ncycle = {cycle}\n"))
    accounted(test)
    assert f"Cycle {cycle} of {count} is used" in cycles(test)
    reached = test.displacement.max() + 10e-3 * test.start_strain
    assert reached == pytest.approx(1e-3 * tops[cycle - 1], rel=0.03)
    small = [note for note in test.notes if "of the largest displacement" in note]
    assert len(small) == (tops[cycle - 1] < 4.0)
    assert all("[window] cycle = " in note for note in small)
    assert not any("reverses" in note for note in test.notes)


def test_a_column_may_number_the_cycles(tmp_path):
    displacement = triangles([4.0, 4.0, 4.0])
    number = np.repeat([1, 10, 100], 160)  # a machine recorded only these three cycles
    number = np.append(number, 100)
    clock = np.arange(float(displacement.size))
    header = HEADER + ",Total Cycles"
    lines = table(clock, 0.5 * displacement, displacement, number, header=header)
    path = write(tmp_path, lines, SPECIMEN + '[columns]\ncycle = { column = "Total Cycles" }\n')
    test = read_test(path, cycle=10)
    assert (test.cycle, test.cycles) == (10, (1, 10, 100))
    assert "Cycle 10 (number 2 in the file) of 3 is used" in cycles(test)
    assert "before cycle 10" in {item.why for item in accounted(test).dropped}
    assert read_test(path).cycle == 1
    with pytest.raises(InputError, match=r"cycle 2 cannot be taken: .* 3 of the cycles 1 to 100"):
        read_test(path, cycle=2)


@pytest.mark.parametrize(
    ("corners", "reversals", "count"),
    [
        ([0, 2.0, 1.2, 4.0, 0], 1, 1),  # partial unloading during loading
        ([0, 4.0, 2.0, 3.0, 0], 1, 1),  # partial reloading during unloading
        ([0, 2.0, 1.0, 3.0, 2.0, 4.0, 2.0, 3.0, 0], 3, 1),
        ([0, 4.0, 0.1, 3.0, 2.0, 4.0, 0], 0, 2),  # only in the unused cycle
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_record_that_reverses_below_its_peak_is_told(tmp_path, corners, reversals, count, noise):
    parts = [np.linspace(a, b, 80, endpoint=False) for a, b in itertools.pairwise(corners)]
    displacement = np.concatenate([*parts, [corners[-1]]])
    displacement += noise * np.random.default_rng(0).standard_normal(displacement.size)
    lines = table(np.arange(float(displacement.size)), 0.5 * displacement, displacement)
    test = read_test(write(tmp_path, lines))
    accounted(test)
    assert (f"of {count} is used" in cycles(test)) == (count > 1)
    told = [note for note in test.notes if "reverses" in note]
    assert len(told) == (reversals > 0)
    if told:
        assert ("once" if reversals == 1 else f"{reversals} times") in told[0]
        assert "no inner loops" in told[0]
        assert "no inner loops" in " ".join(
            summary_text(fabricated.result(measurement=test)).split()
        )


def test_a_movement_without_a_force_is_no_cycle(tmp_path):
    displacement = triangles([1.0, 3.0, 3.0])
    stress = 0.5 * displacement
    stress[: displacement.size // 3] = 0.0
    lines = table(np.arange(float(displacement.size)), stress, displacement)
    assert "Cycle 1 of 2" in cycles(read_test(write(tmp_path, lines)))


def clipped_impact(share, n=600, noise=0.0, digits=9):
    """Return a half-sine impact of 1 kg at 1 m/s with the force clipped at `share` of its peak."""
    clock = np.linspace(0.0, 10.0, n)
    stress = 3.0 * np.sin(np.pi * clock / 10.0)
    stress += noise * np.random.default_rng(0).standard_normal(n)
    displacement = 3.2 * np.sin(np.pi * clock / 10.0)
    stress = np.round(np.minimum(stress, 3.0 * share), digits)
    return table(clock, stress, displacement)


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("n", [600, 6000])
def test_a_clipped_force_is_named_and_not_fitted(tmp_path, n, noise):
    lines = clipped_impact(0.8, n, noise)
    test = read_test(write(tmp_path, lines, SPECIMEN + STRIKER))
    (note,) = [note for note in test.notes if "clipped" in note]
    top = sum(line.split(",")[1] == "2.4" for line in lines)
    assert f"{top} samples" in note
    assert "2.4 MPa" in note
    found = test.outliers["stress"]
    assert found.clipped_at == pytest.approx(2.4e6, rel=1e-3)
    assert found.at.size == 0
    count = accounted(test)
    (item,) = [item for item in count.dropped if "clipped" in item.why]
    assert item.rows == top
    assert test.stress[~found.left_out].max() < 2.4e6 * (1 + 1e-9)
    assert contradictions(test) == ()
    with pytest.raises(InputError, match="clipped, so it cannot drive"):
        check_drive(test, "stress")


@pytest.mark.parametrize("digits", [1, 2, 3, 9])
def test_a_rounded_top_is_not_clipped(tmp_path, digits):
    test = read_test(write(tmp_path, clipped_impact(1.1, digits=digits), SPECIMEN + STRIKER))
    assert not any("clipped" in note for note in test.notes)


def test_a_motion_is_not_integrated_from_a_clipped_force(tmp_path):
    lines = [line.rsplit(",", 1)[0] for line in clipped_impact(0.8)]
    path = write(tmp_path, lines, SPECIMEN + STRIKER)
    refused(path, "the force is clipped, so the motion cannot be integrated from it")


# ------------------------------------------------------------------------- names and units


COLUMNS = SPECIMEN + "[columns]\n"


@pytest.mark.parametrize("name", ["Gap (mm)", "Position (mm)", "gap_mm", "Gap/mm"])
def test_a_gap_counts_down_by_one_setting(tmp_path, name):
    clock, stress, displacement = loop()
    lines = table(clock, stress, 10.0 - displacement, header=f"time (ms),stress (MPa),{name}")
    entry = f'displacement = {{ column = "{name}", counts_down = true }}'
    plain = read_test(write(tmp_path, lines))
    assert plain.turned == ("displacement",)
    assert any("counts down in compression; its sign is reversed" in n for n in plain.notes)
    test = read_test(write(tmp_path, lines, COLUMNS + entry + "\n"))
    assert test.turned == ()
    assert "counting down" in test.notes[0]
    for each in (plain, test):
        np.testing.assert_allclose(each.displacement, 1e-3 * displacement, atol=1e-6)
    lines = table(clock, stress, displacement, header=f"time (ms),stress (MPa),{name}")
    refused(write(tmp_path, lines, COLUMNS + entry + "\n"), "leave counts_down = true out")


def test_counts_down_is_for_motions(tmp_path):
    lines = table(*loop())
    toml = COLUMNS + 'stress = { column = "stress (MPa)", counts_down = true }\n'
    refused(write(tmp_path, lines, toml), "no key 'counts_down'")
    toml = COLUMNS + 'displacement = { column = "displacement (mm)", counts_down = 1 }\n'
    refused(write(tmp_path, lines, toml), "counts_down = 1 must be true or false")


@pytest.mark.parametrize("name", ["Extension (mm)", "Compressive extension [mm]", "Travel_mm"])
def test_a_displacement_has_other_names(tmp_path, name):
    lines = table(*loop(), header=f"time (ms),stress (MPa),{name}")
    assert read_test(write(tmp_path, lines)).displacement.max() == pytest.approx(4e-3)
    better = table(
        *loop(), loop()[2] / 2, header=f"time (ms),stress (MPa),{name},displacement (mm)"
    )
    assert read_test(write(tmp_path, better)).displacement.max() == pytest.approx(2e-3)
    strained = table(*loop(), loop()[2] * 5, header=f"time (ms),stress (MPa),{name},strain (%)")
    assert read_test(write(tmp_path, strained)).displacement.max() == pytest.approx(2e-3)


def test_of_two_times_the_one_that_goes_on_is_read(tmp_path):
    clock, stress, displacement = loop()
    header = "total time (ms),cycle time (ms),stress (MPa),displacement (mm)"
    lines = table(clock, clock % 50, stress, displacement, header=header)
    test = read_test(write(tmp_path, lines))
    assert test.time[-1] == pytest.approx(0.1)
    assert "time from 'total time (ms)'" in test.notes[0]
    lines = table(clock, 2 * clock, stress, displacement, header=header)
    entry = 'time = { column = "total time (ms)" }'
    refused(write(tmp_path, lines), entry)
    assert read_test(write(tmp_path, lines, COLUMNS + entry)).time[-1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("header", "newton"),
    [
        ("Time/ms,Force/lb,displacement (mm)", 4.4482216),
        ("t / ms,Load (lbs),displacement (mm)", 4.4482216),
        ("Time [msec],Load [lbf],displacement (mm)", 4.4482216),
        ("time (ms),Force (kg),displacement (mm)", 9.80665),
        ("time_ms,Force(Linear:Load) (kN),displacement (mm)", 1000.0),
    ],
)
def test_force_and_time_have_other_units(tmp_path, header, newton):
    clock, stress, displacement = loop()
    lines = table(clock, 200 * stress / newton, displacement, header=header)
    test = read_test(write(tmp_path, lines))
    assert test.time[-1] == pytest.approx(0.1)
    assert test.stress.max() == pytest.approx(200 * stress.max() / 1e-4, rel=1e-6)


def test_decimal_commas_in_quotation_marks(tmp_path):
    header, *rows = table(*loop())
    quoted = [",".join(f'"{cell.replace(".", ",")}"' for cell in row.split(",")) for row in rows]
    test = read_test(write(tmp_path, [header, *quoted]))
    np.testing.assert_allclose(test.displacement, 1e-3 * loop()[2], atol=1e-9)
    rows = [f'{i},"1,{i:03d}",{i / 100}' for i in range(100)]
    refused(
        write(tmp_path, [header, *rows]),
        "'1,000' may have a decimal comma or a thousands separator",
    )
    quoted[40] = quoted[40].replace(",", ".").replace('"."', '","')
    refused(write(tmp_path, [header, *quoted]), "row 42", "the same decimal sign")


@pytest.mark.parametrize("columns", [2, 3])
def test_the_force_is_mass_times_acceleration_where_it_is_missing(tmp_path, columns):
    clock, stress, displacement = loop()
    lines = table(clock, stress * 1e2, displacement, header="time (ms),accel (m/s^2),disp (mm)")
    lines = [",".join(line.split(",")[:columns]) for line in lines]
    striker = '[striker]\nmass = "2 kg"\nvelocity = "6.5 m/s"\n'
    toml = SPECIMEN.replace("10 mm", "1 m") + striker
    test = read_test(write(tmp_path, lines, toml))
    assert test.stress.max() == pytest.approx(2.0 * 1e2 * stress.max() / 1e-4)
    assert any("striker's mass times its acceleration" in note for note in test.notes)
    assert test.motion == ("measured" if columns == 3 else "integrated from force")
    refused(write(tmp_path, lines), "no column is a stress or a force", "[striker] mass")
    turned = [lines[0], *(f"{t:g},{-a:g},{d:g}" for t, a, d in zip(*loop(), strict=True))]
    turned = [",".join(line.split(",")[:columns]) for line in turned]
    other = read_test(write(tmp_path, turned, toml))
    assert other.turned == ("acceleration",)
    np.testing.assert_allclose(1e2 * other.stress, test.stress, rtol=1e-5, atol=10.0)


# ------------------------------------------------------------------------------ one sentence

STRESS = '[columns]\nstress = { column = "stress (MPa)", '


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        (
            STRESS + "scale = -1 }\n",
            ["stress is negative", "leave the minus sign of scale = -1 out"],
        ),
        (STRESS + 'unit = "kPa" }\n', ["has the unit 'MPa' in its header", "says 'kPa'"]),
        (
            STRESS + 'unit = "V", scale = "2 MPa/V" }\n',
            ["has the unit 'MPa' in its header", "says 'V'"],
        ),
        ('[noise]\nstress = "400 MPa"\n', ["[noise] stress = 400 MPa is 20000 %", "2 MPa"]),
        ('[noise]\ndisplacement = "1 m"\n', ["[noise] displacement = 1 m is 25000 %"]),
    ],
)
def test_what_contradicts_the_file_is_refused(tmp_path, toml, words):
    refused(write(tmp_path, table(*loop()), SPECIMEN + toml), *words)


def refused_quickly(path):
    """Return a short message that costs little time: patterns must not search for minutes."""
    begin = time.process_time()
    with pytest.raises(InputError) as caught:
        read_test(path)
    assert time.process_time() - begin < 2.0
    assert len(str(caught.value)) < 600
    return str(caught.value)


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ("a = " + 5000 * "[" + 5000 * "]", ["nested too deeply"]),
        ("a = " + 5000 * "{ a = " + "1" + 5000 * "}", ["nested too deeply"]),
        ('name = "' + 10_000_000 * "a" + '"', ["has 10", "characters"]),
        (10_000_000 * "a" + " = 1", ["has 10", "characters"]),
        ('name = "' + 500_000 * "a" + '"\n' + SPECIMEN, ["name = ", "200 characters at most"]),
        (500_000 * "a" + " = 1\n" + SPECIMEN, ["no key"]),
        ('name = "a\\u001b[31mb"\n' + SPECIMEN, ["name", "printable"]),
        ('[specimen]\nheight = "1_000 mm"\narea = "1 mm^2"\n', ["height", "without separators"]),
        ('[specimen]\nheight = "1,19 mm"\narea = "1 mm^2"\n', ["height", "decimal point"]),
    ],
)
def test_a_toml_that_no_one_would_write_is_refused_quickly(tmp_path, toml, words):
    path = write(tmp_path, table(*loop()), toml)
    message = refused_quickly(path)
    assert all(word in message for word in words)


@pytest.mark.parametrize(
    "name", [10_000_000 * "a", 1_000_000 * "a ", 1_000_000 * "(", 100_000 * "a ", 100_000 * "(a"]
)
def test_a_column_name_of_megabytes_is_refused_quickly(tmp_path, name):
    header, *rows = table(*loop(), loop()[0])
    assert "row 1" in refused_quickly(write(tmp_path, [f"{header},{name}", *rows]))
