from json import dumps, loads

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import dlsim

from piezojax import (
    load,
    save,
    simulate,
)
from piezojax.dynamics import (
    NeuralStateSpace,
)

SHAPES = {
    "state_matrix": "nn",
    "input_matrix": "nm",
    "output_matrix": "pn",
    "neuron_output": "nh",
    "neuron_state": "hn",
    "neuron_input": "hm",
    "neuron_bias": "h",
    "input_offset": "m",
    "output_offset": "p",
}


def numbers(seed=0, **sizes):
    draw = np.random.default_rng(seed)
    sizes = {"n": 3, "m": 1, "p": 1, "h": 4} | sizes
    drawn = {
        name: 0.3 * draw.standard_normal([sizes[axis] for axis in axes])
        for name, axes in SHAPES.items()
    }
    drawn["state_matrix"] = 0.5 * np.eye(sizes["n"]) + 0.1 * drawn["state_matrix"]
    return drawn


def model(seed=0, **sizes):
    return NeuralStateSpace(**numbers(seed, **sizes))


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, jnp.zeros(len(system.state_matrix)))[1]


def inputs(samples, width=None, seed=1):
    shape = (samples,) if width is None else (samples, width)
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize(("m", "p"), [(1, 1), (2, 1), (1, 2), (3, 2)])
def test_response_equals_the_recursion(m, p):
    values = numbers(m=m, p=p)
    driven = inputs(40, None if m == 1 else m)
    state, expected = np.zeros(3), []
    for u in driven.reshape(40, m):
        v = u - values["input_offset"]
        neurons = np.tanh(
            values["neuron_state"] @ state
            + values["neuron_input"] @ v
            + values["neuron_bias"]
        )
        state = (
            values["state_matrix"] @ state
            + values["input_matrix"] @ v
            + values["neuron_output"] @ neurons
        )
        expected.append(values["output_matrix"] @ state + values["output_offset"])
    expected = np.array(expected)
    found = response(NeuralStateSpace(**values), driven)
    assert found.shape == ((40,) if p == 1 else (40, p))
    np.testing.assert_allclose(
        found, expected[:, 0] if p == 1 else expected, rtol=1e-11
    )


def test_without_neurons_it_equals_the_linear_state_space():
    values = numbers(m=2, p=2)
    values["neuron_output"] = np.zeros((3, 4))
    driven = inputs(50, 2)
    A, B, C = (values[name] for name in list(SHAPES)[:3])
    _, expected, _ = dlsim((A, B, C @ A, C @ B, 1.0), driven - values["input_offset"])
    np.testing.assert_allclose(
        response(NeuralStateSpace(**values), driven),
        expected + values["output_offset"],
        rtol=0.0,
        atol=1e-12,
    )


def test_the_rest_state_is_the_settled_state():
    system, held = model(), 5.0
    state = system.init(held)
    after, output = system.step(state, held)
    np.testing.assert_allclose(after, state, rtol=0.0, atol=1e-12)
    settled = response(system, np.full(300, held))[-1]
    np.testing.assert_allclose(output, settled, rtol=1e-12)


def test_rest_of_several_inputs():
    system, held = model(m=2, p=2), np.array([1.0, -3.0])
    output = system.step(system.init(held), held)[1]
    np.testing.assert_allclose(output, response(system, np.tile(held, (300, 1)))[-1])


def test_without_a_rest_state_it_starts_from_zero():
    values = numbers() | {"state_matrix": np.eye(3), "neuron_output": np.zeros((3, 4))}
    np.testing.assert_array_equal(NeuralStateSpace(**values).init(1.0), np.zeros(3))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "input_matrix",
            "[1.0, 2.0, 3.0]",
            "must be a list of rows of numbers",
        ),
        ("input_matrix", "[[1.0], [2.0, 3.0], []]", "model.json.input_matrix is"),
        ("neuron_bias", "3.0", "must be a list of numbers"),
        ("neuron_bias", '["a", "b"]', "must be a list of numbers"),
        ("input_matrix", "[[1.0]]", r"model.json: input_matrix has shape \(1, 1\)"),
    ],
)
def test_a_file_with_wrong_shapes_is_refused(tmp_path, name, value, message):
    path = tmp_path / "model.json"
    save(model(), path)
    data = loads(path.read_text())
    data[name] = loads(value)
    path.write_text(dumps(data))
    with pytest.raises(ValueError, match=message):
        load(path)


@pytest.mark.parametrize("name", SHAPES)
def test_numbers_that_are_not_finite_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} is .*nan.*; it must be finite"):
        NeuralStateSpace(**numbers() | {name: np.nan * numbers()[name]})


def test_inconsistent_shapes_are_refused():
    message = (
        r"neuron_state has shape \(4, 2\); with 3 states, 4 neurons, 1 inputs and "
        r"1 outputs it must be \(4, 3\)"
    )
    with pytest.raises(ValueError, match=message):
        NeuralStateSpace(**numbers() | {"neuron_state": np.zeros((4, 2))})
