"""Functions in C of the engine ``native`` against those of NumPy, in long doubles."""

import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilers import assert_simd, needs_gcc
from hypothesis import given
from hypothesis import strategies as st

from piezojax.core.arrays import as_array
from piezojax.core.parameter import parameter
from piezojax.core.system import System
from piezojax.engines import metered, native_math
from piezojax.engines import native_library as library

pytestmark = pytest.mark.skipif(
    library.compiler() is None, reason="there is no C compiler"
)

FUNCTIONS = {
    "exp": (jnp.exp, np.exp),
    "expm1": (jnp.expm1, np.expm1),
    "log": (jnp.log, np.log),
    "log1p": (jnp.log1p, np.log1p),
    "logistic": (jax.nn.sigmoid, lambda x: 1.0 / (1.0 + np.exp(-x))),
    "pow": (operator.pow, np.power),
    "tanh": (jnp.tanh, np.tanh),
}
ROUNDING = 5e-16
"""Largest relative error; of a power for each unit of the logarithm."""

SPECIAL = [0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 800.0, -800.0, 1e308, -1e308]

SAMPLES = 64


class Applied(System):
    """System whose output is a function of its input, and of a ``power`` for "pow"."""

    name: str = eqx.field(static=True)
    power: jax.Array = parameter("1", "second operand", default=0.0)

    def init(self, input=0.0):
        return as_array(0.0)

    def step(self, state, input):
        function, _ = FUNCTIONS[self.name]
        more = (self.power,) if self.name == "pow" else ()
        return input, function(input, *more)


@jax.jit
def applied(systems, inputs):
    """Return the outputs [lanes, samples] of one system per lane."""
    return jax.vmap(
        lambda system: metered(
            system, inputs, system.init(), log=lambda y: y, engine="native"
        )[1]
    )(systems)


def found(name, inputs, powers):
    systems = jax.vmap(lambda power: Applied(name, power))(jnp.array(powers))
    padded = np.resize(np.asarray(inputs, float), -(-len(inputs) // SAMPLES) * SAMPLES)
    rows = [applied(systems, jnp.array(part)) for part in padded.reshape(-1, SAMPLES)]
    return np.concatenate(rows, axis=1)[:, : len(inputs)]


def expected(name, inputs, powers):
    x, function = np.asarray(inputs, np.longdouble), FUNCTIONS[name][1]
    with np.errstate(all="ignore"):
        if name == "pow":
            return np.array([function(x, np.longdouble(power)) for power in powers])
        return np.array([function(x)] * len(powers))


def test_each_function_is_known():
    assert FUNCTIONS.keys() == native_math.FORMS.keys()


class Chosen(Applied):
    """System that needs the function for some of its inputs."""

    def step(self, state, input):
        _, output = super().step(state, input)
        return input, jnp.where(input > state, output, input)


@needs_gcc
@pytest.mark.parametrize("name", FUNCTIONS)
def test_lanes_are_simd_where_some_need_a_function(name, sources):
    systems = jax.vmap(lambda power: Chosen(name, power))(jnp.ones(9))
    applied.lower(systems, jnp.ones(SAMPLES))
    ((source, _),) = sources
    assert native_math.FORMS[name].partition("{a}")[0] in source
    assert_simd(sources[0])


@pytest.mark.parametrize("name", FUNCTIONS)
@given(st.integers(0, 10**6), st.floats(-12.0, 2.1))
def test_functions_are_exact_up_to_rounding(name, seed, decade):
    random = np.random.default_rng(seed)
    inputs = random.normal(size=SAMPLES) * 10.0**decade
    if name in ("log", "pow"):
        inputs = np.exp(np.clip(inputs, -150.0, 150.0))
    if name == "log1p":
        inputs = np.where(inputs < -1.0, -1.0 - 1.0 / inputs, inputs)
    powers = random.uniform(-2.0, 2.0, 3)
    wanted = expected(name, inputs, powers)
    rounding = np.full(wanted.shape, ROUNDING)
    if name == "pow":
        rounding *= 1.0 + np.abs(np.outer(powers, np.log(inputs)))
    error = np.abs(found(name, inputs, powers) - wanted)
    assert np.all(error <= rounding * np.abs(wanted) + 1e-300)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_of_zero_infinity_and_no_number(name):
    powers = [0.0, 1.0, -1.0, 2.0, 3.0, -2.0, 0.5, -0.5, 2.5, np.nan]
    inputs = [x for x in SPECIAL if name != "pow" or x != -np.inf]
    with np.errstate(over="ignore"):
        wanted = expected(name, inputs, powers).astype(float)
    np.testing.assert_allclose(
        found(name, inputs, powers), wanted, rtol=1e-13, atol=1e-300
    )
