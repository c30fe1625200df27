"""The published parameter sets (Tables 1-3 of Thevamaran, Fraternali & Daraio 2014)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from foamfit.springs.chain import Chain
from foamfit.springs.laws import BistableSpring, LinearSpring
from foamfit.springs.spring import Spring
from foamfit.text import aligned, wrapped

MPA, MM, MG = 1e6, 1e-3, 1e-6


@dataclass(frozen=True)
class PublishedSet:
    """One published model of one specimen, SI.

    In a two-spring model the mass of the specimen lies between the springs. The published damping
    is the onsite damper of the striker.
    """

    name: str  #: for example "foam-1/model-2"
    model: str  #: springs from the base up, for example "linear+bistable"
    chain: Chain
    eta: float | None  #: the published damping coefficient, Pa·s
    damping_ratio: float | None  #: the damping ratio that the paper states
    specimen_mass: float  #: kg
    density: float  #: kg/m³
    striker_mass: float  #: kg
    striker_velocity: float  #: m/s

    @property
    def bistable(self) -> BistableSpring:
        """The bistable spring of the set."""
        spring = self.chain.springs[-1]
        assert isinstance(spring, BistableSpring)
        return spring

    def damping_ratio_by_formula(self) -> float | None:
        """ζ = η/(2 H √(ρ k_c)) with ρ = m_striker/(A H), the paper's definition."""
        if self.eta is None:
            return None
        height = self.chain.height
        density = self.striker_mass / (self.chain.area * height)
        return self.eta / (2.0 * height * math.sqrt(density * self.bistable.kc))


def _bistable(k0: float, drop: float, eps_a: float, eps_c: float, *ratios: float) -> BistableSpring:
    """Return a spring from k0 (MPa), Δσ/σ_a, ε_a, ε_c, k_h+/k0, k_h-/k0, k_c/k0 (Tables 2, 3)."""
    slope = k0 * MPA
    kh_plus, kh_minus, kc = (ratio * slope for ratio in ratios)
    dsigma = drop * slope * eps_a / (1.0 - eps_a)
    return BistableSpring(slope, kc, dsigma, eps_a, eps_c, kh_plus, kh_minus)


_FOAM_1 = {"specimen_mass": 5.56 * MG, "density": 238.0, "striker_velocity": 1.75}
_FOAM_2 = {"specimen_mass": 5.05 * MG, "density": 232.0, "striker_velocity": 4.44}


def _set(
    name: str, foam: dict[str, float], heights: list[float], springs: list[Spring],
    eta: float | None, ratio: float | None,
) -> PublishedSet:  # fmt: skip
    """Return a set of springs with these heights (mm), η and the damping ratio of the paper."""
    area = math.pi / 4.0 * (5.0 * MM) ** 2
    masses = [foam["specimen_mass"]] * (len(springs) - 1) + [0.0]
    chain = Chain(springs, [h * MM for h in heights], area, masses, site_damping=eta or 0.0)
    model = "+".join("linear" if isinstance(s, LinearSpring) else "bistable" for s in springs)
    return PublishedSet(name, model, chain, eta, ratio, striker_mass=7e-3, **foam)


class _Sets(dict[str, PublishedSet]):
    """The published parameter sets by name; the KeyError of an unknown name lists all names."""

    def __missing__(self, name: object) -> PublishedSet:
        raise KeyError(f"there is no published set {name!r}; there are {', '.join(self)}")


published: dict[str, PublishedSet] = _Sets(
    (item.name, item)
    for item in (
        _set(
            "foam-1/model-1", _FOAM_1, [1.190],
            [_bistable(5.50, -0.20, 0.14, 0.31, 2.60, 0.450, 15.0)], None, None,
        ),
        _set(
            "foam-1/model-2", _FOAM_1, [1.190],
            [_bistable(5.50, -0.20, 0.14, 0.31, 2.60, 0.425, 15.0)], 1e4, 0.894,
        ),
        _set(
            "foam-1/model-3", _FOAM_1, [0.700, 0.490],
            [LinearSpring(60 * MPA), _bistable(2.0, -0.32, 0.35, 0.71, 3.40, 0.525, 30.0)],
            3e2, 0.0297,
        ),
        _set(
            "foam-2", _FOAM_2, [0.350, 0.756],
            [
                LinearSpring(250 * MPA, unilateral=True),
                _bistable(5.75, -0.80, 0.40, 0.70, 6.00, 0.200, 40.0),
            ],
            1e4, 0.525,
        ),
    )
)  # fmt: skip


def table() -> str:
    """Return the published sets and their derived points as text, in the paper's units."""
    head = ["set", "spring", "k0", "ds/s_a", "eta", "eps_a", "eps_c", "h", "kh+/k0", "kh-/k0",
            "kc/k0"]  # fmt: skip
    sets = [head, ["", "", "MPa", "", "Pa·s", "", "", "mm", "", "", ""]]
    points = ["sigma_a", "sigma_c", "eps_star", "eps_hat_a", "eps_hat_c", "sigma_hat_c"]
    derived = [["set", *points], ["", "MPa", "MPa", "", "", "", "MPa"]]
    ratios = list[str]()
    for item in published.values():
        for spring, height in zip(item.chain.springs, item.chain.heights, strict=True):
            sets.append(_published_row(item, spring, height))
        values = [(getattr(item.bistable, p), MPA if "sigma" in p else 1.0) for p in points]
        cells = ("none" if value is None else f"{value / unit:.6f}" for value, unit in values)
        derived.append([item.name, *cells])
        ratio = item.damping_ratio_by_formula()
        if ratio is not None and item.damping_ratio is not None:
            agrees = math.isclose(ratio, item.damping_ratio, rel_tol=2e-3)
            told = "agrees" if agrees else "does not follow from the paper's own table"
            ratios += wrapped(f"{item.name}: {ratio:.3g} (paper {item.damping_ratio}: {told})")
    return "\n".join(
        [
            *wrapped("Published sets (Thevamaran, Fraternali & Daraio 2014, Tables 2 and 3)"),
            *("", *aligned(sets, right=range(2, len(head)))),
            *("", "Derived points of the bistable springs"),
            *("", *aligned(derived, right=range(1, len(derived[0])))),
            *("", *wrapped("Damping ratio eta/(2 H sqrt(rho kc)), rho = m_striker/(A H)")),
            *("", *ratios),
        ]
    )


def _published_row(item: PublishedSet, spring: Spring, height: float) -> list[str]:
    k0, h = f"{spring.k0 / MPA:g}", f"{height / MM:.3f}"
    if not isinstance(spring, BistableSpring):
        return [item.name, spring.law.kind, k0, *[""] * 4, h, *[""] * 3]
    drop = f"{spring.dsigma / spring.sigma_a:.2f}"
    eta = "-" if item.eta is None else f"{item.eta:g}"
    strains = [f"{strain:g}" for strain in (spring.eps_a, spring.eps_c)]
    slopes = [spring.kh_plus, spring.kh_minus, spring.kc]
    ratios = [f"{slope / spring.k0:.3g}" for slope in slopes]
    return [item.name, "bistable", k0, drop, eta, *strains, h, *ratios]
