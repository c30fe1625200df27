"""A run in memory: the one record that all compiled functions of the solver take.

`layout.lay_out` gives every array of a run its place, once per kind of scene. The record is a row
of integers: addresses of arrays and functions, then sizes. Compiled functions read it by name:
`c.springs` is a pointer, `c.count` a number, `spring(c, i).eps` the strain of a spring and
`c.now.step` the length of the step.

The state is one array. First come displacement w and velocity v of each node that has a state, then
of each spring its strain if it has a dashpot and other springs lie between the same nodes, its
relaxation terms z_k = q_k/g_k - σ with dz_k/dt = -(z_k + σ)/τ_k, and the internal variables of an
INTERNAL law. The derivatives by parameter of all these follow. The rest of the state follows from
them on a branch, but explicit steps integrate it as well, which costs less than to solve for it:
strains of springs without a dashpot, and the stress of BY_STRESS laws. Its derivatives are
computed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from numba import types

from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import REAL, REALS_AT, WHOLE, address, inner, past, start

# Top of the chain: with a mass, with an onsite damper only, under known stress, in known motion.
FREE, VISCOUS, STRESS, MOTION = range(4)
# Outcomes of a run.
DONE, TOO_MANY_STEPS, STEP_UNDERFLOW, FLAT_UNDER_STRESS, NOT_FINITE, TOO_FAST = range(6)
# Arrays of floats: numbers that change during a run; blocks of `width` numbers of the springs (see
# `compiled.contract`); area over mass of the nodes; the drive now; stress of each group;
# derivatives of the held numbers of each spring; of the stress of each spring at fixed strain, then
# of its T at fixed strain; of the stress of each group, then zeros and two rows to work with; of
# the strains; scales of the kinds of components; rates at the stages of a step; its dense output;
# the state, that at the end of a step, and one between with its rates; zeros; errors; samples that
# are computed together; what is set aside during a ramp, see `loop`. Those of implicit steps:
# Jacobian, n rows of 2 reach + 1; vibrations, see `rates.remember`; values of the derivatives over
# the scales; a copy of `springs` and `carried`; factored systems, complex, SYSTEMS of n rows of
# 3 reach + 1, and their right sides.
FLOATS = (
    "now", "springs", "per_mass", "drive", "carried", "held", "part", "common", "strain",
    "scales", "stage", "line", "y", "new", "state", "f", "nil", "errors", "batch", "aside",
    "jacobian", "alive", "largest", "kept", "systems", "right",
)  # fmt: skip
# Arrays of integers: rows of NUMBERS of the springs; first spring of each group, and their number;
# directions of the derivatives, (p, 2); of each spring and direction its second number if the first
# is that of the spring, else -1; as floats, derivatives of height and eta of each spring, and of
# drag; kinds of the components. Those of implicit steps: pivots, SYSTEMS of n; places of the
# components in the systems, and their groups.
INTEGERS = (
    "numbers", "first", "directions", "owned", "own", "kinds", "pivots", "places", "groups_of"
)  # fmt: skip
GIVEN = ("time", "values", "out", "log")  # arrays of the caller
ADDRESSES = (
    "rates_at", "group_at", "inside_at", "change_at", "step_at", "advance_at", "drive_at",
    "write_at", "fade_at", "short_at",
)  # fmt: skip
# Place of the row of a law in a block; width of a block; springs; groups; nodes
# with a state; derivatives; components of the state before the derivatives, if all are integrated,
# and those that have derivatives; relaxation terms; top, see above; whether the rest of the
# state is computed, not integrated; width of a row of stages; degree of the dense output if it is
# the polynomial of an implicit step, else 0; see `order`; samples; rows of `out`; rows of `log`;
# and 0, as a literal is of another type, for which functions would be compiled again.
SIZES = (
    "row", "width", "count", "groups", "nodes", "p", "base", "carries", "terms", "top",
    "solved", "wide", "degree", "reach", "samples", "shown", "room", "none",
)  # fmt: skip
FIELDS = (*FLOATS, *INTEGERS, *GIVEN, *ADDRESSES, *SIZES)
AT = {name: place for place, name in enumerate(FIELDS)}
WORDS = len(FIELDS)
TIME, VALUES, OUT, LOG = (AT[name] for name in GIVEN)
SAMPLES, SHOWN, ROOM = AT["samples"], AT["shown"], AT["room"]
_FLOATS_END, _INTEGERS_END = len(FLOATS), len(FLOATS) + len(INTEGERS)

# Integers of a spring: the addresses of its law, whether it is a BY_STRESS or an INTERNAL one,
# number of parameters and of internal variables; the places of strain, internal variables and
# relaxation terms in the state (-1: none); and whether the derivatives of its internal variables
# are those at a fixed strain, see `internal`.
NUMBERS = (
    "begin", "evaluate", "switch", "settle", "strain", "by_stress", "internal", "parameters",
    "internals", "eps_at", "x_at", "z_at", "fixed",
)  # fmt: skip
OF_SPRING = len(NUMBERS)
# Kinds of components of the state, which share a scale: displacement, velocity, strain, stress.
# Then follow the strain of each spring, displacement and velocity of each node, and each internal
# variable, which have scales of their own.
OF_W, OF_V, OF_EPS, OF_SIGMA, SCALES = range(5)
# The drive now: stress or displacement at the start of the piece and its rate; velocity of a
# viscous top; 1 if a stress acts on a flat branch; onsite damping of the top, Pa s/m; 0 if time
# stands still for the laws, else 1; acceleration of the striker by gravity; 1 if dashpots stop a
# striker long before the springs, see `rates.is_overdamped`; base stress at the start of an
# implicit step; derivative of the prescribed motion by its shift at the start of the piece, its
# rate, and its present value.
DRIVE = (
    "value", "value_rate", "top_speed", "flat", "dragged", "pace", "gravity", "overdamped",
    "beginning", "shift", "shift_rate", "shifted",
)  # fmt: skip
# Numbers that change during a run. First those that it returns: outcome, time of its end, steps,
# switches, whether all samples are finite, largest stress and displacement; of implicit steps, size
# of all vibrations that were damped out, and largest motion and stress of those that a sample
# lacks. Then time since the piece began, time at which it begins, step, length of the piece, growth
# of the next step, whether the base stress has risen, last error, next sample, number of the piece;
# of implicit steps: length of the one before, least length that the error can enforce, length of a
# short step, short steps in a row, size of the vibrations damped out in the last steps; steps
# without an attempt of `relaxing_step`; share of the step that the values belong to.
NOW = (
    "outcome", "ended", "taken", "logged", "finite", "largest", "farthest", "damped",
    "motion_lost", "stress_lost", "now", "begun", "step", "horizon", "grow", "pressed", "last",
    "sample", "piece", "before", "floor", "brief", "in_row", "damping", "paused", "seen",
)  # fmt: skip
OUTCOME, ENDED, SWITCHES, FINITE, TOLD = 0, 1, 3, 4, 10
BATCH = 64  # samples that are computed together
# Rows of the stages; the row with the rates at the end of a step; rows of the dense output.
STAGES, STEPPED, LINE = 16, 12, 7
POINTS, SYSTEMS = 5, 3  # of an implicit step; linear systems, one for a pair of eigenvalues


def _named(name: str, kind: Any, fields: tuple[str, ...]) -> Any:
    return contract.Named(name, kind, {field: k for k, field in enumerate(fields)})


_NUMBERS = _named("Numbers", WHOLE, NUMBERS)
_KINDS = {
    **dict.fromkeys((*FLOATS, *GIVEN), REALS_AT), **dict.fromkeys(INTEGERS, contract.WHOLES_AT),
    "springs": contract.SPRING, "numbers": _NUMBERS, "own": REALS_AT,
    "drive": _named("Drive", REAL, DRIVE),
    "now": _named("Now", REAL, NOW),
    **dict.fromkeys(("systems", "right"), contract.COMPLEXES_AT),
}  # fmt: skip
RECORD = contract.Named("Run", WHOLE, AT, _KINDS)
_as_numbers, _as_record = contract.pointing(_NUMBERS), contract.pointing(RECORD)


def _pointed(field: str, returns: Any, *takes: Any) -> tuple[Callable[..., contract.Pointed], Any]:
    """Return a decorator for functions with their address in a field, and what calls them."""
    signature = returns(RECORD, *takes)

    def emit(context, builder, given, args):
        where = contract.load(context, builder, RECORD, args[0], field)
        return contract.by_address(context, builder, given, [where, *args])

    return partial(contract.Pointed, signature), contract.emitted(signature, emit)


# After the record they take:
# state, rates, whether with derivatives, time since the piece began, group or ALL, see `motion`
computing, call_rates = _pointed("rates_at", types.void, REALS_AT, REALS_AT, WHOLE, REAL, WHOLE)
# group, state, rates, whether with derivatives, time since the piece began; returns S
grouping, call_group = _pointed("group_at", REAL, WHOLE, REALS_AT, REALS_AT, WHOLE, REAL)
# task (see `internal`), spring, up or whether with derivatives, state, rates, derivatives
# of the strain rate, results
working, call_inside = _pointed(
    "inside_at", types.void, WHOLE, WHOLE, WHOLE, REALS_AT, REALS_AT, REALS_AT, REALS_AT
)
# spring, whether it leaves its branch at the upper end, state
entering, change_branch = _pointed("change_at", types.void, WHOLE, WHOLE, REALS_AT)
# whether with derivatives, tolerance, time of the next sample, bound on steps; returns how it ended
stepping, call_step = _pointed("step_at", WHOLE, WHOLE, REAL, REAL, REAL)
# how the step ended, whether a striker is in contact, whether with derivatives; returns the event
advancing, call_advance = _pointed("advance_at", WHOLE, WHOLE, WHOLE, WHOLE)
# whether a drive begins, whether with derivatives; returns whether all samples are written
driving, call_drive = _pointed("drive_at", WHOLE, WHOLE, WHOLE)
# state, time since the piece began, sample or task (see `samples`), whether with derivatives
sampling, write = _pointed("write_at", types.void, REALS_AT, REAL, WHOLE, WHOLE)
# strain, time until then, tolerance, derivatives by a shift of the motion, results
fading, call_fade = _pointed("fade_at", WHOLE, REAL, REAL, REAL, REALS_AT, REALS_AT)
# whether with derivatives, tolerance; returns 1 if the step was taken
shortening, call_short = _pointed("short_at", WHOLE, WHOLE, REAL)


@contract.inlined
def spring(c, i):
    """Return the block of a spring."""
    return contract.as_spring(past(c.springs, i * c.width))


@contract.inlined
def numbers(c, i):
    """Return the integers of a spring."""
    return _as_numbers(past(c.numbers, i * OF_SPRING))


@inner
def sum_gain(c, i):
    """Fill the gain 1 + Σ g of a spring."""
    s = spring(c, i)
    s.gain = 1.0
    for k in range(c.terms):
        s.gain += s.g[k]


@inner
def begin_run(ints, floats, time, values, out, log, rows, heights, mass, reals):
    """Fill the record of a run, set all springs at rest, and return the record.

    `ints` are places instead of addresses, `floats` zeros. reals[0] is the onsite damping, reals[1]
    the pace of time.
    """
    words = start(ints)
    for k in range(_INTEGERS_END):
        first = address(start(floats)) if k < _FLOATS_END else address(words)
        words[k] = first + 8 * words[k]
    words[TIME], words[VALUES] = (address(start(time)), address(start(values)))
    words[OUT], words[LOG] = (address(start(out)), address(start(log)))
    words[SAMPLES], words[SHOWN], words[ROOM] = time.size, out.shape[1], log.shape[0]
    c = _as_record(words)
    width, own = rows.shape[1], rows.shape[1] - (c.width - c.row)  # first column of the laws
    given, tall, heavy, settings = (start(rows), start(heights), start(mass), start(reals))
    for i in range(c.count):
        s, n, height = spring(c, i), numbers(c, i), tall[i]
        s.height, s.per_height = height, 1.0 / height
        s.eta = given[0]
        for k in range(c.terms):
            s.g[k], s.tau[k] = given[1 + 2 * k], given[2 + 2 * k]
        sum_gain(c, i)
        row = past(s, c.row)
        for k in range(own, width):
            row[k - own] = given[k]
        contract.call_begin(n.begin, row, s)
        given = past(given, width)
    for g in range(c.groups):
        c.per_mass[g] = 1.0 / heavy[g]
    c.drive.dragged, c.drive.pace = settings[0], settings[1]
    return c
