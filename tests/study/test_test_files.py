"""Naming of tests given as files, folders and globs."""

import pytest

from foamfit.errors import InputError
from foamfit.study.study_file import find_tests


@pytest.fixture
def here(here):
    """Tests of two days, other files in their folders, and a result."""
    files = (
        "monday/a.csv monday/a.toml monday/b.txt monday/specimens.csv monday/picture.png "
        "monday/.hidden.csv tuesday/a.csv tuesday/c.dat tuesday/fits/fit.json "
        "tuesday/fits/curves.csv empty/notes.md"
    )
    for name in files.split():
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_text("x")
    return here


def names(*patterns, **options):
    return [name for name, _ in find_tests(patterns, **options)]


def test_a_folder_gives_its_tables_but_no_list_of_specimens_and_no_result(here):
    found = [(name, path.as_posix()) for name, path in find_tests("monday")]
    assert found == [("a", "monday/a.csv"), ("b", "monday/b.txt")]
    with pytest.raises(InputError, match="tuesday/fits: the folder has no test"):
        find_tests("tuesday/fits")
    for mark, table in (("fit.json", "residuals.csv"), ("prediction.json", "prediction.csv")):
        (here / mark).mkdir()
        (here / mark / table).write_text("x")
        assert names(mark) == [table.removesuffix(".csv")]  # a user's own table of this name
        (here / mark / mark).write_text("{}")
        with pytest.raises(InputError, match=f"{mark}: the folder has no test"):
            find_tests(mark)


def test_names_that_collide_get_their_parents(here):
    assert names("monday", "tuesday") == ["monday-a", "b", "tuesday-a", "c"]
    (here / "monday/a.txt").write_text("x")
    assert names("monday") == ["a-csv", "a-txt", "b"]
    (here / "monday-a.csv").write_text("x")
    found = names("**/*.csv")
    assert len({name.casefold() for name in found}) == len(found) == 3


def test_each_file_is_taken_once_and_in_order(here):
    assert names("tuesday/c.dat", "monday/*", "monday/a.csv", "tuesday/*.csv") == [
        "monday-a", "b", "tuesday-a", "c",
    ]  # fmt: skip
    assert names("monday/*.csv", "monday/specimens.csv") == ["a", "specimens"]
    assert names("a.csv", base=here / "monday") == ["a"]
    (here / "monday/run[1].csv").write_text("x")
    assert names("monday/run[1].csv") == ["run[1]"]


def test_packed_tables_and_workbooks_are_tests(here):
    for name in ("d.csv.gz", "e.xlsx", "~$e.xlsx", "f.tar.gz", "specimens.csv.gz"):
        (here / "tuesday" / name).write_bytes(b"x")
    found = {path.name for _, path in find_tests("tuesday/*", base=here)}
    assert {"d.csv.gz", "e.xlsx"} <= found
    assert not {"~$e.xlsx", "f.tar.gz", "specimens.csv.gz"} & found


def test_a_packed_table_has_the_name_of_its_toml_and_none_that_of_a_summary(here):
    for name in ("d.csv.gz", "summary.html.csv", "summary.csv.gz"):
        (here / "monday" / name).write_bytes(b"x")
    assert names("monday") == ["a", "b", "d", "summary", "summary.html-2"]
    (here / "monday/d.csv").write_text("x")
    assert names("monday")[2:4] == ["d-csv", "d-csv-gz"]


def test_a_missing_file_or_a_broken_link_is_left_to_its_reader(here):
    assert names("monday/none.csv", "monday/a.csv") == ["a", "none"]
    with pytest.raises(InputError, match=r"monday/none\.csv: no such file or folder"):
        find_tests("monday/none.csv")
    (here / "monday/loop.csv").symlink_to("loop.csv")
    (here / "monday/folder.csv").mkdir()
    for pattern in ("monday", "monday/*.csv"):
        found = [path.name for _, path in find_tests(pattern)]
        assert [name for name in found if name != "b.txt"] == ["a.csv", "loop.csv"]


@pytest.mark.parametrize("pattern", ["monday/z*.csv", "monday/*.png", "none/**/*.csv", "empty"])
def test_what_matches_nothing_is_named(here, pattern):
    with pytest.raises(InputError) as error:
        find_tests(["monday", pattern])
    assert str(error.value).startswith(f"{pattern}: the ")
    assert "a test is a table that ends in .csv, .txt, .tsv, .dat, .gz or .xlsx" in str(error.value)


def test_a_toml_that_a_shell_names_is_no_test(here):
    assert names("monday/a.csv", "monday/a.toml", "monday/b.txt") == ["a", "b"]
    with pytest.raises(InputError, match=r"monday/a\.toml: a TOML is not a test"):
        find_tests("monday/a.toml")
