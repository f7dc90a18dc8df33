"""Derivatives in reverse mode of runs of many lanes in compiled C."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.custom_derivatives import CustomVJPPrimal, SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from ..core.arrays import State
from ..core.rollout import Metric
from ..core.system import System
from . import native_kernel
from .batch import Batch, Positions, batched, mapped, sizes_of
from .forward import lanes
from .lane_values import LaneValues
from .metered_run import MeteredRun, WithMetric, separated
from .native_library import CompileError
from .scalar_step import Place, ScalarStep, is_real

LEAST = 128
"""Smallest number of samples between stored carries: each copy takes time."""


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def reversible(run: MeteredRun, operands: Sequence[ArrayLike]) -> Sequence[Array]:
    """Return totals and log of a run, with derivatives in reverse mode.

    The run stores its carry before each segment of samples. The reverse pass runs each
    segment forward again, then back. Memory grows with the square root of the number of
    samples.
    """
    return lanes(operands, run, "native")


def _forward(
    run: MeteredRun, primals: Sequence[CustomVJPPrimal]
) -> tuple[Sequence[Array], Partial]:
    """Return the results, and the reverse pass."""
    operands = [each.value for each in primals]
    active = tuple(
        i for i, x in enumerate(primals) if x.perturbed and is_real(operands[i])
    )
    step = run.adjoint(active) if active else None
    if step is None or not native_kernel.computes(step, by_lane=True):
        function = run.of_active(operands, active)
        found, reverse = jax.vjp(function, *(operands[i] for i in active))
        return found, Partial(partial(_of_loop, active), reverse)
    segment = max(LEAST, math.isqrt(run.samples))
    adjoint = Adjoint(run, step, active, segment)
    stored = _with_carry(adjoint, operands)
    found, carries = lanes(*stored, "native")
    if run.every:
        found, rows = lanes(operands, run, "native")
    else:
        rows = jnp.zeros(run.sizes()[1])
    _, state, _ = run.whole(operands)
    first = _elements((state, run.empty), adjoint.carried)
    starts = jnp.concatenate([first[None], carries])[: adjoint.segments]
    return [found, rows], Partial(partial(_of_kernel, adjoint), operands, starts)


def _backward(run: MeteredRun, reverse: Partial, slopes: Sequence[Any]) -> Any:
    whole = [jnp.zeros(x.shape) if isinstance(x, SymbolicZero) else x for x in slopes]
    found = reverse(whole)
    return ([found.get(i) for i in range(sum(run.counts))],)


reversible.defvjp(_forward, _backward, symbolic_zeros=True)


@dataclass(frozen=True, eq=False)
class Adjoint:
    """The reverse pass of a run.

    ``step`` is its step, with derivatives for the operands ``active``; the carry is
    stored every ``segment`` samples.
    """

    run: MeteredRun
    step: ScalarStep
    active: tuple[int, ...]
    segment: int

    @property
    def segments(self) -> int:
        """Number of segments of the run."""
        return -(-self.run.samples // self.segment)

    @property
    def carried(self) -> tuple[tuple[int, int], ...]:
        """The stored elements (leaf, element) of the carry."""
        return tuple((x.place.leaf, x.place.element) for x in self.step.carried)

    @property
    def sizes(self) -> list[int]:
        """Number of elements of each active operand."""
        return [math.prod(self.run.shapes[i].shape) for i in self.active]

    def wanted(self) -> list[Place]:
        """Return the places of the derivatives of the active operands."""
        names = {"system": "total", "carry": "carry"}
        return [
            Place(names[part], leaf, element, tangent=True)
            for (part, leaf), size in zip(
                map(self.run.place, self.active), self.sizes, strict=True
            )
            for element in range(size)
        ]


class _WithCarry(System):
    """A system that returns elements ``chosen`` of its carry beside its output."""

    system: WithMetric
    chosen: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def init(self, input: Any = 0.0) -> State:
        return self.system.init(input)

    def step(self, state: State, input: Any) -> tuple[State, Any]:
        state, output = self.system.step(state, input)
        return state, (output, _elements(state[:2], self.chosen))


class _OfOutput(Metric):
    """A metric of the output of ``_WithCarry``."""

    metric: Metric

    def init(self) -> State:
        return self.metric.init()

    def update(self, total: State, index: Array, output: Any) -> State:
        return self.metric.update(total, index, output[0])

    def result(self, total: State) -> Any:
        return self.metric.result(total)


def _elements(carry: Any, chosen: Sequence[tuple[int, int]]) -> Array:
    """Return elements (leaf, element) of a carry, as real numbers."""
    leaves = [jnp.ravel(jnp.asarray(leaf)) for leaf in jax.tree.leaves(carry)]
    found = [leaves[leaf][element].astype(float) for leaf, element in chosen]
    return jnp.stack(found) if found else jnp.zeros(0)


def _with_carry(
    adjoint: Adjoint, operands: Sequence[ArrayLike]
) -> tuple[list[Array], MeteredRun]:
    """Return the operands of a run that also stores its carries, and that run."""
    run = adjoint.run
    system, state, inputs = run.whole(operands)
    storing = _WithCarry(WithMetric(system, run.metric), adjoint.carried)
    carry = state, run.empty, jnp.zeros((), jnp.int32)
    every = min(adjoint.segment, run.samples)
    metric = _OfOutput(run.metric)
    return separated(storing, inputs, carry, metric, lambda both: both[1], every)


def _of_loop(active: Sequence[int], reverse: Any, slopes: Any) -> dict[int, Array]:
    return dict(zip(active, reverse(tuple(slopes)), strict=True))


def _of_kernel(
    adjoint: Adjoint, operands: Sequence[ArrayLike], starts: Array, slopes: Any
) -> dict[int, Array]:
    run = adjoint.run
    totals, rows = slopes
    if not run.every:
        rows = jnp.zeros((run.samples, 0))
    every = *operands, rows, starts, totals
    flat = _adjoint.bind(*every, adjoint=adjoint, positions=((),) * len(every))[0]
    found, first = {}, 0
    for i, size in zip(adjoint.active, adjoint.sizes, strict=True):
        found[i] = flat[first : first + size].reshape(jnp.shape(operands[i]))
        first += size
    return found


def _evaluated(
    *operands: Any, adjoint: Adjoint, positions: Sequence[Positions]
) -> list[Array]:
    """Return the derivatives of all lanes with respect to the active operands."""
    try:
        return [_in_kernel(operands, adjoint, positions)]
    except CompileError as error:
        warnings.warn(f"{error}; XLA runs the loops instead", stacklevel=2)

    def lane(*operands):
        *values, rows, _, totals = operands
        if not adjoint.run.every:
            rows = jnp.zeros(adjoint.run.sizes()[1])
        function = adjoint.run.of_active(values, adjoint.active)
        reverse = jax.vjp(function, *(values[i] for i in adjoint.active))[1]
        found = reverse((totals, rows))
        return jnp.concatenate([jnp.ravel(x) for x in found])

    return [mapped(lane, operands, positions)]


def _in_kernel(
    operands: Sequence[Any], adjoint: Adjoint, positions: Sequence[Positions]
) -> Array:
    run, step = adjoint.run, adjoint.step
    first, rows = sum(run.counts[:2]), sum(run.counts) + 1
    batch = Batch.sorted(
        sizes_of(operands, positions), positions, positions[first:rows]
    )
    pairs = [*zip(operands, positions, strict=True)]
    grouped = [batch.grouped(x, where) for x, where in (*pairs[:first], *pairs[rows:])]
    inputs = [batch.grouped(x, where, last=True) for x, where in pairs[first:rows]]
    *values, starts, totals = grouped
    found = native_kernel.reversed_results(
        step,
        LaneValues(step, run.leaves(values, ())),
        inputs,
        batch.counts,
        adjoint.segment,
        starts,
        totals,
        [Place("carry", *each, tangent=True) for each in run.wanted()],
        adjoint.wanted(),
    )
    return batch.restored(found)


_adjoint = Primitive("metered_run_reversed")
_adjoint.multiple_results = True


@_adjoint.def_impl
def _called(*operands, **params):
    return jax.jit(partial(_evaluated, **params))(*operands)


@_adjoint.def_abstract_eval
def _abstract(*operands, adjoint, positions):
    sizes = sizes_of(operands, positions)
    return [ShapedArray((*sizes, sum(adjoint.sizes)), float)]


def _batched(operands, axes, *, positions, **params):
    positions = tuple(map(batched, positions, axes))
    return _adjoint.bind(*operands, positions=positions, **params), [0]


batching.primitive_batchers[_adjoint] = _batched
mlir.register_lowering(_adjoint, mlir.lower_fun(_evaluated, multiple_results=True))
