"""Scenes of the comparison, for the present solver and for the stepper."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import foamfit as ff
from foamfit.solve.plan import plan
from foamfit.springs.chain import Drive
from foamfit.springs.parameters import direction

sys.path[:0] = [str(Path(__file__).parents[1] / "error_vs_runtime"), str(Path(__file__).parent)]
import along
import scenes as kinds
from laws import bistable, linear, microscale

import stepper

Array = NDArray[np.float64]
# The parameters of a microscale law as foamfit numbers them and as the law here does.
NUMBERS = {8: 7, 9: 8, 10: 9}
MOST = 1_000_000.0


@dataclass(frozen=True)
class Scene:
    """A chain under a drive, and the parameters of the derivatives."""

    name: str
    chain: ff.Chain
    drive: Drive
    time: Array
    names: tuple[str, ...]

    @property
    def directions(self) -> NDArray[np.int64]:
        """Directions of the derivatives, as foamfit numbers them."""
        chosen = [direction(self.chain.kinds, name, self.chain.relaxation) for name in self.names]
        return np.array(chosen, np.int64)


SEVEN = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus")
MICRO = ("k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus")
MORE = ("stiffening", "softening", "weakening")


def _names(**lists: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{spring}_{name}" for spring, names in lists.items() for name in names)


def scenes() -> list[Scene]:
    """Return all scenes."""
    t, area, height = np.linspace(0.0, 0.8e-3, 501), kinds.AREA, kinds.HEIGHT
    one, base, three = kinds.MODEL_2.bistable, kinds.MODEL_3.chain.springs[0], kinds.MODEL_3.chain
    upper, heights = kinds.MODEL_3.chain.springs[1], list(three.heights)
    hit, soft = ff.Impact(7e-3, 2.0), ff.Impact(7e-3, 2.3)

    def damped(spring, eta):
        values = {name: getattr(spring, name) for name in spring.law.names}
        return type(spring)(**(values | {"eta": eta}))

    bare = [damped(base, 0.0), damped(upper, 0.0)]
    both = [damped(base, 300.0), damped(upper, 200.0)]
    half = [damped(base, 300.0), damped(upper, 0.0)]
    law = (5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77)
    shoe, wide, struck = 25e-3, 1.6e-3, np.linspace(0.0, 0.08, 501)
    pressed = np.linspace(0.0, 2.0, 1280)
    motion = 0.6 * shoe * np.sin(np.pi * pressed) ** 2 * np.where(pressed < 1.0, 1.0, 0.8)
    plain, slow = ff.MicroscaleSpring(*law), ff.MicroscaleSpring(*law, relaxation=[(0.5, 0.2)])
    quick = ff.MicroscaleSpring(*law, relaxation=[(0.5, 0.01)])
    own = {"stiffening": 1.5, "softening": 0.8, "weakening": 0.5}
    worn = ff.MicroscaleSpring(law[0], law[1], 0.2, *law[3:], **own)
    both_own = ff.MicroscaleSpring(law[0], law[1], 0.2, *law[3:], relaxation=[(0.5, 0.2)], **own)
    fast, on_foam = ff.Impact(2.0, 1.5), 0.6 * height * np.sin(np.pi * pressed) ** 2
    relaxing = ff.BistableSpring(*one.seven, relaxation=[(0.5, 0.2)])
    eight, two = (*SEVEN, "eta"), {"s1": ("k0",), "s2": SEVEN}

    def chain(*springs, heights=None, masses=None, area=area):
        return ff.Chain(springs, heights or [height], area, masses or [0.0] * len(springs))

    inside, shoes = [kinds.MODEL_3.specimen_mass, 0.0], {"heights": [shoe], "area": wide}
    pair = {"heights": [0.2 * shoe, 0.8 * shoe], "area": wide}
    return [
        Scene("one spring, impact", chain(one), hit, t, _names(s1=eight)),
        Scene("one spring with a dashpot, impact", chain(damped(one, 200.0)), soft, t, _names(s1=eight)),
        Scene("two springs, specimen's mass, onsite damper, impact", three, soft, t, _names(**two)),
        Scene("two springs, specimen's mass and dashpots, impact", chain(*both, heights=heights, masses=inside), soft, t, _names(**two)),
        Scene("two springs, zero-mass node, impact", chain(*bare, heights=heights), soft, t, _names(**two)),
        Scene("two springs, zero-mass node, both dashpots, impact", chain(*both, heights=heights), soft, t, _names(**two)),
        Scene("two springs, zero-mass node, one dashpot, impact", chain(*half, heights=heights), soft, t, _names(**two)),
        Scene("10 springs with dashpots, 9 masses, impact", kinds.graded(10, kinds.MODEL_2.specimen_mass, 2.0), ff.Impact(7e-3, 2.2), t, _names(s1=SEVEN)),
        Scene("microscale, impact", chain(plain, **shoes), fast, struck, _names(s1=(*MICRO, "eta"))),
        Scene("microscale, relaxation, impact", chain(quick, **shoes), fast, struck, _names(s1=(*MICRO, "g1", "tau1"))),
        Scene("microscale with memory, impact", chain(worn, **shoes), fast, struck, _names(s1=(*MICRO, *MORE))),
        Scene("microscale on a linear spring, relaxation, zero-mass node, impact", chain(ff.LinearSpring(5e6), quick, **pair), fast, struck, _names(s1=("k0",), s2=(*MICRO, "g1", "tau1"))),
        Scene("microscale with memory on a linear spring, mass of 20 g, impact", chain(ff.LinearSpring(5e6), worn, masses=[0.02, 0.0], **pair), fast, struck, _names(s1=("k0",), s2=(*MICRO, *MORE))),
        Scene("bistable, motion", chain(one), ff.DisplacementDrive(on_foam), pressed, _names(s1=SEVEN)),
        Scene("bistable, relaxation, motion", chain(relaxing), ff.DisplacementDrive(on_foam), pressed, _names(s1=(*SEVEN, "g1", "tau1"))),
        Scene("microscale, motion", chain(plain, **shoes), ff.DisplacementDrive(motion), pressed, _names(s1=MICRO)),
        Scene("microscale, relaxation, motion", chain(slow, **shoes), ff.DisplacementDrive(motion), pressed, _names(s1=(*MICRO, "g1", "tau1"))),
        Scene("microscale with memory, relaxation, motion", chain(both_own, **shoes), ff.DisplacementDrive(motion), pressed, _names(s1=(*MICRO, *MORE))),
    ]  # fmt: skip


def present(scene: Scene, derive: bool):
    """Return a function of rtol that runs the present solver as a fit does."""
    names = scene.names if derive else ()
    made = plan(
        scene.chain, scene.drive, scene.time, dashpots=any(name.endswith("_eta") for name in names)
    )
    rows, heights = scene.chain.arrays.rows, scene.chain.arrays.heights
    given = {"directions": scene.directions} if derive else {}

    def run(rtol: float):
        return made.run(rows, heights, rtol, everything=False, **given)

    return run


def row_of(spring, height: float, terms: int) -> tuple[stepper.Law, Array]:
    """Return law and row of a foamfit spring."""
    if isinstance(spring, ff.LinearSpring):
        law, values = linear.LAW, (spring.k0,)
    elif isinstance(spring, ff.BistableSpring):
        law, values = bistable.LAW, spring.seven
    else:
        law = microscale.LAW
        values = tuple(getattr(spring, name) for name in microscale.NAMES)
    return law, stepper.row(law, values, height, spring.eta, spring.relaxation, terms)


def stepped(scene: Scene, derive: bool):
    """Return a function of the tolerance that runs the stepper; (base stress, displacement) first."""
    chain, drive, t = scene.chain, scene.drive, scene.time
    terms = max(len(spring.relaxation) for spring in chain.springs)
    laws, rows = zip(*(row_of(s, h, terms) for s, h in zip(chain.springs, chain.heights)))
    rows, directions = np.array(rows), []
    if derive:
        directions = [
            (i, NUMBERS.get(what, what) if laws[i] is microscale.LAW else what)
            for i, what in scene.directions.tolist()
        ]
    if isinstance(drive, ff.DisplacementDrive):
        strain = np.array(drive.displacement) / chain.heights[0]
        made = along.Prepared(laws[0], terms, directions)
        return lambda tol: made.run(rows[0], strain, t, tol)
    masses = np.array(chain.masses)
    masses[-1] += drive.mass
    ends = np.flatnonzero(masses > 0.0) + 1
    etas = [spring.eta for spring in chain.springs]
    made = stepper.Prepared(
        laws, ends.tolist(), masses[ends - 1] / chain.area, terms, etas, directions
    )

    def run(tol: float):
        numbers = np.array((chain.site_damping / chain.height, 0.0, drive.velocity, tol, MOST))
        (outcome, *rest), out = made.run(rows, numbers, t)
        assert outcome == stepper.DONE, (scene.name, outcome, rest)
        return out

    return run
