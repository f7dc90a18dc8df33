import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import extrema as oracle

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    BashashJalili,
)

LOWER, UPPER = (0.0, 0.0), (100.0, 12.0)
SHAPES = ((-0.45, 0.03), (-0.35, 0.05))
SAMPLES = 64


def model(depth=4, shapes=SHAPES):
    return BashashJalili(*LOWER, *UPPER, *shapes[0], *shapes[1], depth=depth)


@jax.jit
def padded(system, path):
    return simulate(system, path, system.init(path[0]))[1]


def response(system, path):
    """Return the response; one program serves every path that is short enough."""
    samples = SAMPLES * -(-path.size // SAMPLES)
    longer = np.pad(path, (0, samples - path.size), "edge")
    return np.asarray(padded(system, longer))[: path.size]


def expected(path, depth=4):
    return oracle.follow(list(map(float, path)), LOWER, UPPER, SHAPES, depth)


def rounded(low, high):
    return st.floats(low, high).map(lambda value: round(value, 2))


@settings(max_examples=60)
@given(st.lists(rounded(-30.0, 140.0), min_size=SAMPLES, max_size=SAMPLES))
def test_any_path_equals_the_list_of_branches(path):
    np.testing.assert_allclose(
        response(model(), np.array(path)), expected(path), atol=1e-9
    )


@pytest.mark.parametrize("depth", [1, 2, 4])
def test_loops_nested_deeper_than_the_memory(depth):
    # Three times as many nested loops as the memory has, then out of all of them.
    turns = 50.0 + 45.0 * (-0.8) ** np.arange(SAMPLES // 2)
    path = np.concatenate([turns, turns[::-1]])
    found = response(model(depth), path)
    np.testing.assert_allclose(found, expected(path, depth), atol=1e-9)
    deep = np.array(expected(path, SAMPLES))
    assert np.max(np.abs(found - deep)) > 1e-3  # forgotten extrema cause an error
    # At the outermost extrema the nested loops have no effect.
    np.testing.assert_allclose(found[-2:], deep[-2:], atol=1e-9)


def test_a_loop_beyond_the_memory_has_neither_width_nor_jump():
    system = model(depth=1)
    fine = np.interp(
        np.arange(0, 5, 0.01), range(6), [0.0, 80.0, 40.0, 60.0, 20.0, 70.0]
    )
    found = np.asarray(response(system, fine))
    step = np.max(np.abs(np.diff(fine)))
    assert np.max(np.abs(np.diff(found))) < 0.25 * step  # the steepest slope is 0.23
    # The branch from 80 to 40 is stored; 40 to 60 and back to 40 follows it.
    np.testing.assert_allclose(found[300:351], found[200:301:2][::-1], atol=1e-9)


def test_the_branch_passes_through_both_extrema():
    path = np.array([0.0, 50.0, 100.0, 50.0, 0.0])
    found = response(model(), path)
    np.testing.assert_allclose(found[0::2], [0.0, 12.0, 0.0], atol=1e-12)
    assert found[1] < 6.0 < found[3]  # counter-clockwise


def test_straight_branches_have_no_hysteresis():
    path = np.random.default_rng(0).uniform(-20.0, 120.0, SAMPLES)
    flat = model(shapes=((0.0, 0.03), (0.0, 0.05)))
    np.testing.assert_allclose(response(flat, path), 0.12 * path, atol=1e-12)


@pytest.mark.parametrize("input", [-10.0, 0.0, 30.0, 100.0, 120.0])
def test_rest_is_constant_and_paths_from_it_are_continuous(input):
    system = model()
    state = system.init(input)
    step = jax.jit(lambda state, v: system.step(state, v))
    after, output = step(state, input)
    np.testing.assert_allclose(output, expected([input])[0], atol=1e-12)
    np.testing.assert_allclose(
        jax.tree.leaves(after), jax.tree.leaves(state), rtol=0.0, atol=1e-14
    )
    for by in (-1e-7, 1e-7):
        assert abs(step(state, input + by)[1] - output) < 1e-7


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lower_input": np.nan}, "lower_input is nan and .* must be below"),
        ({"upper_input": -1.0}, "lower_input must be below upper_input"),
        ({"upper_output": 0.0}, "lower_output must be below upper_output"),
        ({"rising_alpha": -1.0}, "rising_alpha is -1; it must be finite and above -1"),
        ({"falling_alpha": 8.0}, "falling_alpha is 8; .* below 7.38906"),
        ({"rising_tau": -0.1}, "rising_tau in 1/V is -0.1; .* at least 0"),
        ({"depth": 0}, "depth is 0; it must be finite and at least 1"),
    ],
)
def test_bad_parameters_are_refused(changed, message):
    good = {
        "lower_input": 0.0,
        "lower_output": 0.0,
        "upper_input": 100.0,
        "upper_output": 12.0,
        "rising_alpha": -0.4,
        "rising_tau": 0.03,
        "falling_alpha": -0.4,
        "falling_tau": 0.03,
    }
    with pytest.raises(ValueError, match=message):
        BashashJalili(**{**good, **changed})
