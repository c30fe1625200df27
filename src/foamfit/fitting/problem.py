"""The problem of a fit: the parameters of a model with bounds, and the objective."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import starmap
from numbers import Real

import lmfit
import numpy as np

from foamfit.arrays import Array
from foamfit.data.calibration import balance
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError
from foamfit.fitting import curves, nuisance
from foamfit.fitting.box import Scales, Space, Tied, follow, others
from foamfit.fitting.given import check_admissible, check_strain, copied, prior_of
from foamfit.fitting.objective import Objective
from foamfit.springs.laws.record import Between
from foamfit.springs.model import Model, with_options
from foamfit.springs.parameters import NUISANCE, split_name

# Why some parameters exist in the impact drive only.
_MOVED = "a given motion needs no striker; choose the impact drive"
ONLY_IMPACT = {
    nuisance.VELOCITY: _MOVED,
    nuisance.STRIKER_MASS: _MOVED,
    nuisance.FORCE_SCALE: "along a given motion or stress, a scale of the force cannot be "
    "distinguished from a scale of all stiffnesses; choose the impact drive",
}


def make_params(
    measurement: Measurement,
    model: str | Model = "bistable",
    drive: str | None = None,
    *,
    time_shift: bool = False,
    relaxation: int = 0,
    **options: bool,
) -> lmfit.Parameters:
    """Return the parameters of a model for a test; change them, and pass them to `fit`.

    The bounds follow from the scales of the test. In the impact drive one damping parameter varies:
    the dashpot of a single spring, or the onsite damper of the striker of a chain, as in the paper.
    In the other drives all damping is fixed at zero by default, except for the dashpot of a single
    spring if the motion of an impact replaces a contradicted striker. Heights are those of the
    specimen if it states them; otherwise they vary with a fixed sum.

    Parameters
    ----------
    measurement : Measurement
        The test.
    model : str or Model
        For example "linear+bistable".
    drive : str, optional
        "impact", "stress" or "displacement"; by default as in `fit`.
    time_shift : bool
        Whether the delay of the motion relative to the force is a parameter. It always is if the
        motion has its own clock and the delay has a ±.
    relaxation : int
        Number of relaxation terms of every hysteretic spring, if `model` is a name.
    options : bool
        "stiffening" and "mullins", as for `fit`.

    Returns
    -------
    lmfit.Parameters
        Values in SI, named s1_k0 … site_eta.
    """
    if isinstance(model, str):
        model = Model.parse(with_options(model, **options), relaxation)
    drive = curves.choose_drive(measurement) if drive is None else drive
    scales = Scales.of(measurement)
    _check_record(measurement, model)
    params, count = lmfit.Parameters(), len(model.kinds)
    fast = drive == "impact"
    on_striker = fast and (count > 1 or balance(measurement).damping is not None)
    if drive == "displacement" and count == 1:
        fast = curves.replaces_striker(measurement)
    for name in model.names:
        spring, short = split_name(name)
        if short == "height":
            continue
        param = model.param(name)
        value = param.start[0] * scales.unit(param.start[1])
        low, high = (bound * scales.unit(param.scale) for bound in param.bounds)
        low *= scales.least(param)
        if _alike(low, high):
            wrong = (
                f"{measurement.name}: {name} cannot be searched between {low:.2g} and {high:.2g}"
            )
            raise InputError(f"{wrong} (SI); check the units of the test")
        vary = short != "eta" or (on_striker if spring < 0 else fast and count == 1)
        params.add(name, value=value, min=low, max=high, vary=vary)
    _add_heights(params, measurement, model)
    late = nuisance.is_late(measurement, time_shift=time_shift)
    _add_nuisance(params, measurement, scales, drive, late)
    if curves.history(measurement, model) is not None and "displacement_zero" in params:
        # A stress that relaxes may be gone above the strain at which the first contact was.
        params["displacement_zero"].min -= measurement.start_strain * measurement.specimen.height
    for name in params:  # a fifth of the upper end, where the ends are zero and other parameters
        if name in model.index and isinstance((param := model.param(name)).coordinate, Between):
            first, last = param.coordinate.ends(*others(name, param, params.valuesdict()))
            if first == 0.0:
                params[name].value = 0.2 * last
    return params


def fix_and_vary(
    params: lmfit.Parameters, model: str, fix: Mapping[str, float], vary: Iterable[str]
) -> lmfit.Parameters:
    """Fix some parameters of a model at SI values, and vary others that are fixed by default."""
    vary = tuple(vary)
    check_fixed_and_varied(params, model, fix, vary)
    for name in (*fix, *vary):
        if params[name].expr is not None:
            others = ", ".join(other for other in params if other in params[name].expr)
            raise InputError(f"parameter '{name}' follows from {others}; fix or vary that instead")
        if name in vary and name.endswith("_height") and not params[name].vary:
            raise InputError(
                f"'{name}' is given by the specimen; leave [specimen] heights out to have it fitted"
            )
    for name, value in fix.items():
        if not isinstance(value, Real):
            raise InputError(f"fix: {name} = {value!r} must be a number in SI units, like 5.5e6")
        params[name].set(value=float(value), vary=False, min=-math.inf, max=math.inf)
    for name in vary:
        params[name].set(vary=True)
    return params


def check_fixed_and_varied(
    names: Iterable[str], model: str, fix: Mapping[str, float], vary: Iterable[str]
) -> None:
    """Raise InputError for an unknown parameter, or one that is both fixed and varied."""
    for name in (*fix, *vary):
        if name in ONLY_IMPACT and name not in names:
            raise InputError(f"'{name}' cannot be fixed or varied here: {ONLY_IMPACT[name]}")
        _check_known(f"parameter '{name}'", name, model, names)
        if name in fix and name in vary:
            raise InputError(f"parameter '{name}' cannot be both fixed and varied; choose one")


def _check_known(what: str, name: str, model: str, names: Iterable[str]) -> None:
    """Raise InputError if a parameter is not among the `names` of those of a model."""
    if name not in names:
        its = ", ".join(names)
        raise InputError(f"{what} is not one of the model {model}; its parameters are {its}")


def _add_heights(params: lmfit.Parameters, measurement: Measurement, model: Model) -> None:
    """Add the heights of a chain: those of the specimen, or varied with a fixed sum."""
    count, specimen = len(model.kinds), measurement.specimen
    if specimen.heights is not None and len(specimen.heights) != count > 1:
        raise InputError(
            f"{measurement.name}: [specimen] heights has {len(specimen.heights)} values for "
            f"a model of {count} springs; give one per spring, base first"
        )
    low, value = 0.02 * specimen.height, specimen.height / count
    for i in range(1, count + 1) if count > 1 else ():
        if specimen.heights is not None:
            params.add(f"s{i}_height", value=specimen.heights[i - 1], vary=False)
        elif i < count:
            params.add(f"s{i}_height", value=value, min=low, max=specimen.height - low)
        else:
            params.add(f"s{count}_height", expr=_rest_of_height(measurement, model))


def _add_nuisance(
    params: lmfit.Parameters, measurement: Measurement, scales: Scales, drive: str, late: bool
) -> None:
    """Add the nuisance parameters, in the numbers of the file."""
    weights = curves.default_weights(measurement, drive)
    counted = {
        "displacement": weights["displacement_time"] > 0.0 or drive == "displacement",
        "stress": weights["stress_time"] + weights["stress_strain"] > 0.0,
        "acceleration": measurement.acceleration is not None,
    }
    free = nuisance.open_in(measurement, drive, counted) | {nuisance.TIME_SHIFT}
    shows_force = counted["stress"] and (counted["displacement"] or counted["acceleration"])
    usual = nuisance.values_of(measurement)
    if late and drive == "impact":
        usual |= nuisance.aligned(measurement)
    for name in nuisance.names_of(drive, time_shift=late):
        low, high = nuisance.limits_of(name, measurement, drive, scales.duration, late=late)
        origin = measurement.origins.get(name, 0.0)
        low, high = low + origin, high + origin
        open_ = not _alike(low, high) and (name != nuisance.FORCE_SCALE or shows_force)
        limits = {"min": low, "max": high} if open_ else {}
        params.add(name, value=usual[name] + origin, vary=name in free and open_, **limits)


def _alike(low: float, high: float) -> bool:
    """Return whether lmfit takes two limits for equal."""
    return high <= low or bool(np.isclose(low, high, rtol=1e-13, atol=1e-13))


def _counted_from(
    params: lmfit.Parameters, origins: Mapping[str, float], sign: float
) -> lmfit.Parameters:
    """Shift nuisance parameters by the origins: sign 1 to the numbers of the file, -1 back."""
    for name in origins.keys() & params.keys():
        if by := sign * origins[name]:
            one = params[name]
            one.set(value=one.value + by, min=one.min + by, max=one.max + by)
    return params


def _rest_of_height(measurement: Measurement, model: Model) -> str:
    """Return the expression for the height of the last spring: the specimen minus the others."""
    others = [f"s{i}_height" for i in range(1, len(model.kinds))]
    return " - ".join([repr(measurement.specimen.height), *others])


def _put_rest(height: float, others: slice, last: int, values: Array) -> Array:
    """Set the height of the last spring: the specimen minus the others."""
    values[last] = height - values[others].sum(axis=0)
    return values


@dataclass(frozen=True, eq=False)
class Problem:
    """The problem of a fit, and the conversion between lmfit's parameters and a flat vector."""

    measurement: Measurement
    model: Model
    objective: Objective
    params: lmfit.Parameters
    scales: Scales
    notes: tuple[str, ...] = ()
    # Nuisance parameters that are held where the record shows them
    kept: Mapping[str, nuisance.Prior] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the flat vector: parameters of the model, then nuisance ones."""
        return (*self.model.names, *self.objective.nuisance)

    @cached_property
    def index(self) -> dict[str, int]:
        """Index of each parameter in the flat vector."""
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def origins(self) -> Array:
        """Values subtracted by the loader, SI: values + origins are the numbers of the file."""
        return np.array([self.measurement.origins.get(name, 0.0) for name in self.names])

    def vector(self, params: lmfit.Parameters | None = None) -> Array:
        """Return the flat vector of `params`, or of the problem's own parameters."""
        values = (self.params if params is None else params).valuesdict()
        return np.array([values[name] for name in self.names])

    def thinned(self) -> Problem:
        """Return the problem on a few hundred samples, for the search."""
        return replace(self, objective=self.objective.thinned())

    def told(self) -> lmfit.Parameters:
        """Return the parameters for the user: nuisance parameters in the numbers of the file."""
        return _counted_from(self.params.copy(), self.measurement.origins, 1.0)

    def is_exact(self, name: str) -> bool:
        """Return whether a nuisance parameter is fixed by the record, not by the user."""
        one, usual = self.params[name], nuisance.values_of(self.measurement)
        return not one.vary and one.value == usual.get(name) and name not in self.kept

    def with_springs(self, vector: Array, own: Array | None = None) -> Array:
        """Return `own` (by default the start) with varied spring parameters of another test."""
        values = self.vector() if own is None else own.copy()
        free = [self.index[name] for name in self.free() if name not in NUISANCE]
        values[free] = vector[free]
        return self.space().complete(values)

    def put(self, values: Array) -> None:
        """Store a flat vector in `params`."""
        for name, value in zip(self.names, values, strict=True):
            if self.params[name].expr is None:
                self.params[name].value = float(value)
        self.params.update_constraints()

    def free(self) -> tuple[str, ...]:
        """Return the names of the parameters that vary."""
        return tuple(name for name in self.names if self.params[name].vary)

    def holding(self, values: Mapping[str, float]) -> Problem:
        """Return the problem with those parameters that vary fixed at `values`, SI."""
        params = self.params.copy()
        for name in values.keys() & self.free():
            params[name].set(value=values[name], vary=False)
        return replace(self, params=params)

    @cached_property
    def tied(self) -> Tied | None:
        """A function that sets the parameters given by expressions; None without any."""
        each = {name: self.params[name].expr for name in self.names}
        expressions = {name: expr for name, expr in each.items() if expr is not None}
        if [*expressions.values()] == [_rest_of_height(self.measurement, self.model)]:
            first, last = self.index["s1_height"], self.index[f"s{len(self.model.kinds)}_height"]
            height = self.measurement.specimen.height
            return partial(_put_rest, height, slice(first, last), last)  # faster than lmfit
        params = self.params.copy()
        for one in params.values():  # a step beyond a limit must not be cut there
            if one.expr is None:
                one.set(min=-math.inf, max=math.inf)
        return partial(self._evaluated, params, [*expressions]) if expressions else None

    def _evaluated(self, params: lmfit.Parameters, tied: list[str], values: Array) -> Array:
        """Set the `tied` parameters by lmfit, whose `params` are overwritten."""
        if values.ndim > 1:
            return np.column_stack([self._evaluated(params, tied, one) for one in values.T])
        for name, place in self.index.items():
            if name not in tied:
                params[name].value = values[place]
        params.update_constraints()
        for name in tied:
            values[self.index[name]] = params[name].value
        return values

    def space(self, absolute: tuple[str, ...] = ()) -> Space:
        """Return the box of the search; the coordinates of some parameters may be their values."""
        params = [self.params[name] for name in self.names]
        low, high = np.array([(one.min, one.max) for one in params]).T.copy()
        own = self.model, self.names, self.scales, self.vector(), self.free()
        return Space(*own, low, high, self.tied, absolute)

    def sizes(self, names: tuple[str, ...], values: Array) -> Array:
        """Return the scales of some parameters at a point."""
        at = dict(zip(self.names, map(float, values), strict=True))
        return np.array([self.scales.of_parameter(self.model, name, at) for name in names])

    def slopes(self, values: Array, names: tuple[str, ...]) -> Array:
        """Return the derivative of the residual by some parameters, (n_data, n_names), SI.

        It is exact; see `Objective.jacobian`. Parameters that depend on these through expressions
        move with them.
        """
        return self.objective.jacobian_along(values, self.moves(values, names))

    def moves(self, values: Array, names: tuple[str, ...]) -> Array:
        """Return how all parameters move with each of these, (n_values, n_names)."""
        moves = np.eye(values.size)[:, [self.index[name] for name in names]]
        if self.tied is None or not names:
            return moves
        return follow(self.tied, values, moves, 1e-5 * self.sizes(names, values))


def _check_record(measurement: Measurement, model: Model) -> None:
    """Raise InputError if a record has no time that its law needs, or no loading."""
    wanting = ["relaxation"] if model.relaxation else []
    wanting += [f"the stress of '{law.kind}'" for law in model.laws if law.is_viscous]
    if measurement.time is None and wanting:
        end = "; give one, or leave relaxation out" if model.relaxation else ""
        raise InputError(f"{measurement.name}: {wanting[0]} needs a time column{end}")
    if (motion := measurement.displacement) is not None and motion.max() <= motion[0]:
        wrong = f"{measurement.name}: the displacement does not rise in the part that is used"
        raise InputError(f"{wrong}; choose a part with a loading by [window]")


def _put(
    wanted: lmfit.Parameters, params: lmfit.Parameters, where: str, model: str, drive: str
) -> None:
    """Put the user's parameters in place of the usual ones, whose limits stay where none is given.

    Raises InputError for a parameter that the model does not have or that this test cannot show.
    """
    for name in params:
        _check_known(f"parameter '{name}'", name, model, wanted)
    for name, one in copied(params).items():
        usual, wanted[name] = wanted[name], one
        if name in NUISANCE and one.vary and not math.isfinite(one.max - one.min):
            if not math.isfinite(usual.max - usual.min):
                raise InputError(
                    f"{where}'{name}' cannot vary, as the {drive} drive of this test has nothing "
                    "that would show it; leave it fixed"
                )
            ends = (one.min, usual.min), (one.max, usual.max)
            low, high = (own if math.isfinite(own) else other for own, other in ends)
            one.set(min=low, max=high)


def make_problem(
    measurement: Measurement,
    model_name: str,
    drive: str | None,
    params: lmfit.Parameters | None,
    weights: Mapping[str, float] | None,
    interior_mass: bool,
    *,
    time_shift: bool = False,
    relaxation: int = 0,
    priors: Mapping[str, object] | None = None,
) -> Problem:
    """Return the problem of a fit; `foamfit.fit` describes the arguments.

    Raises InputError if the test lacks data for the drive, or if a parameter is unknown.
    """
    model = Model.parse(model_name, relaxation)
    if drive is None:
        varied = [name for name, one in (params or {}).items() if one.vary]
        drive = curves.choose_drive(measurement, varied)
    count = len(model.kinds)
    curves.check_interior(measurement, count)
    notes: tuple[str, ...] = ()
    if interior_mass and (count == 1 or drive != "impact"):
        why = "a single spring has none" if count == 1 else f"none moves in the {drive} drive"
        notes = (f"Interior masses were asked for, but {why}; the fit is the same without them.",)
        interior_mass = False
    chosen = curves.default_weights(measurement, drive, count) if weights is None else dict(weights)
    time_shift = nuisance.is_late(measurement, time_shift=time_shift)
    for name in [name for name in priors or {} if name not in NUISANCE]:
        _check_known(f"priors: {name}", name, model.name, model.names)
    given = tuple(starmap(prior_of, (priors or {}).items()))
    objective = Objective(
        measurement, model, drive, chosen, interior_mass=interior_mass, time_shift=time_shift,
        given=given,
    )  # fmt: skip
    measurement = objective.measurement  # it has the noise of each channel
    wanted = make_params(measurement, model, drive, time_shift=time_shift)
    usual = wanted.valuesdict()
    if params is not None:
        _put(wanted, params, f"{measurement.name}: ", model.name, drive)
    _counted_from(wanted, measurement.origins, -1.0)
    check_admissible(wanted, usual)
    check_strain(wanted, measurement)
    for name in (one.name for one in objective.given):
        if not wanted[name].vary:
            why = f"follows from {wanted[name].expr}" if wanted[name].expr else "is held fixed"
            raise InputError(f"priors: {name} {why}; let it vary, or leave its prior out")
    if not any(parameter.vary for parameter in wanted.values()):
        raise InputError("no parameter varies; let at least one vary")
    return Problem(measurement, model, objective, wanted, Scales.of(measurement), notes)
