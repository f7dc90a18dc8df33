"""Runs of a System with a metric, which an engine computes for many lanes at once."""

import os
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from ..core.arrays import State
from ..core.rollout import SEGMENT, Metric
from ..core.system import System
from . import gpu_kernel, native_kernel
from .batch import Batch, Positions, batched, sizes_of
from .lane_values import LaneValues
from .metered_run import MeteredRun, separated
from .native_library import CompileError, compiler

Engine = Literal["loop", "native", "gpu", "interpreted"]
"""``loop`` is that of ``simulate``, ``native`` compiled C on a CPU, and ``gpu`` one
kernel of a GPU, which ``interpreted`` computes without one, slowly."""

KERNELS = {"native": native_kernel, "gpu": gpu_kernel, "interpreted": gpu_kernel}
"""Module of each engine with a kernel."""

VARIABLE = "PIEZOJAX_ENGINE"
"""Environment variable that names the engine to use."""

reverse_mode = jax.make_user_context(default_value=False)
"""Context ``with reverse_mode(True):`` of runs that are differentiated in reverse mode.

They use the loop of ``simulate`` then: its forward pass stores what the reverse pass
needs, and a kernel would be one run more."""


def default_engine() -> Engine:
    """Return the engine of ``VARIABLE``, by default the fastest of this machine.

    Raises ValueError for an unknown engine.
    """
    if name := os.environ.get(VARIABLE):
        for engine in get_args(Engine):
            if name == engine:
                return engine
        known = ", ".join(get_args(Engine))
        raise ValueError(f"{VARIABLE} is {name!r}; it must be one of {known}")
    backend = jax.default_backend()
    if backend == "cpu" and compiler():
        return "native"
    return "gpu" if backend == "gpu" else "loop"


def metered(
    system: System,
    inputs: Any,
    state: State,
    metric: Metric | None = None,
    *,
    log: Callable[[Any], Any] | None = None,
    every: int = 1,
    engine: Engine | None = None,
) -> tuple[Any, Any]:
    """Return the result of ``metric`` over a run, and a log of the outputs.

    The run is that of ``simulate`` with the same arguments. The log holds ``log`` of
    the last output of each whole block of ``every`` samples, stacked in time. Without
    ``metric`` or ``log``, None is returned in its place.

    Under ``jax.vmap``, all lanes run in one kernel of ``engine``, by default
    ``default_engine()``; so do derivatives in forward mode on a CPU. A step without a
    scalar form (see ``trace``), with a loop inside, with too many operations, or with
    an operation that the engine lacks runs in the loop of ``simulate``, with the same
    result. So do derivatives in reverse mode (see ``reverse_mode``).

    Raises ValueError as ``simulate`` does.
    """
    if engine is None:
        engine = "loop" if reverse_mode.value else default_engine()
    operands, run = separated(system, inputs, state, metric, log, every)
    if engine == "loop":
        return run.unpacked(*run.plain(SEGMENT, *operands))
    totals, rows = _metered.bind(
        *operands, run=run, positions=((),) * len(operands), active=(), engine=engine
    )
    return run.unpacked(totals, rows)


def _mapped(
    function: Callable[..., Any],
    operands: Sequence[Any],
    positions: Sequence[Positions],
) -> Any:
    """Return ``function`` of the operands of each lane."""
    sizes, left = sizes_of(operands, positions), [list(where) for where in positions]
    axes = []
    # The axis of a map is counted without those of the maps around it.
    for axis in range(len(sizes)):
        axes.append(tuple(where[axis] for where in left))
        for where, mapped in zip(left, axes[-1], strict=True):
            if mapped is not None:
                where[axis] = None
                where[:] = [p - 1 if p is not None and p > mapped else p for p in where]
    for in_axes, size in reversed(list(zip(axes, sizes, strict=True))):
        function = jax.vmap(function, in_axes=in_axes, axis_size=size)
    return function(*operands)


def _looped_slopes(
    operands: Sequence[Any],
    run: MeteredRun,
    positions: Sequence[Positions],
    active: Sequence[int],
) -> tuple[Array, Array]:
    """Return the derivatives of totals and log, computed in the loop of ``simulate``.

    The derivatives of the operands ``active`` follow the operands.
    """
    count = len(positions) - len(active)

    def slopes(*all_: Any) -> tuple[Array, Array]:
        values, directions = all_[:count], all_[count:]

        def of(*changed: Any) -> tuple[Array, Array]:
            new = dict(zip(active, changed, strict=True))
            return run.plain(SEGMENT, *(new.get(i, x) for i, x in enumerate(values)))

        return jax.jvp(of, tuple(values[i] for i in active), directions)[1]

    return _mapped(slopes, operands, positions)


def _evaluated(
    *operands: Any,
    run: MeteredRun,
    positions: Sequence[Positions],
    active: Sequence[int],
    engine: Engine,
) -> tuple[Array, Array]:
    """Return totals and log of all lanes, or derivatives if operands are ``active``."""
    try:
        found = _in_kernel(operands, run, positions, active, engine)
    except CompileError as error:
        warnings.warn(f"{error}; XLA runs the loops instead", stacklevel=2)
        found = None
    if found is not None:
        return found
    if active:
        return _looped_slopes(operands, run, positions, active)
    return _mapped(partial(run.plain, run.samples), operands, positions)


def _in_kernel(
    operands: Sequence[Any],
    run: MeteredRun,
    positions: Sequence[Positions],
    active: Sequence[int],
    engine: Engine,
) -> tuple[Array, Array] | None:
    """Return the results of the kernel of an engine, None if it cannot compute them."""
    if engine not in KERNELS:
        return None
    kernel, step = KERNELS[engine], run.step(active)
    count, first = sum(run.counts), sum(run.counts[:2])
    by_lane = any(p is not None for each in positions[first:count] for p in each)
    if step is None or not kernel.computes(step, by_lane):
        return None
    sizes = sizes_of(operands, positions)
    batch = Batch.sorted(sizes, positions[:count], positions[first:count])
    pairs = [*zip(operands, positions, strict=True)]
    grouped = [batch.grouped(x, where) for x, where in (*pairs[:first], *pairs[count:])]
    inputs = [batch.grouped(x, where, last=True) for x, where in pairs[first:count]]
    options = {"interpret": True} if engine == "interpreted" else {}
    found = kernel.results(
        step,
        LaneValues(step, run.leaves(grouped, active)),
        inputs,
        batch.counts,
        run.wanted(),
        run.every,
        **options,
    )
    totals, rows = (batch.restored(x) for x in found)
    return totals, rows


_metered = Primitive("metered_run")
_metered.multiple_results = True


@_metered.def_impl
def _called(*operands, **params):
    return jax.jit(partial(_evaluated, **params))(*operands)


@_metered.def_abstract_eval
def _abstract(*operands, run, positions, active, engine):
    sizes = sizes_of(operands, positions)
    totals, rows = run.sizes()
    types = [ShapedArray((*sizes, *shape), float) for shape in ((totals,), rows)]
    return types


def _batched(operands, axes, *, positions, **params):
    positions = tuple(map(batched, positions, axes))
    return _metered.bind(*operands, positions=positions, **params), [0, 0]


def _differentiated(operands, slopes, *, active, **params):
    if active:
        params |= {"engine": "loop"}
        slopes = tuple(ad.instantiate_zeros(slope) for slope in slopes)
        return jax.jvp(partial(_evaluated, active=active, **params), operands, slopes)
    values = _metered.bind(*operands, active=(), **params)
    active = tuple(i for i, slope in enumerate(slopes) if type(slope) is not ad.Zero)
    where = params.pop("positions")
    found = _metered.bind(
        *operands,
        *(slopes[i] for i in active),
        positions=(*where, *(where[i] for i in active)),
        active=active,
        **params,
    )
    return values, found


def _transposed(cotangents, *operands, run, positions, active, engine):
    count = len(positions) - len(active)
    values, slopes = operands[:count], operands[count:]
    cotangents = [ad.instantiate_zeros(each) for each in cotangents]

    def function(*slopes):
        return _looped_slopes((*values, *slopes), run, positions, active)

    zeros = [jnp.zeros(x.aval.shape, x.aval.dtype) for x in slopes]
    found = jax.vjp(function, *zeros)[1](tuple(cotangents))
    return [None] * count + list(found)


batching.primitive_batchers[_metered] = _batched
ad.primitive_jvps[_metered] = _differentiated
ad.primitive_transposes[_metered] = _transposed
mlir.register_lowering(_metered, mlir.lower_fun(_evaluated, multiple_results=True))
