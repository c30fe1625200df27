"""Make the main figure of each notebook as a picture: notebooks/pictures/*.png.

    python notebooks/make_pictures.py

The tests are reconstructions, simulated from published parameters, not measurements.
"""

from __future__ import annotations

import sys
from pathlib import Path

import foamfit as ff
from foamfit.api import FitResult
from foamfit.report.comparison import compare
from foamfit.report.comparison_plot import plot_comparison
from foamfit.report.explore import plot_loop, rough_guess
from foamfit.report.plots import plot_fit

HERE = Path(__file__).parent
PICTURES = HERE / "pictures"
TESTS = HERE.parent / "experiments" / "foam-1"
CASES = {"model-2": "bistable", "model-3": "linear+bistable"}
DPI = 160


def read(case: str) -> ff.Measurement:
    """Read the reconstruction of a model of foam-1 at 2.0 m/s."""
    return ff.read_test(TESTS / f"{case}-2.0mps-reconstruction.csv")


def fit_with_site_damper(case: str) -> FitResult:
    """Fit a reconstruction with the paper's one damper, that of the striker."""
    test, model = read(case), CASES[case]
    params = ff.make_params(test, model)
    for parameter in params.values():
        if parameter.name.endswith("_eta"):
            parameter.set(value=0.0, vary=parameter.name == "site_eta")
    return ff.fit(test, model=model, params=params, seed=0)


def main() -> None:
    """Make the three pictures."""
    PICTURES.mkdir(exist_ok=True)
    test = read("model-2")
    comparison = compare([fit_with_site_damper(case) for case in CASES])
    picture = plot_loop(test, rough_guess(test))
    for name, figure in (
        ("fit_a_new_test", plot_fit(ff.fit(test, seed=0))),
        ("fitted_against_published", plot_comparison(comparison)),
        ("turn_the_parameters", picture),
    ):
        path = PICTURES / f"{name}.png"
        figure.savefig(path, dpi=DPI)
        print(f"{path.relative_to(HERE.parent)}  {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent / "experiments"))
    from unchanged import keep_unchanged

    with keep_unchanged(HERE):
        main()
