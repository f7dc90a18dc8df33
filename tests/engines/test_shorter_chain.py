"""Sums in another order: the same results after a shorter chain of operations."""

import operator

import jax
import jax.numpy as jnp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezojax.catalog import p753
from piezojax.core.feedback import LoopInput
from piezojax.engines.native_source import waits
from piezojax.engines.scalar_step import scalar_step
from piezojax.engines.shorter_chain import Chain, shortened
from piezojax.scalar.graph import CONSTANT, INPUT

NUMBER = jax.ShapeDtypeStruct((), float)
PYTHON = {
    "abs": abs,
    "add": operator.add,
    "div": operator.truediv,
    "max": max,
    "mul": operator.mul,
    "neg": operator.neg,
    "sub": operator.sub,
}
JAX = PYTHON | {"max": jnp.maximum}
STATES, STEADY = 3, 2

numbers = st.sampled_from([-3.0, -1.0, 0.0, 1.0, 2.0])
powers = st.sampled_from([-2.0, 0.5, 1.0, 4.0])
"""Numbers whose sums, products and quotients are exact, in any order."""


@st.composite
def programs(draw):
    """Draw operations (name, operands); the last results are the new states."""
    found = []
    for known in range(
        STATES + STEADY + 1, STATES + STEADY + 1 + draw(st.integers(4, 14))
    ):
        name = draw(st.sampled_from([*PYTHON]))
        operands = [draw(st.integers(0, known - 1))]
        if name not in ("abs", "neg"):
            steady = name in ("mul", "div")
            operands.append(draw(st.integers(0, STEADY - 1 if steady else known - 1)))
        found.append((name, operands))
    return found


def computed(program, functions, system, carry, row):
    values = [*system, *carry, *row]
    for name, operands in program:
        values.append(functions[name](*(values[i] for i in operands)))
    return values[-STATES:]


def scalar(function, states=STATES):
    """Return the ScalarStep of ``function(system, carry, row)``, all of numbers."""
    return scalar_step(
        lambda system, carry, row, index: function(system, carry, row),
        [[NUMBER] * STEADY, [NUMBER] * states, [NUMBER]],
        [(leaf, 0) for leaf in range(states)],
    )


def evaluated(step, given):
    """Return the new states of a step in Python; ``given`` holds its inputs."""
    known = {
        n: x.value for n, x in enumerate(step.graph.nodes) if x.operation == CONSTANT
    }
    for number in (*step.steady, *step.moving):
        node = step.graph.nodes[number]
        if node.operation == INPUT:
            place = step.places[int(node.value)]
            known[number] = given[place.part][place.leaf]
        else:
            function = PYTHON[node.operation]
            known[number] = function(*(known[n] for n in node.operands))
    return {each.place: known[each.last] for each in step.carried}


@given(
    program=programs(),
    system=st.tuples(*[powers] * STEADY),
    carry=st.tuples(*[numbers] * STATES),
    row=st.tuples(numbers),
)
def test_results_are_equal(program, system, carry, row):
    step = scalar(lambda *parts: computed(program, JAX, *parts))
    found = evaluated(shortened(step), {"system": system, "carry": carry, "row": row})
    expected = computed(program, PYTHON, system, carry, row)
    assert {place.leaf for place in found} == {x.place.leaf for x in step.carried}
    for place, value in found.items():
        assert value == expected[place.leaf]


def test_a_sum_that_is_added_to_itself():
    def function(system, carry, row):
        total = (carry[0] - row[0]) + system[0]
        return [total + total]

    given = {"system": [4.0, 1.0], "carry": [3.0], "row": [2.0]}
    found = evaluated(shortened(scalar(function, states=1)), given)
    assert [*found.values()] == [10.0]


def test_a_chain_of_sums_becomes_one():
    def function(system, carry, row):
        error = carry[0] - row[0]
        slope = (error - system[0]) * system[1]
        return [-2.0 * (slope - error)]

    chain = Chain(scalar(function, states=1))
    assert chain.cycles == 5 * 4
    chain.shorten()
    assert chain.cycles == 4


def observer():
    """Return the step of a loop with a disturbance observer, without a metric."""
    loop = p753.loop(p753.disturbance_observer())
    leaves, tree = jax.tree.flatten((loop, loop.init(0.0)))
    first = len(jax.tree.leaves(loop))

    def function(system, carry, row, index):
        of, state = jax.tree.unflatten(tree, [*system, *carry])
        state, _ = of.step(state, LoopInput(*row))
        return jax.tree.leaves(state)

    types = [jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in leaves]
    parts = types[:first], types[first:], [NUMBER, NUMBER]
    return scalar_step(function, parts, [(i, 0) for i in range(len(types) - first)])


def test_the_chain_of_a_loop():
    step = observer()
    chain = Chain(step)
    before = chain.cycles
    chain.shorten()
    assert chain.cycles < 0.4 * before
    new = chain.written()
    assert len(new.moving) < 1.3 * len(step.moving)


@pytest.mark.parametrize("states", [0, 2])
def test_a_step_that_does_not_wait(states):
    new = shortened(scalar(lambda system, carry, row: [row[0]] * states, states))
    given = {"system": [1.0] * STEADY, "carry": [1.0] * states, "row": [5.0]}
    assert [*evaluated(new, given).values()] == [5.0] * states


def test_few_lanes_wait():
    step = observer()
    assert waits(step, 8)
    assert not waits(step, 9)
