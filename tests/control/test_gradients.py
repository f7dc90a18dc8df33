from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from piezojax import (
    loop_inputs,
    simulate,
)
from piezojax.catalog import p753
from piezojax.control import (
    PID,
)
from piezojax.core import paths
from piezojax.core.metrics import (
    Tracking,
)
from piezojax.signals import waveforms as signals

SAMPLES = 1000
TIME = signals.time_grid(SAMPLES / p753.RATE, p753.RATE)
DRAWS = np.random.default_rng(12).normal(size=SAMPLES)
QUIET = np.zeros(SAMPLES)

LOOPS = {
    "pid": p753.loop(PID(0.5, 3000.0, 1e-5, 1e-4, 100.0, 3.0, -2.5, dt=p753.DT)),
    "observer": p753.loop(p753.disturbance_observer()),
}


def reference(name, **options):
    return np.asarray(signals.signal(name, TIME, **options))


RUNS = {
    "with noise": (reference("SIN50"), DRAWS),
    "turning points on samples": (reference("TRI50"), QUIET),
    "a jump": (reference("STEP20"), QUIET),
    "rest at zero": (QUIET, QUIET),
    "rest at 5 um": (QUIET + 5.0, QUIET),
    "saturation": (reference("SIN50", amplitude=15.0), DRAWS),
}


class Compiled(NamedTuple):
    names: list[str]
    values: np.ndarray
    scale: np.ndarray  # relative steps; absolute for a value of zero
    reverse: jax.stages.Wrapped
    forward: jax.stages.Wrapped
    batch: jax.stages.Wrapped


@pytest.fixture(scope="module", params=LOOPS)
def loop(request):
    """Compile each function once for all parameters and runs."""
    loop = LOOPS[request.param]
    arrays, static = eqx.partition(loop, eqx.is_array)
    flat, unravel = ravel_pytree(arrays)

    def rebuilt(values):
        return eqx.combine(unravel(values), static)

    def figures(values, run):
        loop, (reference, draws) = rebuilt(values), run
        inputs, state = loop_inputs(reference, draws), loop.init(reference[0])
        return simulate(loop, inputs, state, metric=Tracking(10))[1]

    def loss(values, run):
        return figures(values, run).rms_error

    values = np.array(flat)
    return Compiled(
        names=list(paths.parameters(loop)),
        values=values,
        scale=np.where(values == 0.0, 1.0, np.abs(values)),
        reverse=jax.jit(jax.value_and_grad(loss)),
        forward=jax.jit(jax.jacfwd(loss)),
        batch=jax.jit(jax.vmap(figures, in_axes=(0, None))),
    )


STEPS = (1e-6, 4e-6)
"""Relative tolerance. The slope of hysteresis and limits jumps where a voltage turns or
its limit, which lies between two points of the larger step for the parameters that move
the loop most; rounding spoils the smaller one for those that hardly move it."""


def differences(loop, run, step):
    """Fourth-order central differences for a relative change of each parameter."""
    moves = step * np.diag(loop.scale)
    points = [loop.values + times * moves for times in (1, -1, 2, -2)]
    losses = loop.batch(np.concatenate(points), run).rms_error.reshape(4, -1)
    return (8.0 * (losses[0] - losses[1]) - (losses[2] - losses[3])) / (12.0 * step)


def assert_close(found, expected, names, rtol, atol):
    for name, one, other in zip(names, found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=rtol, atol=atol, err_msg=name)


@pytest.mark.parametrize("run", RUNS.values(), ids=RUNS)
def test_reverse_mode_equals_forward_mode_and_is_finite(loop, run):
    reverse = loop.reverse(loop.values, run)[1] * loop.scale
    forward = loop.forward(loop.values, run) * loop.scale
    assert np.all(np.isfinite(reverse))
    floor = 1e-12 * max(np.abs(forward).max(), 1.0)
    assert_close(reverse, forward, loop.names, rtol=1e-9, atol=floor)


@pytest.mark.parametrize(
    "name", ["with noise", "turning points on samples", "a jump", "saturation"]
)
def test_gradient_equals_finite_differences(loop, name):
    loss, gradient = loop.reverse(loop.values, RUNS[name])
    gradient = np.asarray(gradient) * loop.scale
    each = np.stack([differences(loop, RUNS[name], step) for step in STEPS])
    # A wrong derivative agrees with neither.
    nearest = np.abs(each - gradient).argmin(axis=0)
    expected = np.take_along_axis(each, nearest[None], axis=0)[0]
    assert np.count_nonzero(expected) > len(loop.names) / 2
    floor = 3e-9 * loss  # some units in the last place of the loss over the step
    assert_close(gradient, expected, loop.names, rtol=1e-4, atol=floor)


@pytest.mark.parametrize("name", ["rest at zero", "rest at 5 um"])
def test_gradients_of_a_loop_at_rest_are_zero(loop, name):
    loss, gradient = loop.reverse(loop.values, RUNS[name])
    assert loss < 1e-9
    np.testing.assert_allclose(gradient * loop.scale, 0.0, atol=1e-9)


@pytest.mark.parametrize("name", RUNS)
def test_the_runs_have_the_named_properties(loop, name):
    points = np.tile(loop.values, (4 * loop.values.size, 1))
    figures = jax.tree.map(lambda x: x[0], loop.batch(points, RUNS[name]))
    if name == "saturation":
        assert 0.1 < figures.saturated < 1.0
    if name in ("with noise", "rest at zero", "rest at 5 um"):
        assert figures.saturated == 0.0
    assert (figures.peak_error < 1e-9) == name.startswith("rest")
