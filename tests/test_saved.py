"""Results read back from files, and their display in Python."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot

import fabricated
import foamfit as ff
from conftest import synthetic_impact
from foamfit.data.measurement import Outliers
from foamfit.report import listing as tables
from foamfit.report.listing import Row, row_of
from foamfit.results import Profile
from foamfit.study.identified import read_source
from foamfit.trust.intervals import Intervals


def odd() -> ff.FitResult:
    """Return a fit with outliers, profiles, open interval ends and an unusual name."""
    base = fabricated.result()
    n = base.curves.time.size
    gone = np.arange(n) % 50 == 3
    rest = np.array([1.0, 2.5])
    profile = Profile("s1_k0", rest, rest, np.ones((2, 3)), 3.84, (1.0, 2.0))
    test = replace(
        base.measurement,
        name="=1+1 $α_β$ % \\ [x]",
        outliers={"stress": Outliers(gone, rest, rest)},
        sampled={"displacement": ~gone},
        acceleration=base.curves.stress / 7.0,
        path=Path("a") / "b.csv",
    )
    open_end = fabricated.estimate("s1_kc", 8e7, ci95=(-np.inf, 9e7))
    return fabricated.result(
        measurement=test,
        parameters=base.parameters | {"s1_kc": open_end},
        intervals=Intervals(profiles=(profile,), elsewhere={"s1_k0": 1.0}),
    )


@pytest.fixture(scope="module")
def fitted() -> ff.FitResult:
    _, test = synthetic_impact(samples=201)
    return ff.fit(test, model="bistable", starts=2, intervals="local")


def test_a_folder_gives_the_same_result_back(fitted: ff.FitResult, tmp_path: Path) -> None:
    for i, one in enumerate((fitted, odd(), fabricated.microscale_result())):
        first, again = tmp_path / str(i), tmp_path / f"{i} again"
        one.save(first, report=False)
        read = ff.load(first)
        assert isinstance(read, ff.FitResult)
        assert read.chain == one.chain
        assert read.params == one.params
        assert read.measurement.specimen == one.measurement.specimen
        assert np.array_equal(read.curves.stress, one.curves.stress)
        assert repr(read) == repr(one)
        read.save(again, report=False)
        for path in first.iterdir():
            assert path.read_bytes() == (again / path.name).read_bytes(), path.name
        assert read_source(read).parameters == read_source(one).parameters
        assert json.dumps(read.to_json_dict()) == json.dumps(one.to_json_dict())
    read = ff.load(tmp_path / "0")
    assert isinstance(read, ff.FitResult)
    assert fitted.insight is not None
    assert read.insight is not None
    assert read.insight.sentence() == fitted.insight.sentence()
    assert read.insight.parts == fitted.insight.parts
    np.testing.assert_allclose(read.insight.shares(), fitted.insight.shares(), atol=1e-9)


def test_cycles_and_batches_are_read_back(tmp_path: Path) -> None:
    results = {n: fabricated.result(seed=n) for n in (1, 3)}
    cycles = ff.CycleFits("foam", "bistable", (1, 2, 3), results, {2: "no rows"})
    cycles.save(tmp_path / "cycles", report=False)
    read = ff.load(tmp_path / "cycles")
    assert list(read.rows()) == list(cycles.rows())
    pd.testing.assert_frame_equal(read.table(), cycles.table())
    rows = [row_of("-a", "f", odd()), Row("=b", "f", "refused", "no rows")]
    tables.write_summary(rows, tmp_path)
    read = ff.load(tmp_path)
    pd.testing.assert_frame_equal(
        read, pd.DataFrame(tables.table_rows(rows)).astype(read.dtypes.to_dict())
    )


@pytest.mark.parametrize("folder", ["foam-1/model-2/stress", "foam-2/impact"])
def test_results_of_earlier_versions_are_read(folder: str) -> None:
    path = Path(__file__).parent.parent / "fits" / folder / "fit.json"
    written = json.loads(path.read_text(encoding="utf-8"))["parameters"]
    for name, one in read_source(path).parameters.items():
        found = written.get(name, {"value": 0.0, "stderr": None})
        assert (one.value, one.stderr) == (found["value"], found["stderr"]), name


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("fit.json", lambda text: text.replace('"schema": 1', '"schema": 7'), "schema 7"),
        ("fit.json", lambda text: text.replace('"load"', '"other"'), "fit the test again"),
        ("fit.json", lambda text: text.replace('"seed": 3', '"sed": 3'), "cannot be read back"),
        (
            "fit.json",
            lambda text: text.replace('"kind": "bistable"', '"kind": "x"'),
            "'x' is not a spring",
        ),
        ("fit.json", lambda text: text.replace('"value": 5500000.0', '"value": "x"'), "wrong kind"),
        ("curves.csv", lambda text: text[: len(text) // 2], "rows of 601"),
        ("curves.csv", lambda text: text.replace("fitted stress", "stress"), "fitted stress"),
        ("curves.csv", lambda text: text.replace("\n0.0,", "\nzero,", 1), "damaged"),
    ],
)
def test_what_is_damaged_is_refused_in_one_sentence(name, change, words, tmp_path: Path) -> None:
    fabricated.result().save(tmp_path / "x", report=False)
    path = tmp_path / "x" / name
    path.write_text(change(path.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(ff.InputError, match=words) as caught:
        ff.load(tmp_path / "x")
    assert "\n" not in str(caught.value)
    with pytest.raises(ff.InputError, match="is not a folder"):
        ff.load(tmp_path / "nowhere")


def test_a_panel_is_drawn_into_axes_of_the_user(fitted: ff.FitResult) -> None:
    figure, ax = pyplot.subplots()
    assert fitted.plot(ax) is ax
    assert {line.get_label() for line in ax.lines} >= {"measured", "fitted"}
    other = fitted.plot(what="displacement-time")
    assert other.get_ylabel() == "displacement (µm)"
    with pytest.raises(ff.InputError, match="stress-strain"):
        fitted.plot(what="strain")
    pyplot.close(figure)
    pyplot.close(other.figure)


def test_what_python_and_notebooks_show(fitted: ff.FitResult) -> None:
    lines = repr(odd()).splitlines()
    assert len(lines) <= 6
    assert "status warnings" in repr(odd())
    assert "s1_k0 5.500 ± 0.066 MPa" in repr(odd())
    table = fitted.table()
    assert table.loc["s1_k0", "value"] == fitted.parameters["s1_k0"].value
    assert list(table.index) == list(fitted.parameters)


def test_tables_have_balanced_braces_and_columns(tmp_path: Path) -> None:
    """Also with unusual names."""
    strange = "a_1 & 100 % #µ~^\\ {x} [*] <σ> ü 漢 $"
    cycles = ff.CycleFits(strange, "bistable", (1, 2), {1: odd(), 2: fabricated.result()}, {})
    cycles.save(tmp_path / "cycles", report=False)
    made = [
        (tmp_path / "cycles" / "table.tex").read_text(encoding="utf-8"),
        (tmp_path / "cycles" / "cycle-1" / "table.tex").read_text(encoding="utf-8"),
        cycles.table().to_latex(),
        odd().table().rename(index={"s1_k0": strange}).to_latex(),
    ]
    assert r"$5.500 \pm 0.066$" in made[1]
    for text in made:
        assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 1
        assert r"\toprule" in text
        body = text.replace(r"\{", "").replace(r"\}", "")
        assert body.count("{") == body.count("}")
        columns = {row.replace(r"\&", "").count("&") for row in text.splitlines() if "&" in row}
        assert len(columns) == 1


@pytest.fixture(scope="module")
def chained() -> ff.FitResult:
    pytest.importorskip("emcee")
    pytest.importorskip("xarray")
    _, test = synthetic_impact(samples=101)
    return ff.fit(test, model="bistable", starts=2, intervals="mcmc", draws=100)


def test_samples_of_a_chain_are_kept(chained, tmp_path: Path, monkeypatch) -> None:
    import xarray

    samples = chained.samples
    assert dict(samples.sizes) == {"chain": 2 * len(samples) + 4, "draw": 80}
    assert samples["s1_k0"].attrs["units"] == "Pa"
    low, high = np.percentile(samples["s1_k0"], [2.5, 97.5])
    assert chained.parameters["s1_k0"].ci95 == pytest.approx((low, high))
    chained.save(tmp_path / "x", report=False)
    read = ff.load(tmp_path / "x")
    xarray.testing.assert_identical(read.samples, samples)
    assert fabricated.result().samples is None
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ff.InputError, match=r'pip install "foamfit\[mcmc\]"'):
        _ = read.samples
