import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from oracles.published import HYSTERESIS

from piezojax import (
    Feedback,
    load,
    loop_inputs,
    save,
    series,
    simulate,
)
from piezojax.control import (
    PID,
    InversionControl,
)
from piezojax.dynamics import (
    ARMA,
)
from piezojax.hardware import (
    Saturation,
    Sensor,
)
from piezojax.hysteresis import (
    BashashJalili,
    BoucWen,
    ColemanHodgdon,
    Duhem,
    InverseColemanHodgdon,
    InverseHysteresis,
    NormalisedBoucWen,
    PrandtlIshlinskii,
    ShapedColemanHodgdon,
)

LOWER, UPPER = -20.0, 120.0
A, B, C = HYSTERESIS

MODELS = {
    "trapezoid": ColemanHodgdon(A, B, C),
    "force": BoucWen(0.12, 8e-4, 4e-4),  # its state lacks the field `input`
    "shaped": ShapedColemanHodgdon(
        (0.02, 0.006, -2e-5, 1e-7), (0.11, -3e-4, 2e-6), -0.05
    ),
    "duhem": Duhem(((0.1, 1e-3), (-0.002,)), ((0.0, A), (C,)), substeps=4),
    "bouc_wen": NormalisedBoucWen(0.12, -1.0, 0.04, 0.6, 2.0, substeps=4),
    "bouc_wen_exact": NormalisedBoucWen(0.12, -1.0, 0.04, 0.6, scheme="exact"),
    "extrema": BashashJalili(0.0, 0.0, 100.0, 12.0, -0.45, 0.03, -0.35, 0.05, depth=4),
    "plays": PrandtlIshlinskii((0.08,), (2.0, 7.0, 15.0), (0.02, 0.015, 0.01)),
}


@pytest.fixture(scope="module", params=MODELS)
def inverse(request):
    return InverseHysteresis(MODELS[request.param], LOWER, UPPER)


@jax.jit
def voltages_and_outputs(inverse, wanted):
    def sample(state, f):
        voltage = inverse.solve(state, f)
        state, output = inverse.model.step(state, voltage)
        return state, (voltage, output)

    return jax.lax.scan(sample, inverse.model.init(0.0), wanted)[1]


@settings(max_examples=12)
@given(st.lists(st.floats(0.5, 8.0), min_size=24, max_size=24))
# The last Newton step returns by one rounding error to the end of the bracket.
@example([1.0] * 22 + [6.0, 0.6254148300550961])
def test_inverse_then_model_is_the_identity(inverse, wanted):
    voltages, found = voltages_and_outputs(inverse, jnp.array(wanted))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9)
    assert np.all((voltages > LOWER) & (voltages < UPPER))


def test_steps_of_a_nanometre(inverse):
    # As in a loop: the kink at the last input is close to every solution.
    wanted = 4.0 + 1e-3 * np.cumsum(np.random.default_rng(0).normal(size=24))
    _, found = voltages_and_outputs(inverse, jnp.asarray(wanted))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9)


def test_an_unreachable_output_gives_a_limit(inverse):
    wanted = jnp.array([3.0, 1e3, 4.0, -1e3] * 6)
    voltages, found = voltages_and_outputs(inverse, wanted)
    np.testing.assert_array_equal(voltages[1::4], UPPER)
    np.testing.assert_array_equal(voltages[3::4], LOWER)
    np.testing.assert_allclose(found[0::2], wanted[0::2], rtol=0.0, atol=1e-9)


def test_the_numerical_inverse_equals_the_closed_form():
    wanted = jnp.asarray(np.random.default_rng(1).uniform(0.5, 8.0, 24))
    closed = InverseColemanHodgdon(MODELS["trapezoid"])
    numerical = InverseHysteresis(MODELS["trapezoid"], LOWER, UPPER)
    np.testing.assert_allclose(
        voltages_and_outputs(numerical, wanted)[0],
        voltages_and_outputs(closed, wanted)[0],
        rtol=0.0,
        atol=1e-8,
    )


@jax.jit
@jax.value_and_grad
def weighted(inverse_and_wanted):
    inverse, wanted = inverse_and_wanted

    def sample(state, f):
        voltage = inverse.solve(state, f)
        return inverse.model.step(state, voltage)[0], voltage

    voltages = jax.lax.scan(sample, inverse.model.init(10.0), wanted)[1]
    return jnp.sin(1.0 + jnp.arange(voltages.size)) @ voltages


DIFFERENTIATED = ["shaped", "extrema"]


@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_gradients_equal_finite_differences(name):
    wanted = jnp.array([3.0, 6.0, 2.0, 2.5, 2.2, 5.0])
    arguments = (InverseHysteresis(MODELS[name], LOWER, UPPER), wanted)
    leaves, tree = jax.tree.flatten(arguments)
    found = jax.tree.leaves(weighted(arguments)[1])
    for i, leaf in enumerate(leaves):
        for unit in np.eye(leaf.size).reshape(-1, *leaf.shape):
            step = 1e-5 * (np.max(np.abs(leaf)) or 1.0)
            above, below = (
                float(
                    weighted(
                        jax.tree.unflatten(
                            tree, [*leaves[:i], leaf + by * unit, *leaves[i + 1 :]]
                        )
                    )[0]
                )
                for by in (step, -step)
            )
            np.testing.assert_allclose(
                np.sum(found[i] * unit),
                (above - below) / (2.0 * step),
                rtol=1e-4,
                atol=1e-6,
            )


@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_gradient_at_rest_and_out_of_reach_is_finite(name):
    rest = float(MODELS[name].step(MODELS[name].init(10.0), 10.0)[1])
    wanted = jnp.array([rest, rest, 1e3, 1e3, -1e3, rest])
    inverse = InverseHysteresis(MODELS[name], LOWER, UPPER)
    found = weighted((inverse, wanted))[1]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
    np.testing.assert_array_equal(found[1] != 0.0, np.abs(wanted) < 100.0)


def test_the_inverse_at_rest_stays_at_rest():
    inverse = InverseHysteresis(MODELS["shaped"], LOWER, UPPER)
    state = inverse.init(4.0)
    after, voltage = inverse.step(state, 4.0)
    np.testing.assert_allclose(state.output, 4.0, atol=1e-9)
    np.testing.assert_allclose(voltage, state.input, atol=1e-7)
    np.testing.assert_allclose(after.output, 4.0, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "end"),
    [
        (NormalisedBoucWen(0.05, -1.0, 0.05, 0.6), "branch"),  # 0.05 - 2 sigma rho < 0
        (ColemanHodgdon(0.02, 0.12, -0.05), "branch"),  # a > 2 b |c|
        (PrandtlIshlinskii((), (5.0,), (0.1,)), "branch"),  # constant after a turn
        (
            Duhem(((-0.1,),), ((0.0,),)),
            "reverse the sign of the displacement, or of the voltage, in the record or "
            "in the wiring",
        ),
    ],
)
def test_a_model_that_is_not_monotone_has_no_inverse(model, end):
    message = rf"between .* V the output goes from .* rises .*{end}$"
    with pytest.raises(ValueError, match=message):
        InverseHysteresis(model, LOWER, UPPER)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lower": np.nan}, "lower is nan"),
        ({"lower": 120.0}, "lower must be below upper"),
        ({"iterations": 0}, "iterations is 0; it must be finite and at least 1"),
    ],
)
def test_bad_parameters_are_refused(changed, message):
    good = {"model": MODELS["trapezoid"], "lower": LOWER, "upper": UPPER}
    with pytest.raises(ValueError, match=message):
        InverseHysteresis(**{**good, **changed})


def test_the_inverse_works_in_the_controller_of_the_closed_form():
    model = MODELS["trapezoid"]
    plant = series(hysteresis=model, dynamics=ARMA((0.3, 0.05), (0.6, 0.04, 0.01)))
    pid = PID(0.2, 500.0, dt=1 / 20_000)
    inputs = loop_inputs(2.0 * jnp.sin(0.06 * jnp.arange(100)))

    def tracked(inverse):
        controller = InversionControl(pid, inverse)
        loop = Feedback(controller, plant, Saturation(LOWER, UPPER), Sensor(0.0))
        run = jax.jit(lambda loop: simulate(loop, inputs, loop.init(0.0, 0.0))[1])
        return run(loop).displacement

    np.testing.assert_allclose(
        tracked(InverseHysteresis(model, LOWER, UPPER)),
        tracked(InverseColemanHodgdon(model)),
        rtol=0.0,
        atol=1e-9,
    )


def test_the_inverse_is_saved_and_loaded(tmp_path):
    inverse = InverseHysteresis(MODELS["bouc_wen"], LOWER, UPPER, iterations=9)
    save(inverse, tmp_path / "inverse.json")
    back = load(tmp_path / "inverse.json")
    assert jax.tree.structure(back) == jax.tree.structure(inverse)
