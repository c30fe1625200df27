"""The contract of a law: compiled functions that the solvers call by their addresses.

The solvers are compiled once for all laws, and a law is compiled alone. A spring `s` is a block of
numbers: its memory, which only its law changes; its present values; the results of its law; and its
row, the constants that `fill` computes from its parameters. Most have names (`s.eps`, see
SPRING_FIELDS); internal variables x begin at s[X].

    fill(values, row) -> bool
        Write the row of the law's parameters; return false if they are not admissible.
    begin(row, s)
        Set the memory of a spring at rest.
    evaluate(row, s, eps, x, count, want, out)
        Fill, for `count` points on the present branch, the columns of `out` (columns, count):
        σ in OF_LAW, dσ/dε in SLOPE. With `want` also the derivatives of σ at fixed strain, by the
        two held numbers in BY_HELD and by parameter c in BY + c. x are internal variables. An
        INTERNAL law has results of its own, below.
    switch(row, s, up, out)
        Leave the branch at its upper (up = 1) or lower (0) end, or at a turning point, and enter
        the next. At an end, s.eps and x become those of the end. A BY_STRESS law fills `out`, for
        each held number, its derivatives by the stress, by both held numbers before, and by the
        parameters; an INTERNAL one, for each internal variable, its derivatives by ε, by all
        internal variables before, and by the parameters, and then those of the strain at the end (1
        and zeros at a turning point).
    settle(row, s, eps) -> 1 or 0
        Bring a spring to a strain on its branch: fill s.eps and x. 1: it has filled s.sigma and
        s.slope as well, so that `evaluate` is needed for derivatives only.
    strain(row, s, sigma) -> ε
        Return the strain at a stress on the branch, and its derivative in s.soft.

There are three kinds of law. Of an EXPLICIT one the stress is a function of the strain. A BY_STRESS
one gives the strain as a function of the stress, which is then its internal variable x; `evaluate`
takes x for the stress and fills ε(x) - ε in MISS. An INTERNAL one has internal variables x with

    dx/dt = A dε/dt + B,        σ = σ(ε, x) + V(ε, x, dε/dt);

`evaluate` fills them for one point, from BY on: σ, V, A and B, and their derivatives by ε; with
`want` = PATHS along A and along B, with `want` > 0 that of V by dε/dt. With `want` = DIRECTION it
fills `out` with the derivatives of σ, V, A and B at the present point, at fixed strain, by dx (`x`)
and, unless `count` is negative, by parameter `count`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from inspect import Parameter, Signature
from pathlib import Path
from typing import Any, NamedTuple

from llvmlite import ir
from numba import cfunc, njit, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.imputils import lower_setattr_generic
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model

HELD, OWN, MEMORY = 6, 8, 48  # memory: on two held numbers, then what the law keeps
X, MOST_INTERNAL = 64, 32  # internal variables
RELAX, MOST_TERMS = 96, 10  # g and τ of relaxation terms
RESULTS = 128  # of `evaluate`
OF_LAW, SLOPE, MISS, BY_HELD, BY = 0, 1, 2, 3, 5
# What a spring remembers: branch; strains and stresses at its ends; 1 (-1) if it ends where the
# strain stops rising (falling). Its present values: strain and its rate, stress T with relaxation
# but without dashpot, the part of dT/dt without dε/dt, strain and rate at the start of a step,
# height, dashpot, 1 + Σ g, 1/height, dε/dσ, dσ/dε along the path of the internal variables, Σ g z,
# dσ/dε of the derivatives, 1 if V depends on the strain rate, which `begin` sets. Then the first
# internal variable, the strain rate about the middle of a step, and the first results.
SPRING_FIELDS = (
    ("branch", "low", "high", "sigma_low", "sigma_high", "turns"),
    (
        "eps", "rate", "total", "drift", "old_eps", "old_rate", "height", "eta", "gain",
        "per_height", "soft", "tangent", "offset", "steep", "lossy",
    ),
    ("x",),
    ("midway",),
    ("sigma", "slope", "miss"),
)  # fmt: skip
_FIRST = (0, MEMORY, X, RELAX + 2 * MOST_TERMS, RESULTS)
EPS = MEMORY  # where the strain lies
OF_STRESS, OF_HELD, OF_PARAMETER = 0, 1, 3  # columns of the derivatives of `switch`
EXPLICIT, BY_STRESS, INTERNAL = range(3)

# Of an INTERNAL law: `want`. Its results, see `results_of`: rows of 2 + 2 x numbers; derivatives of
# `switch`; and for each direction of the solver its derivatives and dx.
PATHS, DIRECTION = 2, 3
BY_STRAIN, ALONG_A, ALONG_B, BY_RATE = range(1, 5)  # rows; the last has one number
STILL, FADES, FLOWS = range(3)  # internal variables and V: nothing, x decays, or anything else
PACKAGE = Path(__file__).parents[2]
FOLDERS = ("springs", "solve")  # subfolders with compiled functions
SOLVER = PACKAGE / "solve" / "compiled"


class _Part(JITCodeLibrary):  # type: ignore[misc]
    """Code that waits to be linked into that of its callers: as it was written, without address.

    By default numba optimises each function and makes machine code of it, and of all that it calls,
    before it does so again for the function that calls it. For functions that Python never calls
    that is wasted, and with it a third of the time of compilation.
    """

    @property
    def codegen(self) -> Any:
        """What gives a function its environment, which only Python would need: nothing here."""
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Give no environment."""

    def get_pointer_to_function(self, name: str) -> int:
        """Return no address."""
        self._ensure_finalized()
        return 0

    def _optimize_functions(self, module: object) -> None:
        pass

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class PartCompiler(Compiler):  # type: ignore[misc]
    """Compile functions of which no machine code is made but within others."""

    def define_pipelines(self) -> Any:
        """Return the usual passes, which add to code of the kind above."""
        state = self.state
        state.library = _Part(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


def drop_stale(own: Path) -> None:
    """Remove files older than the source from the cache `own` of the laws and from the solver's.

    Numba checks only the module of the outermost function, but the records and the inlined
    functions of other modules are compiled into it: with an old layout it would write past the end
    of an array.
    """
    times = [path.stat().st_mtime for name in FOLDERS for path in (PACKAGE / name).rglob("*.py")]
    written = max((at for at in times if at <= time.time()), default=0.0)  # a clock may be wrong
    solver = [SOLVER / own.name]
    if own.name != "__pycache__":  # the user has named a folder for all caches
        modules = {path.stem for path in SOLVER.glob("*.py")}
        known = own.parent.glob("compiled_*/*.nbi")
        solver = list({path.parent for path in known if path.name.partition(".")[0] in modules})
    for file in (path for cache in (own, *solver) for path in cache.glob("*.nb[ci]")):
        with suppress(OSError):  # no permission, or another process was faster
            if file.stat().st_mtime < written:
                file.unlink()


OPTIONS: dict[str, Any] = {
    "error_model": "numpy", "fastmath": {"contract"}, "no_rewrites": True,
}  # fmt: skip
_INSIDE: dict[str, Any] = {
    **OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": PartCompiler,
}  # fmt: skip
# Without reference counts, which take longer than the loops.
inner = njit(**_INSIDE, _nrt=False)
inlined = njit(**_INSIDE, _nrt=False, forceinline=True)
# Called from Python.
outer = njit(**OPTIONS, no_cfunc_wrapper=True, _nrt=False, cache=True)


@outer
def nothing() -> None:
    """Tell, compiled by numba, where the cache of the laws is."""


if (_stats := getattr(nothing, "stats", None)) is not None:  # None: numba is disabled
    drop_stale(Path(_stats.cache_path or "."))

REAL, WHOLE = types.float64, types.int64
REALS_AT, WHOLES_AT = types.CPointer(REAL), types.CPointer(WHOLE)
COMPLEXES_AT = types.CPointer(types.complex128)


@dataclass(frozen=True, eq=False)
class Pointed:
    """A function that others call by its address; it is compiled when this is first asked for."""

    signature: Any
    function: Callable[..., Any]

    @cached_property
    def compiled(self) -> Any:
        """The compiled function, from numba's cache if it is there."""
        return cfunc(self.signature, **OPTIONS, cache=True)(self.function)

    @property
    def address(self) -> int:
        """The address of the compiled function."""
        return int(self.compiled.address)


class Named(types.CPointer):  # type: ignore[misc]
    """A pointer to numbers some of which have a name: `s.eps` is `s[EPS]`.

    Those of `arrays` are pointers to the numbers from a place on: `s.g[k]` is `s[RELAX + k]`. Whole
    numbers may be addresses, `kinds` are then the types of the pointers: `c.springs`.
    """

    def __init__(
        self, name: str, kind: Any, places: Mapping[str, int],
        kinds: Mapping[str, Any] | None = None, **arrays: int,
    ) -> None:  # fmt: skip
        """Give the names of numbers, and of arrays, with their places."""
        super().__init__(kind)
        self.name, self.places = f"foamfit.{name}", {**places, **arrays}
        self.kinds, self.arrays = kinds or {}, frozenset(arrays)

    @property
    def key(self) -> str:
        """The name that distinguishes it from other types."""
        return self.name


register_model(Named)(models.PointerModel)


@infer_getattr
class _Names(AttributeTemplate):  # type: ignore[misc]
    """Types of the named numbers."""

    key = Named

    def generic_resolve(self, pointer: Any, name: str) -> Any:
        """Return the type of a named number or array, or None if the name is unknown."""
        if name in pointer.arrays:
            return types.CPointer(pointer.dtype)
        return pointer.kinds.get(name, pointer.dtype) if name in pointer.places else None


def _place(builder: Any, kind: Any, pointer: Any, name: str) -> Any:
    return builder.gep(pointer, [ir.Constant(ir.IntType(64), kind.places[name])])


@lower_getattr_generic(Named)
def load(context, builder, kind, pointer, name):
    """Load a named number or pointer."""
    place = _place(builder, kind, pointer, name)
    value = place if name in kind.arrays else builder.load(place)
    turned = name in kind.kinds
    return builder.inttoptr(value, context.get_value_type(kind.kinds[name])) if turned else value


@lower_setattr_generic(Named)
def _store(context, builder, signature, args, name):
    return builder.store(args[1], _place(builder, signature.args[0], args[0], name))


_PLACES = {
    name: first + k
    for first, names in zip(_FIRST, SPRING_FIELDS, strict=True)
    for k, name in enumerate(names)
}
SPRING = Named(
    "Spring", REAL, _PLACES, point=EPS, xs=X, g=RELAX, tau=RELAX + MOST_TERMS, results=RESULTS,
    by_held=RESULTS + BY_HELD, by=RESULTS + BY,
)  # fmt: skip


class Compiled(NamedTuple):
    """The compiled functions of a law."""

    fill: Any
    kind: int  #: EXPLICIT, BY_STRESS or INTERNAL
    columns: int  #: of a row
    derivatives: int  #: number of parameters, by which `evaluate` gives derivatives
    internal: int  #: number of internal variables
    functions: tuple[Any, ...]  #: begin, evaluate, switch, settle, strain
    #: columns of the row with slopes dσ/dε (Pa) of branches at zero stress, that at rest first
    slopes: tuple[int, ...] = ()
    pole: int = -1  #: column of the row with ε_*, if the strain stays below 1 + ε_*
    viscous: bool = False  #: whether V depends on the strain rate
    flows: int = 0  #: how the state changes within a branch: STILL, FADES or FLOWS

    @property
    def addresses(self) -> tuple[int, ...]:
        """The addresses of its functions, which are compiled if they have not been."""
        return tuple(one.address for one in self.functions)


EVALUATE = 1  #: place among the addresses


def results_of(parameters: int, internal: int, directions: int = 0) -> int:
    """Return the number of columns of `evaluate`, and of `switch` after them."""
    held = parameters + 2 * (OF_PARAMETER + parameters)
    rows = BY_RATE * (2 + 2 * internal) + 1 + (internal + 1) * (1 + internal + parameters)
    return BY + max(held, rows + directions * (2 + 3 * internal))


@inlined
def changes_of(values, x):
    """Return the derivatives of `switch` of an INTERNAL law, behind its values."""
    return past(values, BY_RATE * (2 + 2 * x) + 1)


@intrinsic
def start(typing, array):
    """Return the pointer to the first element of an array."""

    def emit(context, builder, signature, args):
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), emit


@intrinsic
def past(typing, pointer, count):
    """Return the pointer to the element number `count`."""

    def emit(context, builder, signature, args):
        return builder.gep(args[0], [args[1]])

    return types.CPointer(pointer.dtype)(pointer, WHOLE), emit


@intrinsic
def address(typing, pointer):
    """Return a pointer as an integer."""

    def emit(context, builder, signature, args):
        return builder.ptrtoint(args[0], ir.IntType(64))

    return WHOLE(pointer), emit


def pointing(kind: Any) -> Any:
    """Return a function that turns a pointer, or an address, into a pointer of this type."""

    @intrinsic
    def turn(typing, given):
        def emit(context, builder, signature, args):
            turned = builder.inttoptr if given == WHOLE else builder.bitcast
            return turned(args[0], context.get_value_type(kind))

        return kind(given), emit

    return turn


def naming(name: str, fields: Sequence[str]) -> Any:
    """Return a function that gives the numbers at a pointer these names, in this order."""
    return pointing(Named(name, REAL, {field: k for k, field in enumerate(fields)}))


complexes_at, as_spring = pointing(COMPLEXES_AT), pointing(SPRING)


def by_address(context, builder, signature, args):
    """Call the function at an address, the first argument, with the others."""
    returned = signature.return_type
    result = ir.VoidType() if returned == types.void else context.get_value_type(returned)
    kind = ir.FunctionType(result, [value.type for value in args[1:]])
    found = builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])
    return context.get_dummy_value() if returned == types.void else found


def emitted(signature: Any, emit: Callable[..., Any]) -> Any:
    """Return a function of this signature, for compiled functions, whose code `emit` builds."""

    def call(typing, *given):
        return signature, emit

    names = ("typing", *(f"given_{k}" for k in range(len(signature.args))))
    call.__signature__ = Signature(  # type: ignore[attr-defined]
        [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in names]
    )
    return intrinsic(call)


def pointed(returns: Any, *takes: Any) -> tuple[Callable[[Callable[..., Any]], Pointed], Any]:
    """Return a decorator for functions of this signature, and a call of the one at an address."""
    return partial(Pointed, returns(*takes)), emitted(returns(WHOLE, *takes), by_address)


evaluating, call_evaluate = pointed(
    REAL, REALS_AT, SPRING, REALS_AT, REALS_AT, WHOLE, WHOLE, REALS_AT
)
switching, call_switch = pointed(REAL, REALS_AT, SPRING, WHOLE, REALS_AT)
beginning, call_begin = pointed(REAL, REALS_AT, SPRING)
settling, call_number = pointed(REAL, REALS_AT, SPRING, REAL)  #: `settle` or `strain`
inverting = settling


@settling
def settle(row, s, eps):
    """Bring a spring to a strain, where nothing else depends on it."""
    s.eps = eps
    return 0.0
