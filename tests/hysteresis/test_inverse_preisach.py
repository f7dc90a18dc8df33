import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import signals
from oracles.loop import closed_loop
from oracles.preisach import Lines, PreisachInversion
from oracles.published import plant_t2, smc_gains

from piezojax import (
    Feedback,
    simulate,
)
from piezojax.catalog import p753
from piezojax.control import (
    InversionControl,
)
from piezojax.core.feedback import LoopInput
from piezojax.core.system import Series
from piezojax.hardware import (
    Sensor,
)
from piezojax.hysteresis import (
    InversePreisach,
    Preisach,
)

LOW, HIGH, LOWEST = -20.0, 120.0, -1.2
LENGTH = 32


def weights(seed, cells=6, off_diagonal=1.0):
    found = np.random.default_rng(seed).uniform(0.05, 0.6, (cells, cells))
    found[3:, 1] = 0.0
    return np.tril(found, -1) * off_diagonal + np.diag(np.diag(found))


@jax.jit
def _run(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[1]


@jax.jit
def run_to(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[0]


@jax.jit
def output_and_slope(model, state, voltage):
    return jax.value_and_grad(lambda u: model.step(state, u)[1])(voltage)


def stage(density, start="virgin"):
    return Preisach(density, LOW, HIGH, LOWEST, 10.0, start)


@settings(max_examples=50)
@given(
    st.integers(0, 1000),
    st.sampled_from([1.0, 0.01, 100.0]),
    st.sampled_from(["virgin", "saturated"]),
    st.lists(st.floats(0.0, 1.0), min_size=LENGTH, max_size=LENGTH),
)
def test_inverse_then_model_is_the_identity(seed, width, start, shares):
    model = stage(weights(seed, off_diagonal=width), start)
    wanted = LOWEST + np.array(shares) * float(model.weights.sum())
    reached = _run(Series((InversePreisach(model), model)), wanted)
    np.testing.assert_allclose(reached, wanted, rtol=0, atol=1e-11 * max(width, 1.0))


@settings(max_examples=50)
@given(st.lists(st.floats(LOW, HIGH), min_size=LENGTH, max_size=LENGTH))
def test_model_then_inverse_is_the_identity(voltages):
    model = stage(weights(0))
    found = _run(Series((model, InversePreisach(model))), np.array(voltages))
    np.testing.assert_allclose(found, voltages, rtol=0, atol=1e-9)


def test_the_inverse_is_exact_with_twenty_cells():
    model = stage(weights(3, 20))
    wanted = np.random.default_rng(4).uniform(0.0, 1.0, 400) * model.weights.sum()
    reached = _run(Series((InversePreisach(model), model)), LOWEST + wanted)
    np.testing.assert_allclose(reached, LOWEST + wanted, rtol=0, atol=1e-11)


@jax.jit
def voltage_and_slope(inverse, state, wanted):
    return jax.value_and_grad(lambda f: inverse.solve(state, f))(wanted)


@jax.jit
def stepped(system, input):
    """Return the state at rest, and after two steps under the same input."""
    before = system.init(input)
    after, output = system.step(before, input)
    last, again = system.step(after, input)
    return (before, after, last), (output, again)


@pytest.mark.parametrize(("wanted", "end"), [(-5.0, LOW), (1e3, HIGH)])
def test_an_unreachable_output_gives_the_end_of_the_range(wanted, end):
    inverse = InversePreisach(stage(weights(0)))
    state = stepped(inverse, 1.0)[0][0]
    voltage, slope = voltage_and_slope(inverse, state, wanted)
    np.testing.assert_allclose(voltage, end, rtol=1e-14)
    assert slope == 0.0


@pytest.mark.parametrize("density", [weights(0), np.tril(weights(5), -1)])
@pytest.mark.parametrize("wanted", [-0.9, 0.0, 1.2])
def test_the_inverse_at_rest_stays_at_rest(density, wanted):
    inverse = InversePreisach(stage(density))
    states, voltages = stepped(inverse, wanted)
    np.testing.assert_allclose(states[1], states[0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(states[2], states[0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(voltages[1], voltages[0], rtol=0, atol=1e-12)
    reached = stepped(inverse.model, voltages[0])[1][0]
    np.testing.assert_allclose(reached, wanted, rtol=0, atol=1e-12)


def test_the_inverse_reaches_outputs_across_a_flat_section():
    # Without a reversible part the output is flat after each turning point.
    model = stage(np.tril(weights(5), -1))
    share = np.array([0.1, 0.6, 0.6, 0.3, 0.8, 0.35, 0.35])
    wanted = LOWEST + share * float(model.weights.sum())
    reached = _run(Series((InversePreisach(model), model)), wanted)
    np.testing.assert_allclose(reached, wanted, rtol=0, atol=1e-11)


def test_gradients_equal_central_differences():
    model = stage(weights(0))
    state = run_to(model, np.array([15.0, 80.0, 40.0, 61.0]))
    now = float(output_and_slope(model, state, 61.0)[0])

    @jax.jit
    def voltage(model, state, wanted):
        return InversePreisach(model).solve(state, wanted)

    # Up within a cell, up across turns, down, far down.
    for wanted in (now + 0.05, now + 1.0, now - 0.1, now - 2.0):
        arguments = (model, state, jnp.asarray(wanted))
        values, tree = jax.tree.flatten(arguments)
        found = jax.tree.leaves(jax.grad(voltage, argnums=(0, 1, 2))(*arguments))
        for at, (leaf, gradient) in enumerate(zip(values, found, strict=True)):
            for index in np.ndindex(leaf.shape):
                ends = []
                for by in (1e-6, -1e-6):
                    moved = list(values)
                    moved[at] = leaf.at[index].add(by)
                    ends.append(float(voltage(*jax.tree.unflatten(tree, moved))))
                slope = (ends[0] - ends[1]) / 2e-6
                np.testing.assert_allclose(gradient[index], slope, rtol=1e-5, atol=1e-6)


def test_gradient_at_rest_equals_the_reciprocal_slope():
    model = stage(weights(0))
    state = run_to(model, np.array([15.0, 80.0, 40.0, 61.0]))
    now = float(output_and_slope(model, state, 61.0)[0])
    for wanted in (now + 0.5, now - 0.5):
        voltage, back = voltage_and_slope(InversePreisach(model), state, wanted)
        slope = output_and_slope(model, state, voltage)[1]
        np.testing.assert_allclose(back, 1.0 / slope, rtol=1e-9)
    voltage, at_rest = voltage_and_slope(InversePreisach(model), state, now)
    assert voltage == 61.0
    rising = output_and_slope(model, state, 61.0 + 1e-6)[1]
    np.testing.assert_allclose(at_rest, 1.0 / rising, rtol=1e-9)


def test_sliding_mode_with_the_inverse_equals_the_oracle():
    # The inverse has another hysteresis than the stage: Coleman-Hodgdon.
    samples, noise_rms = 20_000, 0.012
    density = np.tril(np.full((4, 4), 0.8)) + 3.0 * np.eye(4)
    model = Preisach(density, LOW, HIGH, LOWEST, 0.0)
    reference = signals.sine(10, duration=1.0 + 1.0 / p753.RATE)
    noise = np.random.default_rng(11).normal(size=samples)
    lowest = float(LOWEST - model.step(model.init(0.0), 0.0)[1])
    model = Preisach(density, LOW, HIGH, lowest, 0.0)  # at rest at zero
    made = PreisachInversion(
        smc_gains("inversion", "5-3"), p753.RATE, Lines(density, LOW, HIGH, 0.0), lowest
    )
    expected = closed_loop(made, reference, plant_t2(), None, noise=noise_rms * noise)
    assert 1.0 < np.ptp(expected["displacement"]) < 25.0
    assert np.all(expected["command"] == expected["voltage"])  # nothing was clipped
    controller = InversionControl(p753.inversion().feedback, InversePreisach(model))
    loop = Feedback(controller, p753.plant("exact"), p753.actuator(), Sensor(noise_rms))
    inputs = LoopInput(jnp.asarray(reference[1:]), jnp.asarray(noise))
    found = jax.jit(lambda: simulate(loop, inputs, loop.init(0.0))[1])()
    for column, values in expected.items():
        np.testing.assert_allclose(
            getattr(found, column), values, rtol=0, atol=1e-9, err_msg=column
        )
