"""The loop over time of many lanes as one kernel of a GPU.

XLA runs every step of a loop on a GPU as several kernels, which read the state of all
lanes from memory and write it back. Here a step is traced to scalar operations, and one
kernel runs all steps with the state of a lane in registers.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array

from ..core.arrays import State
from ..core.rollout import Metric, simulate
from ..core.system import System, resolve
from ..exporting.graph import CONSTANT, INPUT, Graph, Kind
from ..exporting.memory import NotScalarError
from ..exporting.trace import LONG, trace

WIDTH = 64
"""Lanes of a block of the kernel, one for each thread; a multiple of 32."""

MOST = 4000
"""Largest number of operations of a step; compilers take minutes for more."""

REGISTERS = 100
"""Largest number of values of a lane for which those that all lanes share stay in
registers; more are read from memory at each step. A thread has 255 registers of 32 bits
on the GPUs of 2026."""

TYPES: dict[Kind, Any] = {
    "real": jnp.float64,
    "integer": jnp.int32,
    "boolean": jnp.bool_,
}


def _larger(a: Array, b: Array) -> Array:
    """Return the larger of both, NaN if one is: the maximum of Triton drops NaN.

    A loop that diverges must not look finite behind a limit.
    """
    return jnp.where((a > b) | (a != a), a, b)


def _smaller(a: Array, b: Array) -> Array:
    """Return the smaller of both, NaN if one is."""
    return jnp.where((a < b) | (a != a), a, b)


def _rounded(x: Array, method: Any) -> Array:
    below = lax.floor(x)
    rest = x - below
    if method == lax.RoundingMethod.TO_NEAREST_EVEN:
        up = below != 2.0 * lax.floor(0.5 * below)
    else:
        up = x > 0.0
    return jnp.where((rest > 0.5) | ((rest == 0.5) & up), below + 1.0, below)


OPERATIONS: dict[str, Callable[..., Array]] = {
    **{
        name: getattr(lax, name)
        for name in (
            *("abs", "acos", "add", "asin", "atan", "atan2", "ceil", "cos", "cosh"),
            *("div", "eq", "exp", "expm1", "floor", "ge", "gt", "is_finite", "le"),
            *("log", "log1p", "logistic", "lt", "mul", "ne", "neg"),
            *("pow", "rem", "rsqrt", "sign", "sin", "sinh", "sqrt", "square", "sub"),
            *("tan", "tanh"),
        )
    },
    "and": lax.bitwise_and,
    "clamp": lambda least, x, most: _larger(least, _smaller(x, most)),
    "integer_pow": lax.integer_pow,
    "max": _larger,
    "min": _smaller,
    "not": lax.bitwise_not,
    "or": lax.bitwise_or,
    "round": _rounded,
    "select_n": lax.select_n,
    "xor": lax.bitwise_xor,
}
"""Operations of a kernel, by their name in a graph."""

CONVERT = "convert_element_type"


def simulate_lanes(
    run_of: Callable[[Any], tuple[System, State]],
    lanes: Any,
    inputs: Any,
    metric: Metric,
    *,
    fused: bool | None = None,
    interpret: bool = False,
) -> Any:
    """Return the result of ``metric`` for each lane, [lanes, ...].

    ``run_of`` returns the system and its first state for an element of ``lanes``, a
    pytree of arrays with the lanes as first axis. All lanes have the same ``inputs``.

    ``fused`` selects one kernel for all steps; by default it is used on a GPU. A step
    without a scalar form (see ``trace``), with a loop inside, or with more than
    ``MOST`` operations runs as in ``simulate``, with the same result. Not for
    derivatives. ``interpret`` computes the kernel without a GPU, slowly, for tests.
    """
    if fused is None:
        fused = jax.default_backend() == "gpu"
    samples = len(jax.tree.leaves(inputs)[0])

    def plain(system: System, state: State, inputs: Any) -> Any:
        return simulate(system, inputs, state, metric=metric, segment=samples)[1]

    def lane(values: Any) -> Any:
        system, state = run_of(values)
        run = resolve(system), state, inputs
        return _batched(plain, run, metric, interpret) if fused else plain(*run)

    return jax.vmap(lane)(lanes)


def _batched(plain: Callable, run: Any, metric: Metric, interpret: bool) -> Any:
    """Return ``plain(*run)``, which ``jax.vmap`` computes in one kernel if possible."""
    leaves, tree = jax.tree.flatten(run)

    @custom_vmap
    def flat(*leaves):
        return plain(*tree.unflatten(leaves))

    @flat.def_vmap
    def many(size, differs, *leaves):
        try:
            args = tree.unflatten(leaves), tree.unflatten(differs)
            result = _in_one_kernel(size, *args, metric, interpret)
        except NotScalarError:
            axes = [0 if each else None for each in differs]
            result = jax.vmap(flat.fun, in_axes=axes)(*leaves)
        return result, jax.tree.map(lambda _: True, result)

    return flat(*leaves)


class _Step(NamedTuple):
    """Scalar operations of a step.

    Its inputs by place are the elements of the system, those of state and metric, those
    of a row of inputs, and the index of the sample; ``ends`` are the first places after
    each. ``last`` are the nodes of state and metric after the step. The nodes of
    ``steady`` have the same value at each step. ``moving`` are the others.
    """

    graph: Graph
    last: list[int]
    ends: tuple[int, int, int]
    steady: list[int]
    moving: list[int]

    @property
    def used(self) -> list[int]:
        """The steady nodes that the moving ones and the results use, in order."""
        nodes = self.graph.nodes
        operands = {n for number in self.moving for n in nodes[number].operands}
        return [n for n in self.steady if n in operands or n in self.last]


def _traced(system: Any, carry: Any, row: Any, metric: Metric) -> _Step:
    """Return the step of a lane with arguments of these shapes.

    Raises NotScalarError for a step that a kernel cannot compute.
    """

    def step(system, carry, row, index):
        state, total = carry
        state, output = system.step(state, row)
        return state, metric.update(total, index, output)

    sizes = [
        [math.prod(leaf.shape) for leaf in jax.tree.leaves(part)]
        for part in (system, carry, row)
    ]
    if max(size for part in sizes for size in part) >= LONG:
        raise NotScalarError("it has a long array")
    ends = [sum(map(sum, sizes[: i + 1])) for i in range(3)]
    index = jax.ShapeDtypeStruct((), jnp.int32)
    with jax.ensure_compile_time_eval():
        graph, outputs = trace(step, system, carry, row, index)
    last = [int(number) for array in outputs for number in array.ravel()]
    needed = graph.needed(last)
    unknown = {graph.nodes[number].operation for number in needed}
    unknown -= {*OPERATIONS, CONVERT, CONSTANT, INPUT}
    if unknown or graph.loops or len(needed) > MOST:
        raise NotScalarError(f"a kernel has no {sorted(unknown)}")
    steady: dict[int, None] = {}  # in order
    moving: dict[int, None] = {}
    for number in graph.block.order:
        node = graph.nodes[number]
        if number not in needed or node.operation == CONSTANT:
            continue
        moves = any(each in moving for each in node.operands)
        if node.operation == INPUT:
            moves = node.value >= ends[0]
        (moving if moves else steady)[number] = None
    return _Step(graph, last, (ends[0], ends[1], ends[2]), [*steady], [*moving])


def _in_one_kernel(
    size: int, run: Any, differs: Any, metric: Metric, interpret: bool
) -> Any:
    """Return the results of the metric, [size, ...].

    ``run`` is (system, state, inputs); leaves that ``differs`` marks have the lanes as
    first axis. Raises NotScalarError for a step that a kernel cannot compute.
    """
    if any(jax.tree.leaves(differs[2])):
        raise NotScalarError("its lanes have different inputs")
    with jax.ensure_compile_time_eval():
        empty = jax.tree.map(jnp.asarray, metric.init())
    system, state = jax.tree.map(
        lambda x, d: jax.ShapeDtypeStruct(jnp.shape(x)[int(d) :], x.dtype),
        run[:2],
        differs[:2],
    )
    row = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), run[2])
    step = _traced(system, (state, empty), row, metric)

    table = _Table(size, *map(jax.tree.leaves, (run[0], differs[0])))
    shared, own = table.columns(step)
    moved = (run[1], empty), (differs[1], jax.tree.map(lambda _: False, empty))
    start = _Table(size, *map(jax.tree.leaves, moved)).whole()
    rows = [
        leaf.reshape(len(leaf), -1).astype(float) for leaf in jax.tree.leaves(run[2])
    ]
    end = _final(step, shared, own, start, jnp.concatenate(rows, axis=1), interpret)
    leaves, tree = jax.tree.flatten(empty)
    first, totals = end.shape[1] - sum(leaf.size for leaf in leaves), []
    for leaf in leaves:
        total = end[:, first : first + leaf.size].reshape(size, *leaf.shape)
        totals.append(total.astype(leaf.dtype))
        first += leaf.size
    return jax.vmap(metric.result)(tree.unflatten(totals))


class _Columns(NamedTuple):
    """Values of nodes, one in each column of an array [lanes, nodes] or [1, nodes]."""

    numbers: list[int]
    array: Array


class _Table:
    """Elements of leaves, by their place among the elements of all leaves."""

    def __init__(self, size: int, leaves: Sequence[Array], differs: Sequence[bool]):
        self.size = size
        self.where: list[tuple[bool, int]] = []
        parts: dict[bool, list[Array]] = {False: [jnp.zeros((1, 0))], True: []}
        parts[True].append(jnp.zeros((size, 0)))
        for leaf, d in zip(leaves, differs, strict=True):
            rows = jnp.reshape(leaf, (size if d else 1, -1)).astype(float)
            first = sum(part.shape[1] for part in parts[d])
            self.where += [(d, first + i) for i in range(rows.shape[1])]
            parts[d].append(rows)
        self.arrays = {d: jnp.concatenate(each, axis=1) for d, each in parts.items()}

    def given(self, place: int, kind: Kind) -> Array:
        """Return the element at a place, [lanes] or [1]."""
        differs, column = self.where[place]
        return _typed(self.arrays[differs][:, column], kind)

    def whole(self) -> Array:
        """Return all elements, [lanes, elements]."""
        every = jnp.concatenate(
            [
                jnp.broadcast_to(x, (self.size, x.shape[1]))
                for x in self.arrays.values()
            ],
            axis=1,
        )
        ends = {False: 0, True: self.arrays[False].shape[1]}
        return every[:, np.array([ends[d] + column for d, column in self.where], int)]

    def columns(self, step: _Step) -> tuple[_Columns, _Columns]:
        """Return the steady values that a loop uses: those shared, those of a lane."""
        nodes = step.graph.nodes
        values = _values(step.graph, step.steady, {}, self.given)
        differing: set[int] = set()
        for number in step.steady:
            node = nodes[number]
            if node.operation == INPUT:
                differs = self.where[node.value][0]
            else:
                differs = not differing.isdisjoint(node.operands)
            if differs:
                differing.add(number)
        found = []
        for d, array in self.arrays.items():
            mine = [n for n in step.used if (n in differing) == d]
            # The elements are read in one operation: thousands of small ones would
            # take the compiler minutes.
            plain = [n for n in mine if nodes[n].operation == INPUT]
            computed = [n for n in mine if nodes[n].operation != INPUT]
            places = [self.where[nodes[n].value][1] for n in plain]
            columns = [array[:, np.array(places, int)]]
            columns += [jnp.reshape(values[n], (len(array), 1)) for n in computed]
            columns = [each.astype(float) for each in columns]
            found.append(_Columns(plain + computed, jnp.concatenate(columns, axis=1)))
        return found[0], found[1]


def _final(
    step: _Step,
    shared: _Columns,
    own: _Columns,
    start: Array,
    rows: Array,
    interpret: bool,
) -> Array:
    """Return the elements of state and metric after all steps, [lanes, elements].

    ``shared`` and ``own`` are the values of steady nodes, ``start`` the elements before
    the first step, and ``rows`` the inputs [samples, elements].
    """
    from jax.experimental import pallas

    graph, (fixed, carried, read) = step.graph, step.ends
    lanes, count = start.shape
    samples, blocks = len(rows), -(-lanes // WIDTH)
    kinds: list[Kind] = [graph.nodes[number].kind for number in step.last]
    in_memory = len(shared.numbers) + len(own.numbers) + count > REGISTERS

    def kernel(shared_ref, own_ref, start_ref, rows_ref, end_ref):
        block = pallas.ds(pallas.program_id(0) * WIDTH, WIDTH)

        def of(columns: _Columns, ref: Any, at: Any) -> dict[int, Array]:
            return {
                number: _typed(ref[at(place)], graph.nodes[number].kind)
                for place, number in enumerate(columns.numbers)
            }

        before = of(own, own_ref, lambda place: (place, block))
        if not in_memory:
            before |= of(shared, shared_ref, lambda place: (0, place))

        def body(k, carry):
            known = dict(before)
            if in_memory:
                # Two equal rows: the compiler cannot move this in front of the loop.
                known |= of(shared, shared_ref, lambda place: (k & 1, place))

            def given(place: int, kind: Kind) -> Array:
                if place < carried:
                    return _typed(carry[place - fixed], kind)
                return _typed(
                    k if place == read else rows_ref[k, place - carried], kind
                )

            _values(graph, step.moving, known, given)
            after = [_value(graph, known, number) for number in step.last]
            return tuple(_plain(jnp.broadcast_to(x, WIDTH)) for x in after)

        first = [start_ref[place, block] for place in range(count)]
        typed = [_plain(_typed(x, kind)) for x, kind in zip(first, kinds, strict=True)]
        end = lax.fori_loop(0, samples, body, tuple(typed))
        for place, x in enumerate(end):
            end_ref[place, block] = x.astype(float)

    def padded(array: Array) -> Array:
        # Copies of the last lane fill the last block; a kernel reads no empty array.
        more = ((0, 0), (0, blocks * WIDTH - lanes))
        return jnp.pad(_filled(array).T, more, mode="edge")

    call = pallas.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct((count, blocks * WIDTH), float),
        grid=(blocks,),
        **_compiler(interpret),
    )
    twice = jnp.repeat(_filled(shared.array), 2, axis=0)
    return call(twice, padded(own.array), padded(start), rows)[:, :lanes].T


def _filled(array: Array) -> Array:
    return jnp.concatenate([array, jnp.zeros((len(array), 1))], axis=1)


def _compiler(interpret: bool) -> dict[str, Any]:
    if interpret:
        return {"interpret": True}
    from jax.experimental.pallas import triton

    parameters = triton.CompilerParams(num_warps=WIDTH // 32, num_stages=1)
    return {"compiler_params": parameters}


def _values(
    graph: Graph,
    numbers: Iterable[int],
    known: dict[int, Array],
    given: Callable[[int, Kind], Array],
) -> dict[int, Array]:
    """Add the values of nodes to ``known`` and return it; ``given`` returns inputs."""
    for number in numbers:
        node = graph.nodes[number]
        if node.operation == INPUT:
            known[number] = given(int(node.value), node.kind)
            continue
        operands = [_value(graph, known, each) for each in node.operands]
        shape = jnp.broadcast_shapes(*(x.shape for x in operands))
        operands = [jnp.broadcast_to(x, shape) for x in operands]
        if node.operation == CONVERT:
            known[number] = _typed(operands[0], node.kind)
        else:
            more = () if node.value is None else (node.value,)
            known[number] = OPERATIONS[node.operation](*operands, *more)
    return known


def _value(graph: Graph, known: dict[int, Array], number: int) -> Array:
    node = graph.nodes[number]
    if node.operation == CONSTANT:
        return jnp.asarray(node.value, TYPES[node.kind])
    return known[number]


def _typed(x: Array, kind: Kind) -> Array:
    if kind == "boolean":
        return x if x.dtype == bool else x != 0
    return x.astype(TYPES[kind])


def _plain(x: Array) -> Array:
    """Return ``x``, true and false as 1 and 0: a kernel carries numbers."""
    return x.astype(jnp.int32) if x.dtype == bool else x
