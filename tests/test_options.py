"""One description of the options: command line, Python, study file, page and docs agree with it."""

import math
from dataclasses import fields
from inspect import getdoc

import click
import pytest

import foamfit as ff
from conftest import ROOT
from foamfit.cli.fit import batch, fit
from foamfit.one_model import Options
from foamfit.options import OF_FIT, OPTIONS, Given, Keywords
from foamfit.study.study_file import _KEYS


def test_type_checkers_know_every_option_and_its_type():
    assert Keywords.__annotations__.keys() == OF_FIT.keys()
    types = {name: one.__forward_arg__ for name, one in Keywords.__annotations__.items()}
    assert types == {one.name: one.type for one in fields(Given)}


@pytest.mark.parametrize("command", [fit, batch])
def test_the_command_has_every_option_with_its_default_and_help(command):
    given = {one.name: one for one in command.params if isinstance(one, click.Option)}
    for name, one in OPTIONS.items():
        assert (name not in given) == one.python_only
        if not one.python_only:
            assert given[name].help == one.text
            assert one.default in (given[name].default, None, (), False)


def test_help_in_python_has_every_option_with_unit_and_default():
    for function in (ff.fit, ff.fit_cycles, ff.batch):
        text = " ".join(getdoc(function).split())
        if function is ff.fit:
            for name, one in OF_FIT.items():
                assert f"{name} : {one.kind}" in text
                assert " ".join(one.text.split()) in text
                assert one.default is None or f"Default: {one.default!r}" in text
                assert one.unit in text
        assert "**options" not in text


def table():
    """The table of all options in docs/options.md."""
    lines = [
        "| command | Python | unit | default | admissible | meaning |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for one in OPTIONS.values():
        command = "" if one.python_only else f"`{f'{one.flag} {one.metavar}'.strip()}`"
        python = "" if one.name in ("profile", "mcmc") else f"`{one.name}`"
        default = (
            "off"
            if one.kind == "bool"
            else one.usual or str("" if one.default in (None, ()) else one.default)
        )
        cells = (command, python, one.unit, default, one.right, one.told)
        lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    return "\n".join(lines)


def test_the_documentation_has_the_table():
    assert table() in (ROOT / "docs" / "options.md").read_text(encoding="utf-8")


def test_a_study_file_calls_the_options_by_the_same_names():
    assert set(_KEYS) - {"name", "tests", "specimens", "parameters"} <= OPTIONS.keys()


@pytest.mark.parametrize(
    ("given", "right"),
    [
        ({"drive": "push"}, "one of impact, stress, displacement"),
        ({"seed": -1}, "a whole number from 0 up"),
        ({"seed": "a"}, "a whole number from 0 up"),
        ({"seed": None}, "a whole number from 0 up"),
        ({"starts": 0}, "a whole number from 1 to 100000"),
        ({"starts": 2.5}, "a whole number"),
        ({"max_time": 0}, "positive, in s"),
        ({"max_time": math.nan}, "positive, in s"),
        ({"max_time": "soon"}, "positive, in s"),
        ({"relaxation": 11}, "a whole number from 0 to 10"),
        ({"intervals": "bootstrap"}, "one of auto, local, profile, mcmc"),
        ({"intervals": "mcmc", "draws": 5}, "a whole number from 100 to 100000"),
        ({"weights": [1.0]}, "a mapping like {'stress_time': 1}"),
    ],
)
def test_what_is_not_admissible_is_named_with_what_would_be(given, right):
    (name, value), *_ = reversed(given.items())
    with pytest.raises(ff.InputError) as refused:
        Options(**given)
    assert str(refused.value).startswith(
        f"{name} = {value!r} is not admissible; it must be {right}"
    )
