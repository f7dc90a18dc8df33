"""Parameters by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Feedback,
    series,
)
from piezojax.catalog import CONTROLLERS, PLANTS, p753
from piezojax.core.paths import get, parameters, replace, static_fields
from piezojax.core.system import (
    Affine,
    Delay,
)
from piezojax.dynamics import (
    FirstOrderLag,
)


@pytest.fixture(params=sorted(CONTROLLERS))
def loop(request):
    return p753.loop(CONTROLLERS[request.param]())


def test_every_array_leaf_has_one_path(loop):
    found = parameters(loop)
    leaves = jax.tree.leaves(loop)
    assert len(found) == len(leaves)
    assert sorted(map(id, found.values())) == sorted(map(id, leaves))


def test_every_path_leads_to_its_leaf(loop):
    for path, value in parameters(loop).items():
        assert get(loop, path) is value


def test_replace_changes_one_leaf_and_no_other(loop):
    before = parameters(loop)
    for path in before:
        after = parameters(replace(loop, {path: 0.123}))
        np.testing.assert_array_equal(after[path], 0.123)
        changed = [name for name in before if after[name] is not before[name]]
        assert changed == [path]


def test_replace_several_at_once(loop):
    values = {path: float(i) for i, path in enumerate(parameters(loop))}
    after = replace(loop, values)
    for path, leaf in parameters(after).items():
        np.testing.assert_array_equal(leaf, values[path])
    assert jax.tree.structure(after) == jax.tree.structure(loop)


def test_replace_nothing(loop):
    assert replace(loop, {}) is loop


def test_replaced_leaves_are_float64(loop):
    path = next(iter(parameters(loop)))
    assert get(replace(loop, {path: 3}), path).dtype == jnp.float64


def test_replace_under_jit_and_grad():
    plant = p753.plant()

    @jax.jit
    def output(a):
        moved = replace(plant, {"hysteresis.a": a})
        return moved.step(moved.init(0.0), 10.0)[1]

    slope = jax.grad(output)(0.0077)
    numeric = (output(0.0077 + 1e-5) - output(0.0077 - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope, numeric, rtol=1e-6)


def test_named_and_numbered_parts():
    named = series(first=Affine(1.0), second=Affine(2.0))
    assert get(named, "second.gain") == 2.0
    numbered = Affine(1.0) >> Affine(2.0)
    assert get(numbered, "1.gain") == 2.0
    both = named + numbered
    assert get(both, "parts.0.first.gain") == 1.0
    assert get(both, "parts.1.1.gain") == 2.0


def test_coefficients_are_numbered():
    plant = PLANTS["p753"]()
    assert get(plant, "dynamics.autoregressive.1") == pytest.approx(-0.61995)


@pytest.mark.parametrize(
    ("path", "near"),
    [
        ("controller.proportionl", "controller.proportional"),
        ("controller.intergral", "controller.integral"),
        ("contoller.anti_windup", "controller.anti_windup"),
        ("plant.hysteresis.rest_inputs", "plant.hysteresis.rest_input"),
        ("plant.dynamics.moving.3", "plant.dynamics.moving"),
        ("sensor.noise", "sensor.noise_rms"),
    ],
)
@pytest.mark.parametrize("use", [get, lambda loop, path: replace(loop, {path: 1.0})])
def test_unknown_paths_get_the_nearest_names(path, near, use):
    loop = p753.loop(p753.pid())
    with pytest.raises(ValueError, match="no parameter") as caught:
        use(loop, path)
    message = str(caught.value)
    assert message.startswith(f"no parameter {path!r}; the nearest are ")
    assert near in message.split(" are ")[1]


@pytest.mark.parametrize(
    "path",
    ["", ".", "controller", "controller.", "controller.dt", "controller.integral.x"],
)
def test_only_array_leaves_are_parameters(path):
    with pytest.raises(ValueError, match="no parameter '" + path):
        get(p753.loop(p753.pid()), path)


def test_static_fields_are_found_wherever_they_are():
    plant = series(lag=FirstOrderLag(1e-3, 1e-4), pause=Delay(3))
    loop = Feedback(p753.pid(), plant, p753.actuator(), Affine())
    assert static_fields(loop, "dt") == [5e-5, 1e-4]
    assert static_fields(loop, "samples") == [3]
    assert static_fields(loop, "nothing") == []
