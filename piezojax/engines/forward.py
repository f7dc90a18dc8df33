"""Runs of many lanes as an operation of JAX, with derivatives in forward mode."""

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from . import gpu_kernel, native_kernel
from .batch import Batch, Positions, axes_with_lanes, batched, mapped, sizes_of
from .lane_values import LaneValues
from .metered_run import MeteredRun
from .native_library import CompileError
from .native_source import spreads

Engine = Literal["loop", "native", "gpu", "interpreted"]
"""``loop`` is the loop of ``simulate``, ``native`` compiled C on a CPU, and ``gpu`` one
kernel on a GPU. ``interpreted`` runs the same kernel without a GPU, slowly."""

KERNELS = {"native": native_kernel, "gpu": gpu_kernel, "interpreted": gpu_kernel}
"""Module with the kernel of each engine; ``loop`` has none."""


def lanes(operands: Sequence[Any], run: MeteredRun, engine: Engine) -> Sequence[Array]:
    """Return totals and log of a run, under ``jax.vmap`` in one kernel if possible."""
    positions = ((),) * len(operands)
    return _metered.bind(
        *operands, run=run, positions=positions, active=(), engine=engine
    )


def _looped_slopes(
    operands: Sequence[Any],
    run: MeteredRun,
    positions: Sequence[Positions],
    active: Sequence[int],
) -> tuple[Array, Array]:
    """Return the derivatives of totals and log, computed in the loop of ``simulate``.

    The tangents of the operands ``active`` follow the operands.
    """
    count = len(positions) - len(active)

    def slopes(*all_: Any) -> tuple[Array, Array]:
        values, directions = all_[:count], all_[count:]
        function = run.of_active(values, active)
        return jax.jvp(function, tuple(values[i] for i in active), directions)[1]

    return mapped(slopes, operands, positions)


def _evaluated(
    *operands: Any,
    run: MeteredRun,
    positions: Sequence[Positions],
    active: Sequence[int],
    engine: Engine,
) -> tuple[Array, Array]:
    """Return totals and log of all lanes; if operands are ``active``, derivatives."""
    try:
        found = _in_kernel(operands, run, positions, active, engine)
    except CompileError as error:
        warnings.warn(f"{error}; XLA runs the loops instead", stacklevel=2)
        found = None
    if found is not None:
        return found
    if active:
        return _looped_slopes(operands, run, positions, active)
    return mapped(partial(run.plain, run.samples), operands, positions)


def _in_kernel(
    operands: Sequence[Any],
    run: MeteredRun,
    positions: Sequence[Positions],
    active: Sequence[int],
    engine: Engine,
) -> tuple[Array, Array] | None:
    """Return the results of an engine's kernel, or None if it cannot compute them."""
    if engine not in KERNELS:
        return None
    kernel, step = KERNELS[engine], run.step(active)
    count, first = sum(run.counts), sum(run.counts[:2])
    sizes = sizes_of(operands, positions)
    by_lane = bool(axes_with_lanes(sizes, positions[first:count]))
    if step is None or not kernel.computes(step, by_lane):
        return None
    batch = Batch.sorted(sizes, positions[:count], positions[first:count])
    # Inputs by lane are copied for each direction: this takes the memory of a full log.
    if spreads(step, batch.counts) and (run.every == 1 or not by_lane):
        batch = batch.spread()
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
