import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import preisach as oracle

from piezojax import (
    simulate,
)
from piezojax.core.serial import from_data, to_data
from piezojax.hysteresis import (
    InversePreisach,
    Preisach,
)

CELLS, LOW, HIGH, LOWEST = 10, 0.0, 100.0, -1.5
SIZE = (HIGH - LOW) / CELLS
LENGTH = 256  # the length of every input, so that one program serves all


def draws(seed=0, cells=CELLS):
    weights = np.tril(np.random.default_rng(seed).uniform(0.05, 0.6, (cells, cells)))
    weights[3, 1] = 0.0
    return weights


WEIGHTS = draws()


def model(start="virgin", rest=30.0, weights=WEIGHTS):
    return Preisach(weights, LOW, HIGH, LOWEST, rest, start)


@jax.jit
def _run(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[1]


def response(system, inputs):
    """Return the outputs along ``inputs``, from rest at the first one."""
    inputs = np.asarray(inputs, dtype=float)
    padded = np.pad(inputs, (0, LENGTH - inputs.size), "edge")
    return np.asarray(_run(system, padded))[: inputs.size]


def sampled(corners, step=5.0):
    """Return lines between ``corners``, multiples of ``step``, sampled every step."""
    path = [corners[0]]
    for corner in corners[1:]:
        count = round(abs(corner - path[-1]) / step)
        path += list(np.linspace(path[-1], corner, count + 1)[1:])
    return np.array(path)


inputs = st.floats(LOW - 10.0, HIGH + 10.0)
on_grid = st.integers(-2, 22).map(lambda step: 5.0 * step)


@pytest.mark.parametrize("start", ["virgin", "saturated"])
def test_the_output_equals_the_sum_of_relays(start):
    # Inputs between relays that are 5 V apart: rounding does not matter.
    x = 5.0 * np.random.default_rng(1).integers(-2, 23, LENGTH)
    rest = 30.0 if start == "virgin" else None
    expected = LOWEST + oracle.along(WEIGHTS, LOW, HIGH, 2, x, rest)
    assert np.ptp(expected) > 10.0
    np.testing.assert_allclose(response(model(start), x), expected, atol=1e-12)


def test_the_output_is_the_limit_of_many_relays():
    x = np.random.default_rng(2).uniform(LOW, HIGH, 60)
    found = response(model(), x) - LOWEST
    for parts in (10, 100):
        error = np.abs(oracle.along(WEIGHTS, LOW, HIGH, parts, x, 30.0) - found).max()
        # One relay of each line may be on either side.
        assert error <= sum(np.diag(WEIGHTS, -k).max() for k in range(CELLS)) / parts


# Figure 2.2: the input (V) at its points 1 to 10 and at its end, in the order of size
# that follows from the text.
FIGURE = (0.0, 95.0, 10.0, 65.0, 20.0, 55.0, 30.0, 70.0, 25.0, 75.0)
POINTS = dict(enumerate(FIGURE, 1))
END = 0.0


def last(count, *points):
    """Return the last outputs on the path through points of the figure, or inputs."""
    corners = [POINTS[p] if isinstance(p, int) else p for p in points]
    return response(model("saturated"), sampled(corners))[-count:]


@pytest.mark.parametrize(
    ("whole", "wiped", "count"),
    [
        # Beyond 6 the loop of 6 and 7 is forgotten: the path continues from 5.
        ((1, 2, 3, 4, 5, 6, 7, 65.0), (1, 2, 3, 4, 5, 65.0), 3),
        # Beyond 4 the loop of 4 and 5 is forgotten too.
        ((1, 2, 3, 4, 5, 6, 7, 8), (1, 2, 3, 8), 2),
        # From 8 to 9, back to 8 and on to 10: as without 9.
        ((1, 2, 3, 4, 5, 6, 7, 8, 9, 10), (1, 2, 3, 10), 2),
        # Down through 3: the curve from 2 to 3 continues to the end.
        ((1, 2, 3, 4, 5, 6, 7, 8, 9, 10, END), (1, 2, END), 3),
    ],
)
def test_wiping_out_on_the_input_of_figure_2_2(whole, wiped, count):
    expected = last(count, *wiped)
    np.testing.assert_allclose(last(count, *whole), expected, rtol=0, atol=1e-13)
    # One sample earlier the smaller loop still has an effect.
    sooner = last(count + 1, *whole)[0] - last(count + 1, *wiped)[0]
    assert abs(sooner) > 1e-3


def test_loops_of_figure_2_2_between_the_same_inputs_are_congruent():
    inside = last(11, 1, 2, 3, 4, 5, 6, 7, 6)
    behind = last(11, 1, 2, 3, 10, 7, 6, 7, 6)
    assert abs(inside[0] - behind[0]) > 0.01
    loop = inside - inside[0]
    assert loop[3] > loop[7]  # it has a width
    np.testing.assert_allclose(loop, behind - behind[0], rtol=0, atol=1e-13)


@settings(max_examples=50)
@given(st.lists(inputs, min_size=2, max_size=8))
def test_the_output_is_independent_of_the_speed(corners):
    at = np.arange(0, len(corners) - 1 + 1e-9, 1 / 32)
    slow = np.interp(at, range(len(corners)), corners)
    coarse, fine = response(model(), corners), response(model(), slow)
    np.testing.assert_allclose(fine[::32], coarse, rtol=0, atol=1e-12)


@settings(max_examples=50)
@given(st.lists(st.floats(0.0, 1.0), max_size=6), inputs, inputs, inputs)
def test_a_larger_loop_wipes_out_earlier_smaller_ones(small, x, y, end):
    low, high = sorted((x, y))
    between = [low + share * (high - low) for share in small]
    rich = response(model(), [x, *between, low, high, end])[-1]
    plain = response(model(), [x, low, high, end])[-1]
    np.testing.assert_allclose(rich, plain, rtol=0, atol=1e-12)


@settings(max_examples=50)
@given(st.lists(inputs, min_size=1, max_size=6), inputs, inputs)
def test_loops_between_the_same_inputs_are_congruent(before, x, y):
    loop = [x, y, x, *np.linspace(x, y, 5), *np.linspace(y, x, 5)]
    found = response(model(), [*before, *loop])[-10:]
    other = response(model("saturated"), loop)[-10:]
    np.testing.assert_allclose(found - found[0], other - other[0], rtol=0, atol=1e-12)
    assert abs(found[-1] - found[0]) < 1e-12  # and closed


@settings(max_examples=50)
@given(st.lists(inputs, max_size=5), inputs, inputs, inputs)
def test_minor_loops_return_to_their_turning_point(before, x, y, z):
    # A path from the middle down to above the last extremum, and back.
    turn, excursion, point = sorted((x, y, z))
    found = response(model(), [*before, turn, point, excursion, point])
    np.testing.assert_allclose(found[-1], found[-3], rtol=0, atol=1e-12)


@settings(max_examples=50)
@given(st.lists(on_grid, min_size=3, max_size=4))
def test_a_closed_cycle_dissipates_energy(corners):
    # All kinks of the output are at samples, so the trapezoid rule is exact.
    cycle = sampled([*corners, corners[0]])
    path = np.concatenate([cycle, cycle[1:]])
    x, y = path[-cycle.size :], response(model(), path)[-cycle.size :]
    assert abs(y[-1] - y[0]) < 1e-12
    work = np.sum((x[1:] + x[:-1]) / 2 * np.diff(y))
    assert work > (1e-3 if np.ptp(np.clip(x, LOW, HIGH)) > 2 * SIZE else -1e-12)


@settings(max_examples=50)
@given(st.lists(inputs, min_size=2, max_size=6))
def test_the_output_rises_with_the_input(inputs):
    x, y = np.array(inputs[1:]), response(model(), inputs)
    rise, change = np.diff(inputs), np.diff(y)
    assert x.size == change.size
    assert np.all(rise * change >= -1e-12)


def test_all_relays_down_and_up_give_the_extreme_outputs():
    ends = response(model(), [-10.0, 110.0, -10.0])
    total = LOWEST + WEIGHTS.sum()
    np.testing.assert_allclose(ends, [LOWEST, total, LOWEST], rtol=0, atol=1e-12)


PATH = np.array([31.0, 83.0, 12.0, 47.0, 28.0, 66.0, 44.0])


@jax.jit
def loss(system, path):
    outputs = simulate(system, path, system.init(path[0]))[1]
    return jnp.sum(jnp.cos(jnp.arange(path.size)) * outputs)


gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))


def test_gradients_at_rest_and_on_edges_are_one_sided():
    for input in (LOW, LOW + SIZE, HIGH):
        found = gradients(model(rest=input), jnp.full(PATH.size, input))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
    # Only relays without width move: the slope is the weight of the cell above.
    found = gradients(model(rest=LOW + SIZE), jnp.full(PATH.size, LOW + SIZE))[1]
    slope = WEIGHTS[1, 1] / SIZE * np.cos(np.arange(PATH.size))
    np.testing.assert_allclose(found[1:], slope[1:], rtol=1e-12)


def test_the_model_is_saved_and_loaded():
    system = InversePreisach(model("saturated"))
    again = from_data(to_data(system))
    assert jax.tree.structure(again) == jax.tree.structure(system)
    same = jax.tree.map(lambda a, b: bool(jnp.all(a == b)), system, again)
    assert jax.tree.all(same)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": np.ones((2, 3))}, "weights are 2 x 3; they must be n x n"),
        ({"weights": np.ones((0, 0))}, "weights are 0 x 0"),
        ({"weights": np.ones(3)}, r"shape \(3,\); it must be 2-dimensional"),
        ({"weights": [[1.0, 0.0], [-1.0, 1.0]]}, "it must be finite and at least 0"),
        ({"weights": [[1.0, 1.0], [1.0, 1.0]]}, "where beta is above alpha is"),
        ({"low": 100.0}, "low must be below high"),
        ({"high": np.inf}, "high in V is inf"),
        ({"lowest": np.nan}, "lowest in um is nan"),
        ({"rest_input": np.nan}, "rest_input in V is nan"),
        ({"start": "warm"}, "start 'warm'; it must be one of"),
    ],
)
def test_bad_parameters(changes, message):
    good = {"weights": np.eye(2), "low": 0.0, "high": 100.0}
    with pytest.raises(ValueError, match=message):
        Preisach(**(good | changes))
