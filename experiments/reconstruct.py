"""Remake the reconstructions of the paper's tests in experiments/foam-1 and experiments/foam-2.

No measured curve of the paper is available. These files are simulated from the published parameters
(Thevamaran, Fraternali & Daraio 2014, Tables 1-3) in the impact drive, with white noise of 1 % of
each channel's range and a fixed seed. They are reconstructions, not measurements. They use the
published masses and omit the published damping, which is numerical.

Each model is hit at the published velocity and at a round velocity just high enough to close its
loop, because foam-1 at 1.75 m/s never leaves branch d.

    python experiments/reconstruct.py
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

import foamfit as ff
import studies
from foamfit.springs.published import PublishedSet

HERE = Path(__file__).parent
NOISE, SEED = 0.01, 2014
ROWS = 600  # five in six of them in contact

VELOCITIES = {f"foam-1/model-{i}": (1.75, 2.0) for i in (1, 2, 3)} | {"foam-2": (4.44, 4.5)}

TABLE = """\
# RECONSTRUCTION, not a measurement: simulated from the published parameters of {set}
# (Thevamaran, Fraternali & Daraio 2014), impact drive, {velocity} m/s, no damping,
# white noise of {noise:.0%} of each channel's range, seed {seed}; by experiments/reconstruct.py
time (ms),force (N),displacement (mm)
"""

TOML = """\
# Beside a reconstruction (see the CSV): simulated, not measured.
name = "VACNT {set} at {velocity} m/s (reconstruction)"

[specimen]
height = "{height:g} mm"
diameter = "5 mm"
mass = "{mass:g} mg"
{heights}
[striker]
mass = "7 g"
velocity = "{velocity} m/s"

[noise]
stress = "{stress:.4g} kPa"
displacement = "{displacement:.4g} um"
"""


def simulate(item: PublishedSet, velocity: float, rows: int) -> tuple[np.ndarray, ...]:
    """Return time (s), base stress (Pa) and displacement (m) of an impact with pre-trigger."""
    chain = ff.Chain(item.chain.springs, item.chain.heights, item.chain.area, item.chain.masses)
    drive = ff.Impact(item.striker_mass, velocity)
    end = ff.simulate(chain, drive, np.linspace(0, 20 * chain.height / velocity, 101)).contact_end
    assert end is not None
    before = rows // 12
    time = (np.arange(-before, rows - before) + 0.5) * (end / (rows - 2 * before))
    response = ff.simulate(chain, drive, time, rtol=1e-9)
    return time, response.base_stress, response.displacement[-1]


def write(item: PublishedSet, velocity: float, place: Path = HERE, rows: int = ROWS) -> Path:
    """Write the CSV and the TOML of one reconstruction to a subfolder of `place`."""
    rng = np.random.default_rng([SEED, round(1000 * velocity), *item.name.encode()])
    time, stress, displacement = simulate(item, velocity, rows)
    noise = (NOISE * np.ptp(stress), NOISE * np.ptp(displacement[stress > 0]))
    force = (stress + noise[0] * rng.standard_normal(time.size)) * item.chain.area
    motion = displacement + noise[1] * rng.standard_normal(time.size)
    folder, slash, model = item.name.partition("/")
    path = place / folder / f"{model}{slash and '-'}{velocity}mps-reconstruction.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    facts = {"set": item.name, "velocity": velocity, "noise": NOISE, "seed": SEED}
    columns = np.column_stack([1e3 * (time - time[0]), force, 1e3 * motion])
    head = TABLE.format(**facts).rstrip()
    np.savetxt(path, columns, ["%.6f", "%.4f", "%.6f"], ",", header=head, comments="")
    heights = item.chain.heights
    listed = ", ".join(f'"{1e3 * h:g} mm"' for h in heights)
    toml = TOML.format(
        **facts, height=1e3 * item.chain.height, mass=1e6 * item.specimen_mass,
        heights=f"heights = [{listed}]    # base first\n" if len(heights) > 1 else "",
        stress=1e-3 * noise[0], displacement=1e6 * noise[1],
    )  # fmt: skip
    path.with_suffix(".toml").write_text(toml)
    return path


def main() -> None:
    for name, velocities in VELOCITIES.items():
        for velocity in velocities:
            item = replace(ff.published[name], striker_velocity=velocity)
            print(write(item, velocity).relative_to(HERE))


if __name__ == "__main__":
    studies.arguments(__doc__).parse_args()
    main()
