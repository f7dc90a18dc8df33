"""A run of a System with a metric, without its arrays."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.arrays import State
from ..core.rollout import SEGMENT, Metric, samples_of, simulate
from ..core.system import System, resolve
from ..scalar.memory import NotScalarError
from .adjoint_step import adjoint_step
from .scalar_step import ScalarStep, scalar_step


class _Totals(Metric):
    """A metric whose result is the ``chosen`` leaves of the totals, in one array."""

    metric: Metric
    chosen: tuple[int, ...] = eqx.field(static=True)

    def init(self) -> State:
        return self.metric.init()

    def update(self, total: State, index: Array, output: Any) -> State:
        return self.metric.update(total, index, output)

    def result(self, total: State) -> Array:
        leaves = [jnp.ravel(leaf).astype(float) for leaf in jax.tree.leaves(total)]
        return jnp.concatenate([jnp.zeros(0), *(leaves[i] for i in self.chosen)])


class _Nothing(Metric):
    """The metric of a run that only logs; its result is None."""

    def init(self) -> State:
        return ()

    def update(self, total: State, index: Array, output: Any) -> State:
        return total

    def result(self, total: State) -> None:
        return None


class WithMetric(System):
    """A system that also accumulates a metric: one run gives outputs and metric."""

    system: System
    metric: Metric

    def init(self, input: Any = 0.0) -> State:
        return self.system.init(input), self.metric.init(), jnp.zeros((), jnp.int32)

    def step(self, state: State, input: Any) -> tuple[State, Any]:
        inner, total, index = state
        inner, output = self.system.step(inner, input)
        return (inner, self.metric.update(total, index, output), index + 1), output


class MeteredRun:
    """A run of a System with a metric, without its operands.

    The operands are the arrays of system, state and inputs, in this order. ``rest`` is
    the system without its arrays, ``trees`` are the structures of the three, and
    ``leaves`` the operands of each. The log holds ``log`` of every ``every``-th output.

    Attributes: ``counts``, the number of operands of each of the three; ``samples``;
    ``empty``, the totals of the metric before the run; ``chosen``, the leaves of the
    totals on which the result of the metric depends; ``logged``, the shapes of a row of
    the log.
    """

    def __init__(
        self,
        rest: System,
        trees: Sequence[Any],
        leaves: Sequence[Sequence[Array]],
        metric: Metric,
        log: Callable[[Any], Any] | None,
        every: int,
    ):
        self.rest, self.trees = rest, trees
        self.metric, self.log = metric, log
        self.every = 0 if log is None else every
        self.counts = [len(each) for each in leaves]
        self.samples = leaves[2][0].shape[0]
        self.shapes = [
            jax.ShapeDtypeStruct(x.shape, x.dtype) for each in leaves for x in each
        ]
        with jax.ensure_compile_time_eval():
            self.empty = jax.tree.map(jnp.asarray, metric.init())
        self.chosen = _read_by(metric.result, self.empty)
        self.logged: Any = jax.eval_shape(self._first_row, *self.shapes)
        self._steps: dict[tuple, ScalarStep | None] = {}

    def _first_row(self, *operands: Any) -> Any:
        system, state, inputs = self.whole(operands)
        row = jax.tree.map(lambda x: x[0], inputs)
        return None if self.log is None else self.log(system.step(state, row)[1])

    def parts(self, operands: Sequence[Any]) -> list[list[Any]]:
        """Return the operands of system, state and inputs."""
        rest = iter(operands)
        return [[next(rest) for _ in range(count)] for count in self.counts]

    def whole(self, operands: Sequence[Any]) -> tuple[System, State, Any]:
        """Return system, state and inputs."""
        pairs = zip(self.trees, self.parts(operands), strict=True)
        arrays, state, inputs = (jax.tree.unflatten(*pair) for pair in pairs)
        return eqx.combine(arrays, self.rest), state, inputs

    def sizes(self) -> tuple[int, tuple[int, int]]:
        """Return the number of totals, and the rows and columns of the log."""
        leaves = jax.tree.leaves(self.empty)
        outputs = sum(math.prod(x.shape) for x in jax.tree.leaves(self.logged))
        rows = self.samples // self.every if self.every else 0
        return sum(leaves[i].size for i in self.chosen), (rows, outputs)

    def unpacked(self, totals: Array, rows: Array) -> tuple[Any, Any]:
        """Return the result of the metric and the log from ``totals`` and ``rows``."""
        leaves, tree = jax.tree.flatten(self.empty)
        first = 0
        for i in self.chosen:
            found = totals[first : first + leaves[i].size]
            first += leaves[i].size
            leaves[i] = found.reshape(leaves[i].shape).astype(leaves[i].dtype)
        result = self.metric.result(jax.tree.unflatten(tree, leaves))
        if self.log is None:
            return result, None
        shapes, tree = jax.tree.flatten(self.logged)
        ends = np.cumsum([math.prod(x.shape) for x in shapes])[:-1]
        columns = jnp.split(rows, ends, axis=1)
        log = [
            column.reshape(len(rows), *x.shape).astype(x.dtype)
            for column, x in zip(columns, shapes, strict=True)
        ]
        return result, jax.tree.unflatten(tree, log)

    def plain(self, segment: int, *operands: Any) -> tuple[Array, Array]:
        """Return totals and log as arrays, computed in the loop of ``simulate``."""
        system, state, inputs = self.whole(operands)
        metric = _Totals(self.metric, self.chosen)
        if self.every == 0:
            found = simulate(system, inputs, state, metric=metric, segment=segment)[1]
            return found, jnp.zeros(self.sizes()[1])
        if self.every == 1:
            both = WithMetric(system, metric)
            start = state, metric.init(), jnp.zeros((), jnp.int32)
            (_, total, _), outputs = simulate(both, inputs, start)
            totals = metric.result(total)
        else:
            options: dict[str, Any] = {"metric": metric, "every": self.every}
            totals, outputs = simulate(system, inputs, state, **options)[1]
        assert self.log is not None
        leaves = jax.tree.leaves(jax.vmap(self.log)(outputs))
        columns = [x.reshape(len(x), -1).astype(float) for x in leaves]
        rows = jnp.concatenate([jnp.zeros((len(columns[0]), 0)), *columns], axis=1)
        return totals, rows[: self.samples // self.every]

    def of_active(
        self, operands: Sequence[Any], active: Sequence[int]
    ) -> Callable[..., tuple[Array, Array]]:
        """Return ``plain`` as a function of the operands ``active``."""

        def function(*changed: Any) -> tuple[Array, Array]:
            new = dict(zip(active, changed, strict=True))
            return self.plain(SEGMENT, *(new.get(i, x) for i, x in enumerate(operands)))

        return function

    def step(self, active: Sequence[int] = ()) -> ScalarStep | None:
        """Return the scalar step with derivatives for the operands ``active``, or None.

        It is None if the step has no scalar form, if an input is active, or if all
        derivatives vanish.
        """
        return self._found("step", active)

    def adjoint(self, active: Sequence[int]) -> ScalarStep | None:
        """Return the step of the reverse pass for the operands ``active``, or None.

        It is None in the cases of ``step``, if JAX has no reverse pass for the step, or
        if the log skips outputs.
        """
        return None if self.every > 1 else self._found("adjoint", active)

    def _found(self, kind: str, active: Sequence[int]) -> ScalarStep | None:
        key = kind, *active
        if key not in self._steps:
            try:
                self._steps[key] = self._scalar_step(kind, active)
            except NotScalarError:
                self._steps[key] = None
        return self._steps[key]

    def _scalar_step(self, kind: str, active: Sequence[int]) -> ScalarStep:
        systems, states, inputs = self.parts(self.shapes)
        rows = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in inputs]
        totals = jax.tree.leaves(self.empty)

        def step(system, carry, row, index):
            state, total = carry[: len(states)], carry[len(states) :]
            of, state, row = self.whole([*system, *state, *row])
            total = jax.tree.unflatten(jax.tree.structure(self.empty), total)
            state, output = of.step(state, row)
            total = self.metric.update(total, index, output)
            logged = () if self.log is None else self.log(output)
            return [*jax.tree.leaves((state, total)), *jax.tree.leaves(logged)]

        if any(self.place(i)[0] == "row" for i in active):
            raise NotScalarError("its inputs have derivatives")
        parts, wanted = (systems, [*states, *totals], rows), self.wanted()
        places = [self.place(i) for i in active]
        if kind == "adjoint":
            found = adjoint_step(step, parts, wanted, places, self.sizes()[1][1])
        else:
            found = scalar_step(step, parts, wanted, places)
        if active and not found.slopes:
            raise NotScalarError("its derivatives vanish")
        return found

    def place(self, operand: int) -> tuple[str, int]:
        """Return the part of the step, and the leaf, of an operand."""
        for part, count in zip(("system", "carry"), self.counts, strict=False):
            if operand < count:
                return part, operand
            operand -= count
        return "row", operand

    def wanted(self) -> list[tuple[int, int]]:
        """Return the elements of the carry that the result of the metric needs."""
        leaves = jax.tree.leaves(self.empty)
        return [
            (self.counts[1] + i, element)
            for i in self.chosen
            for element in range(leaves[i].size)
        ]

    def leaves(
        self, grouped: Sequence[Array], active: Sequence[int]
    ) -> dict[tuple[str, int, bool], Array]:
        """Return the leaves of system and carry for ``LaneValues``.

        ``grouped`` are the operands of system and state with the three axes of
        ``Batch``, followed by the tangents of the operands ``active``. The tangents of
        the rest of the carry are 0.
        """
        count = sum(self.counts[:2])
        leaves = {(*self.place(i), False): x for i, x in enumerate(grouped[:count])}
        for i, total in enumerate(jax.tree.leaves(self.empty), self.counts[1]):
            leaves["carry", i, False] = total[None, None, None]
        if active:
            carry = [key[1] for key in leaves if key[0] == "carry"]
            for i in carry:
                zero = jnp.zeros((1, 1, 1, *leaves["carry", i, False].shape[3:]))
                leaves["carry", i, True] = zero
            slopes = zip(active, grouped[count:], strict=True)
            leaves |= {(*self.place(i), True): x for i, x in slopes}
        return leaves


def separated(
    system: System,
    inputs: Any,
    state: State,
    metric: Metric | None,
    log: Callable[[Any], Any] | None,
    every: int,
) -> tuple[list[Array], MeteredRun]:
    """Return the operands of a run, and the run without them."""
    samples_of(inputs, every)
    arrays, rest = eqx.partition(resolve(system), eqx.is_array)
    parts = [jax.tree.flatten(part) for part in (arrays, state, inputs)]
    leaves = [[jnp.asarray(leaf) for leaf in each] for each, _ in parts]
    trees = [tree for _, tree in parts]
    run = MeteredRun(rest, trees, leaves, metric or _Nothing(), log, every)
    return [leaf for each in leaves for leaf in each], run


def _read_by(result: Callable[[Any], Any], total: Any) -> tuple[int, ...]:
    """Return the leaves of ``total`` on which ``result`` depends."""
    jaxpr = jax.make_jaxpr(result)(total).jaxpr
    read = {id(atom) for atom in jaxpr.outvars}
    for equation in reversed(jaxpr.eqns):
        if any(id(variable) in read for variable in equation.outvars):
            read.update(id(atom) for atom in equation.invars)
    return tuple(i for i, variable in enumerate(jaxpr.invars) if id(variable) in read)
