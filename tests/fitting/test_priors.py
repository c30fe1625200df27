"""A prior on a parameter counts as one residual."""

import math
from pathlib import Path

import pytest

import foamfit as ff
from conftest import run_refused, synthetic_impact, synthetic_loop, write_measurement

OPTIONS = {"model": "bistable", "starts": 2, "intervals": "local"}


@pytest.fixture(scope="module")
def impact() -> ff.Measurement:
    return synthetic_impact(samples=201)[1]


def test_a_prior_draws_the_value_and_narrows_the_interval(impact: ff.Measurement) -> None:
    alone = ff.fit(impact, **OPTIONS).parameters["s1_k0"]
    sigma = 0.5 * alone.stderr
    mean = alone.value + 3.0 * sigma
    result = ff.fit(impact, priors={"s1_k0": (mean, sigma)}, **OPTIONS)
    found = result.parameters["s1_k0"]
    weight = (sigma / alone.stderr) ** -2
    # the product of two normal distributions, if the residual is nearly linear
    assert found.value == pytest.approx((alone.value + weight * mean) / (1.0 + weight), rel=0.02)
    assert found.stderr == pytest.approx(math.hypot(1 / sigma, 1 / alone.stderr) ** -1, rel=0.05)
    assert result.to_json_dict()["priors"] == {"s1_k0": [mean, sigma]}
    assert any(note.startswith("Prior of s1_k0: ") for note in result.notes)
    assert "priors" not in {check.key for check in result.checklist if check.answer is False}
    far = (alone.value + 5.0 * alone.stderr, 0.1 * alone.stderr)
    against = ff.fit(impact, priors={"s1_k0": far}, **OPTIONS)
    [said] = [text for text in against.warnings if "contradict the prior of s1_k0" in text]
    assert f"alone they say about {alone.value / 1e6:.3f} MPa" in said
    free = ff.fit(impact, priors={"s1_k0": f"{mean / 1e6} ± 1e9 MPa"}, **OPTIONS)
    assert free.parameters["s1_k0"].value == pytest.approx(alone.value, rel=1e-6)


def test_a_prior_counts_by_the_noise_of_the_curves() -> None:
    """Below 0.5 % of the range it counted for more, and the law was said to miss the curves."""
    moved = []
    for noise in (5e-4, 5e-3):
        test = synthetic_loop(noise=noise)[1]
        alone = ff.fit(test, **OPTIONS).parameters["s1_k0"]
        prior = alone.value + 3.0 * alone.stderr, alone.stderr
        result = ff.fit(test, priors={"s1_k0": prior}, **OPTIONS)
        found = result.parameters["s1_k0"]
        moved.append([(found.value - alone.value) / alone.stderr, found.stderr / alone.stderr])
        assert result.warnings == ()
    assert moved[0] == pytest.approx(moved[1], rel=0.05)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("s1_k", (1.0, 2.0), "s1_k is not one of the model bistable"),
        ("s1_k0", (5e6, -1e5), "positive standard deviation"),
        ("s1_k0", "5 MPa", "positive standard deviation"),
        ("s1_k0", "5 ± -1 MPa", "must not be negative"),
        ("s1_k0", "5.5 ± 0.1 mm", "wrong dimension"),
        ("s1_k0", 5e6, "positive standard deviation"),
        ("site_eta", "1 ± 0.1 Pa s", "is held fixed"),
        ("velocity", "2 ± 0.1 m/s", "give its ± there"),
    ],
)
def test_a_wrong_prior_is_refused_in_one_sentence(impact, name, value, words) -> None:
    with pytest.raises(ff.InputError, match=words) as caught:
        ff.fit(impact, priors={name: value}, **OPTIONS)
    assert "\n" not in str(caught.value)


def test_priors_belong_to_one_model(impact: ff.Measurement) -> None:
    with pytest.raises(ff.InputError, match="priors belong to one model"):
        ff.fit(impact, model="auto", priors={"s1_k0": (1.0, 1.0)})
    with pytest.raises(ff.InputError, match="must be a mapping"):
        ff.fit(impact, priors=[1.0], **OPTIONS)


def test_the_toml_may_have_priors(impact: ff.Measurement, tmp_path: Path) -> None:
    for name in ("a", "b"):
        prior = '[priors]\ns1_k0 = "4 ± 0.001 MPa"\n'
        path = write_measurement(tmp_path / f"{name}.csv", impact, prior)
    result = ff.fit(ff.read_test(tmp_path / "a.csv"), **OPTIONS)
    assert result.parameters["s1_k0"].value == pytest.approx(4e6, rel=2e-3)
    study = tmp_path / "study.toml"
    study.write_text('name = "x"\ntests = ["*.csv"]\nmodel = "bistable"\n')
    with pytest.raises(ff.InputError, match=r"a joint fit accepts no \[priors\]"):
        ff.joint(study)
    for prior in ("s1_k0 = '4 MPa'", "s1_k0 = '4 ± 1 mm'", "s1_stifness = '4 ± 1 MPa'"):
        write_measurement(path, impact, f"[priors]\n{prior}\n")
        assert prior.split()[0] in run_refused("check", path)
    write_measurement(path, impact, "[priors]\ns1_k0 = 4e6\n")
    with pytest.raises(ff.InputError, match=r"\[priors\] s1_k0 = 4000000.0 must be like "):
        ff.read_test(path)
