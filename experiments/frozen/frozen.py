"""Does a code change alter results? Fits, simulations, a joint fit and a prediction.

Method and tolerances: README.md. The answer is the list of differences, if any.

    python experiments/frozen/frozen.py            # compare with frozen.csv; exit code 1 if changed
    python experiments/frozen/frozen.py --renew    # write frozen.csv
"""

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

import foamfit as ff

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from joint import SHARED, SPRING, write_study, write_test
from rig import Impact, Slow, impact, slow, write

HERE = Path(__file__).parent
ROOT = HERE.parent
Row = tuple[str, str, str | float | None]  # result, quantity, value
FILE = HERE / "frozen.csv"
EXACT, OTHER, ERRORS = 1e-9, 1e-3, 0.01
RECORDS = {
    "impact": Impact(),
    "impact trimmed": Impact(trimmed=True),
    "impact, acceleration": Impact(channels=("acceleration",)),
    "impact, velocity ±": Impact(velocity_sd=0.01),
    "impact, correlated": Impact(tau=8.0),
    "impact, microscale": Impact(law="microscale"),
    "impact, microscale+1": Impact(law="microscale", relaxation=1),
    "slow, bistable": Slow("bistable", noise=1e-3),
    "slow, bistable, any zero": Slow("bistable", noise=1e-3, early=True, zero=True),
    "slow, microscale": Slow(),
    "slow, microscale+1": Slow(relaxation=1),
    "slow, microscale+2, sine": Slow(relaxation=2, motion="sine", noise=1e-3),
    "slow, two springs": Slow("bistable+bistable", noise=1e-3),
    "slow, inner loop": Slow(inner=0.1, noise=1e-3),
}
FITS = {  # reconstruction: model, drive
    "foam-1/model-1-2.0mps": ("bistable", "impact"),
    "foam-1/model-1-1.75mps": ("bistable", "displacement"),
    "foam-1/model-2-2.0mps": ("bistable", "impact"),
    "foam-1/model-2-1.75mps": ("bistable", "stress"),
    "foam-1/model-3-2.0mps": ("linear+bistable", "impact"),
    "foam-2/4.5mps": ("linear+bistable", "impact"),
    "foam-2/4.44mps": ("microscale", "displacement"),
}


def of_fit(name: str, result: ff.FitResult) -> Iterator[Row]:
    """Yield the reference numbers of a fit."""
    yield name, "status", result.status
    yield from ((name, f"misfit {curve}", misfit) for curve, misfit in result.misfit.items())
    for parameter, p in result.parameters.items():
        low, high = p.ci95 or (None, None)
        found = {"state": p.state, "value": p.value, "stderr": p.stderr, "low": low, "high": high}
        yield from ((name, f"{parameter} {what}", value) for what, value in found.items())


def fits(folder: Path) -> Iterator[Row]:
    """Yield the numbers of fits of the reconstructions and of synthetic records."""
    for name, (model, drive) in FITS.items():
        test = ff.read_test(ROOT / f"{name}-reconstruction.csv")
        yield from of_fit(f"{name}, {model}, {drive}", ff.fit(test, model=model, drive=drive))
    for name, setup in RECORDS.items():
        record = impact(setup, 4001) if isinstance(setup, Impact) else slow(setup, 4001)
        (place := folder / name).mkdir()
        test = ff.read_test(write(record, place))
        yield from of_fit(name, ff.fit(test, model=setup.law, relaxation=setup.relaxation))


def simulations() -> Iterator[Row]:
    """Yield features of simulated curves: published chains, relaxation, masses, all drives."""
    time = np.linspace(0.0, 2e-3, 401)
    shape = np.sin(np.pi * time / time[-1]) ** 2
    relaxing = ff.MicroscaleSpring(
        5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77, 20.0, relaxation=[(0.5, 2e-4)]
    )
    alone = ff.Chain([relaxing], [1.2e-3], 2e-5)
    chains = {name: item.chain for name, item in ff.published.items()} | {"relaxation": alone}
    for name, chain in chains.items():
        height = sum(chain.heights)
        drives = {
            "impact": ff.Impact(7e-3, 2.0 if name != "relaxation" else 0.4),
            "displacement": ff.DisplacementDrive(0.4 * height * shape),
            "stress": ff.StressDrive((5e6 if name != "relaxation" else 3e5) * shape),
        }
        for drive, driven in drives.items():
            found = ff.simulate(chain, driven, time)
            stress, end = found.base_stress, found.contact_end
            marks = {"peak": stress.max(), "mean": stress.mean(), "strain": found.strain.max()}
            for mark, value in (marks | {"end": end}).items():
                yield f"simulation {name}, {drive}", mark, value


def together(folder: Path) -> Iterator[Row]:
    """Yield numbers of a joint fit of three synthetic tests and the prediction of a fourth."""
    rng = np.random.default_rng(5)
    for name, factor in {"t0": 0.9, "t1": 1.0, "t2": 1.1, "other": 1.04}.items():
        onset = factor * SPRING["sigma_plus"]
        write_test(folder / f"{name}.csv", 0.1, rng, sigma_plus=onset)
    found = ff.joint(write_study(folder, SHARED | {"sigma_plus": "scatter"}))
    for name, one in found.parameters.items():
        yield "joint", f"{name} value", one.value
        if one.ci95 is not None:
            yield "joint", f"{name} stderr", float(one.ci95[1] - one.ci95[0]) / 3.92
    other = ff.read_test(folder / "other.csv", folder / "foam.toml")
    for curve, one in ff.predict(found, other).curves.items():
        yield "prediction", f"inside {curve}", one.inside
        yield "prediction", f"band {curve}", one.half_width


def changed(before: dict[tuple[str, str], str], now: dict[tuple[str, str], str]) -> list[str]:
    """Return a sentence for each difference."""
    out = [f"{' '.join(key)}: gone" for key in before if key not in now]
    for (name, what), value in now.items():
        old = before.get((name, what), "nothing")
        try:
            size, off = abs(float(old)), abs(float(value) - float(old))
        except ValueError:
            same = old == value
        else:
            error = before.get((name, f"{what.rpartition(' ')[0]} stderr"), "0")
            bound = EXACT if name.startswith("simulation") else OTHER
            ends = what.endswith((" value", " low", " high"))
            allowed = ERRORS * float(error) + 1e-9 * size if ends and float(error) else bound * size
            same = off <= allowed or (math.isnan(float(old)) and math.isnan(float(value)))
        if not same:
            out.append(f"{name} {what}: {old} is now {value}")
    return out


def main() -> int:
    parser = studies.arguments(__doc__)
    parser.add_argument("--renew", action="store_true")
    options = parser.parse_args()
    with studies.workplace() as folder:
        found = [*simulations(), *fits(folder), *together(folder)]
    rows = [
        (*key, value if isinstance(value, str) else repr(float(value)))
        for *key, value in found if value is not None
    ]  # fmt: skip
    if options.renew:
        pd.DataFrame(rows, columns=["result", "quantity", "value"]).to_csv(FILE, index=False)
        return 0
    kept = pd.read_csv(FILE, dtype=str, keep_default_na=False).itertuples(index=False)
    before, now = ({(name, what): value for name, what, value in all_} for all_ in (kept, rows))
    differences = changed(before, now)
    print("\n".join(differences) or f"All {len(now)} numbers are unchanged.")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
