"""Parameters by path."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Feedback,
    series,
)
from piezojax.catalog import CONTROLLERS, PLANTS, p753
from piezojax.control import PID, DisturbanceObserverControl
from piezojax.core.arrays import as_array, as_scalars
from piezojax.core.axes import PerAxis
from piezojax.core.parameter import (
    PartUnits,
    declarations,
    parameter,
    sample_time,
    substitute_units,
)
from piezojax.core.paths import (
    declared,
    get,
    leaf_path,
    matching,
    parameters,
    replace,
    static_fields,
)
from piezojax.core.system import Affine, Delay, System
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


def test_replace_changes_one_leaf_only(loop):
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


def test_static_fields_are_found_at_any_depth():
    plant = series(lag=FirstOrderLag(1e-3, 1e-4), pause=Delay(3))
    loop = Feedback(p753.pid(), plant, p753.actuator(), Affine())
    assert static_fields(loop, "dt") == [5e-5, 1e-4]
    assert static_fields(loop, "samples") == [3]
    assert static_fields(loop, "nothing") == []


class Bank(System):
    """Filters with separate gains and a common corner frequency."""

    gains: tuple[Any, ...] = parameter("V/um", "gains", converter=as_scalars)
    corner: Any = parameter("rad/s", "corner frequency", below_nyquist=True)
    bare: Any = eqx.field(converter=as_array)
    dt: float = sample_time()

    def init(self, input=0.0):
        return as_array(input)

    def step(self, state, input):
        return state, input


class Pair(NamedTuple):
    """Two gains in um/V."""

    rising: Any
    falling: Any


class Bent(System):
    """Two gains behind each other, and a named part."""

    gains: Pair
    part: System

    def init(self, input=0.0):
        return self.part.init(input)

    def step(self, state, input):
        return self.part.step(state, self.gains.rising * input)


@pytest.mark.parametrize(
    "system",
    [
        p753.loop(p753.pid()),
        series(bank=Bank((1.0, 2.0), 5.0, 3.0, 1e-3), lag=FirstOrderLag(1e-3, 1e-3)),
        Affine() >> (Affine() + FirstOrderLag(1e-3, 1e-3)),
        PerAxis((series(a=Affine(), b=Affine()), Affine() >> Affine()), ("x", "y")),
        PerAxis((Affine(), Affine())),
        Bent(Pair(as_array(1.0), as_array(2.0)), series(inner=Affine())),
    ],
)
def test_the_path_of_a_leaf_is_found_by_its_keys(system):
    dynamic = eqx.filter(system, eqx.is_array)
    leaves = jax.tree_util.tree_flatten_with_path(dynamic)[0]
    assert [leaf_path(dynamic, keys) for keys, _ in leaves] == [*parameters(system)]
    for keys, leaf in leaves:
        assert get(system, leaf_path(dynamic, keys)) is leaf


def test_declarations_are_found_by_path():
    loop = p753.loop(p753.pid())
    known = dict(declarations(PID))
    assert declared(loop, "controller.anti_windup") is known["anti_windup"]
    assert declared(loop, "controller.dt") is known["dt"]
    inner = series(bank=Bank((1.0, 2.0), 5.0, 3.0, 1e-3), lag=FirstOrderLag(1e-3, 1e-3))
    assert declared(inner, "bank.gains.1").unit == "V/um"
    assert declared(inner >> Affine(), "0.bank.gains.0").meaning == "gains"


def test_declarations_use_the_nyquist_frequency():
    for dt in (1e-3, 1e-4):
        bank = Bank((1.0,), 5.0, 3.0, dt)
        assert declared(bank, "corner").below == np.pi / dt
    cutoff = dict(declarations(DisturbanceObserverControl))["cutoff"]
    assert cutoff.below_nyquist
    assert cutoff.below == np.inf


@pytest.mark.parametrize(
    ("unit", "units", "expected"),
    [
        ("[v]/[s]", {"v": "V", "s": "um/s"}, "V s/um"),
        ("[v]/([s] s)", {"v": "V", "s": "um/s"}, "V/um"),
        ("[v]/([s] s)", {"v": "V", "s": "um"}, "V/(um s)"),
        ("[v] s/[s]", {"v": "um", "s": "um/s"}, "s^2"),
        ("[v]/[s]", {"v": "um", "s": "um"}, "1"),
        ("[v]/([s] s)", {"v": "um", "s": "um"}, "1/s"),
        ("[v]/[s]^(1/2)", {"v": "V", "s": "um/s"}, "V s^(1/2)/um^(1/2)"),
        ("[v]^2/[s]", {"v": "V/um^(1/2)", "s": "um^-1"}, "V^2"),
        ("[v]/[s]", {"s": "um/s"}, "[v] s/um"),
        ("um/V^(i+1)", {"v": "V"}, "um/V^(i+1)"),
        ("[w]/um", {"v": "V"}, "[w]/um"),
    ],
)
def test_units_are_substituted_and_cancelled(unit, units, expected):
    assert substitute_units(unit, units) == expected


class Gain(System):
    """A gain between two units that the outer System declares."""

    gain: Any = parameter("[v]/[s]", "gain")

    def init(self, input=0.0):
        return ()

    def step(self, state, input):
        return state, self.gain * input


class Outer(System):
    """A System that declares the units of its part: from a speed to its own output."""

    part_units: ClassVar[PartUnits] = {"inner": {"s": "um/s", "v": "[u]"}}

    inner: System

    def init(self, input=0.0):
        return self.inner.init(input)

    def step(self, state, input):
        return self.inner.step(state, input)


def test_units_come_from_the_outer_systems():
    alone = Gain(1.0)
    assert declared(alone, "gain") is dict(declarations(Gain))["gain"]
    assert declared(Outer(alone), "inner.gain").unit == "[u] s/um"
    loop = Feedback(Outer(alone), alone, Affine(), Affine())
    assert declared(loop, "controller.inner.gain").unit == "V s/um"
    # The plant is not part of the controller.
    assert declared(loop, "plant.gain").unit == "[v]/[s]"
    # The disturbance observer commands its controller in um.
    observed = p753.disturbance_observer()
    nested = Feedback(
        eqx.tree_at(lambda c: c.feedback, observed, Outer(alone)),
        *(Affine() for _ in range(3)),
    )
    assert declared(nested, "controller.feedback.inner.gain").unit == "s"


@pytest.mark.parametrize(
    ("controller", "path", "unit"),
    [
        ("p753_sliding_mode", "law.proportional", "V s/um"),
        ("p753_model_reference", "law.integral", "V/(um s)"),
        ("p753_boundary_layer", "law.width", "um/s"),
        ("p753_super_twisting", "law.sign_gain", "V/s"),
        # Behind the observer and the inverse, commands are in um.
        ("p753_disturbance_observer", "feedback.law.derivative", "s^2"),
        ("p753_inversion", "feedback.law.proportional", "s"),
        # Table 8-1 prints P without unit and I in 1/s.
        ("p558_disturbance_observer", "Z.controller.feedback.law.proportional", "1"),
        ("p558_disturbance_observer", "Z.controller.feedback.law.integral", "1/s"),
    ],
)
def test_units_of_switching_laws(controller, path, unit):
    loop = p753.loop(CONTROLLERS[controller]())
    assert declared(loop, f"controller.{path}").unit == unit


def test_units_of_a_pid_behind_an_inverse():
    behind = eqx.tree_at(lambda c: c.feedback, p753.inversion(), p753.pid())
    units = {"proportional": "1", "integral": "1/s", "derivative": "s"}
    for name, unit in units.items():
        assert declared(p753.loop(behind), f"controller.feedback.{name}").unit == unit
        outside = declared(p753.loop(p753.pid()), f"controller.{name}").unit
        assert outside == {"1": "V/um", "1/s": "V/(um s)", "s": "V s/um"}[unit]


@pytest.mark.parametrize("controller", sorted(CONTROLLERS))
def test_no_gain_of_a_loop_has_an_open_unit(controller):
    loop = p753.loop(CONTROLLERS[controller]())
    for path in matching(loop, "controller.*"):
        known = declared(loop, path)
        assert known is None or "[" not in known.unit


@pytest.mark.parametrize(
    "path", ["bare", "bare.gains", "nothing", "corner.x", "gains.7", "gains.0.x", ""]
)
def test_undeclared_paths_have_no_declaration(path):
    assert declared(Bank((1.0,), 5.0, 3.0, 1e-3), path) is None


def test_patterns_match_dots_and_keep_the_order():
    loop = p753.loop(p753.pid())
    every = list(parameters(loop))
    assert matching(loop, "*") == every
    controller = [path for path in every if path.startswith("controller.")]
    assert matching(loop, "controller.*") == controller
    assert matching(loop, "*.integral") == ["controller.integral"]
    assert matching(loop, "controller.Integral") == []
