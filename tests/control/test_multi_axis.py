"""The 3-DOF loops of chapters 7 and 8 against loops from their equations."""

from functools import cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import three_dof

from piezojax import (
    load,
    loop_inputs,
    save,
    simulate,
)
from piezojax.catalog import p558
from piezojax.catalog import p558_control as catalog
from piezojax.core import paths
from piezojax.core.axes import (
    PerAxis,
    PerAxisMetric,
    as_matrix,
    as_rows,
    check_square,
    packed,
    product,
)
from piezojax.core.feedback import LoopInput, Observation
from piezojax.core.metrics import (
    Tracking,
)
from piezojax.dynamics import (
    ARMA,
    Channel,
    Channels,
    MatrixARMA,
    StateSpace,
    channels_of,
    observability_form,
)

SAMPLES = 500
TIME = three_dof.T * np.arange(SAMPLES + 1)
DRAWS = np.random.default_rng(7).standard_normal((SAMPLES, 3))
HELD = np.array([5.0, 10.0, -20.0])

# All three axes move at once; they start at zero like the plain loops.
MOVING = np.stack(
    [
        8.0 * np.sin(2 * np.pi * 3.0 * TIME),
        10.0 * np.sin(2 * np.pi * 5.0 * TIME) * np.minimum(5.0 * TIME, 1.0),
        6.0 - 6.0 * np.cos(2 * np.pi * 2.0 * TIME),
    ],
    axis=1,
)


class Published(NamedTuple):
    controller: eqx.Module
    name: str
    options: dict


DERIVATIVE = {"multi-axis": [4e-4, 6e-4, 8e-4], "nominal": [1e-4, 2e-4, 3e-4]}
"""D in s: the printed ones are zero, which would hide a wrong sign."""


def derived(controller, kind):
    """Return a controller with the D of DERIVATIVE on its axes."""
    names = [n for n in paths.parameters(controller) if "derivative" in n]
    return paths.replace(controller, dict(zip(names, DERIVATIVE[kind], strict=True)))


def with_derivative(gains, kind):
    """Return the gains of the plain loop with DERIVATIVE."""
    return {**gains, "D": DERIVATIVE[kind]}


def passing(controller):
    """Return a filtered controller whose filters do not change the signal."""
    names = [n for n in paths.parameters(controller) if "filter." in n]
    values = {name: float(name.endswith("alpha")) for name in names}
    return paths.replace(controller, values)


# One program serves a controller without a filter: its filter changes nothing.
CASES = {
    "PID": Published(catalog.pid(), "pid", {}),
    "multi-axis, dynamic, filtered": Published(catalog.multi_axis(), "pid_smc", {}),
    "multi-axis, step": Published(
        passing(catalog.multi_axis("step")),
        "pid_smc",
        {"gains": "step", "alpha_beta": False},
    ),
    "multi-axis, derivative": Published(
        derived(catalog.multi_axis(), "multi-axis"),
        "pid_smc",
        {"gains": with_derivative(three_dof.PID_SMC_GAINS["dynamic"], "multi-axis")},
    ),
    "nominal": Published(catalog.nominal(), "nominal_smc", {"arx": "matched"}),
    "nominal, derivative": Published(
        derived(catalog.nominal(), "nominal"),
        "nominal_smc",
        {
            "arx": "matched",
            "gains": with_derivative(three_dof.DOB_SMC_GAINS["nominal_smc"], "nominal"),
        },
    ),
    "observer": Published(
        catalog.disturbance_observer(), "dob_smc", {"arx": "matched"}
    ),
    "observer, printed": Published(
        passing(catalog.disturbance_observer("printed", correction=0.0)),
        "dob_smc",
        {"arx": "printed", "alpha_beta": False, "with_epsilon": False},
    ),
}
MODEL_BASED = ("PID", "multi-axis, dynamic, filtered", "multi-axis, step")


@jax.jit
def run(loop, references, draws):
    def one(reference, draws):
        following = tuple(reference[1:, axis] for axis in range(3))
        inputs = LoopInput(following, tuple(draws[:, axis] for axis in range(3)))
        return packed(simulate(loop, inputs, loop.init(reference[0]))[1])

    return jax.vmap(one)(references, draws)


@cache
def samples_of(name):
    """Return the outputs of the package for MOVING with noise, and HELD without."""
    references = np.stack([MOVING, np.broadcast_to(HELD, MOVING.shape)])
    draws = np.stack([DRAWS, np.zeros_like(DRAWS)])
    return run(catalog.loop(CASES[name].controller), references, draws)


@pytest.mark.parametrize("name", CASES)
def test_the_loop_equals_the_published_one(name):
    case = CASES[name]
    noise = DRAWS * [0.0008, 0.013, 0.013]
    expected = three_dof.simulate(case.name, MOVING, noise, **case.options)
    samples = samples_of(name)
    assert np.all(np.abs(expected["y"]).max(axis=0) > 5.0)
    for log, column in (("displacement", "y"), ("measured", "z"), ("command", "u")):
        np.testing.assert_allclose(
            getattr(samples, log)[0], expected[column], rtol=0.0, atol=1e-9, err_msg=log
        )


@pytest.mark.parametrize("name", MODEL_BASED)
def test_a_start_at_rest_stays_at_rest(name):
    samples = samples_of(name)
    np.testing.assert_allclose(
        samples.displacement[1], np.broadcast_to(HELD, (SAMPLES, 3)), atol=1e-8, rtol=0
    )
    command = samples.command[1]
    np.testing.assert_allclose(command, command[:1].repeat(SAMPLES, 0), atol=1e-7)


@pytest.mark.parametrize("name", CASES)
def test_a_start_at_a_reference_is_without_a_bump(name):
    samples = samples_of(name)
    A, B, C = three_dof.stacked()
    holding = np.linalg.solve(C @ np.linalg.solve(np.eye(9) - A, B), HELD)
    # The nominal model of chapter 8 is not exactly the stage: its integral moves.
    np.testing.assert_allclose(samples.command[1, 0], holding, rtol=0.0, atol=5e-5)
    np.testing.assert_allclose(samples.displacement[1, 0], HELD, rtol=0.0, atol=1e-8)


def test_in_steady_state_u1_decouples_the_axes():
    # T1(1) = I is the DC gain from desired outputs to those of the model.
    A, B, C = three_dof.stacked()
    dc_gain = C @ np.linalg.solve(np.eye(9) - A, B)
    assert (
        np.abs(dc_gain - np.diag(np.diag(dc_gain))).max() > 1e-3
    )  # the model is coupled
    controller = catalog.multi_axis(filtered=False)
    none = (jnp.zeros(()),) * 3
    for axis in range(3):
        desired = tuple(jnp.asarray(float(axis == i)) for i in range(3))
        seen = Observation(desired, desired, desired, none)
        forward = np.stack(controller.init(seen).forward[0])
        np.testing.assert_allclose(dc_gain @ forward, np.eye(3)[axis], atol=1e-12)


# Gradients

START, LENGTH = 20, 80
WEIGHTS = np.array([1.0, 0.3, 0.2])

LEAVES = {
    "multi-axis": (
        catalog.loop(catalog.multi_axis(filtered=False)),
        {
            "controller.law.proportional.0": 1e-4,
            "controller.law.integral.1": 1e-2,
            "controller.reaching.2": 1e-5,
            "controller.decoupling.1.0": 1e-5,
            "controller.surface.0.0": 1e-5,
            "controller.model.moving.0.0.0": 1e-6,
            "controller.model.autoregressive.1.1.1": 1e-6,
            "controller.reference_model.Z.frequency": 1e-2,
        },
    ),
}


@pytest.mark.parametrize("name", LEAVES)
def test_gradients_equal_finite_differences(name):
    loop, widths = LEAVES[name]
    values = jnp.stack([paths.get(loop, path) for path in widths])
    inputs = loop_inputs(jnp.asarray(MOVING[:LENGTH]), jnp.asarray(DRAWS[:LENGTH]))
    metric = PerAxisMetric(Tracking(START), 3)
    # At rest at zero the state is zero, whatever the gains.
    shapes = jax.eval_shape(loop.init, np.zeros(3))
    rest = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def rms(values):
        changed = paths.replace(loop, dict(zip(widths, values, strict=True)))
        figures = simulate(changed, inputs, rest, metric=metric)[1]
        return figures.rms_error @ WEIGHTS

    steps = np.diag(list(widths.values()))
    around = np.concatenate([values[None], values + steps, values - steps])
    found, slopes = jax.jit(jax.vmap(jax.value_and_grad(rms)))(around)
    slopes = slopes[0]
    upper, lower = np.split(np.asarray(found[1:]), 2)
    expected = (upper - lower) / (2.0 * np.diag(steps))
    assert np.all(expected != 0.0)
    np.testing.assert_allclose(slopes, expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("name", ["multi-axis, dynamic, filtered"])
def test_compiled_steps_equal_eager_ones(name):
    controller = CASES[name].controller

    def two_steps(reference):
        held = tuple(reference)
        seen = Observation(held, held, held, held)
        state, commands = controller.init(seen), []
        for k in range(2):
            moved = tuple(r + 0.1 * (k + axis) for axis, r in enumerate(held))
            seen = Observation(held, moved, moved, held)
            state, command = controller.step(state, seen)
            commands.append(jnp.stack(command))
        return jnp.stack(commands)

    eager = two_steps(jnp.asarray(HELD))
    compiled = jax.jit(two_steps)(jnp.asarray(HELD))
    np.testing.assert_allclose(compiled, eager, rtol=1e-11, atol=1e-11)
    assert np.abs(np.diff(eager, axis=0)).min() > 0.0


@pytest.mark.parametrize("name", CASES)
def test_a_loop_is_saved_and_loaded(name, tmp_path):
    loop = catalog.loop(CASES[name].controller)
    save(loop, tmp_path / "loop.json")
    assert eqx.tree_equal(load(tmp_path / "loop.json"), loop)


# Parts of the controllers


def test_observability_form_has_the_response_of_the_state_space():
    A, B, C = three_dof.stacked()
    model = observability_form(p558.model("7"))
    impulse = np.zeros((6, 3))
    for axis in range(3):
        pulse = impulse.copy()
        pulse[0, axis] = 1.0
        state = model.init(tuple(jnp.zeros(3)))
        outputs = jnp.stack(simulate(model, tuple(pulse.T), state)[1], axis=1)
        expected = [(C @ np.linalg.matrix_power(A, k) @ B)[:, axis] for k in range(6)]
        np.testing.assert_allclose(outputs, expected, rtol=0.0, atol=1e-12)
    dc_gain = C @ np.linalg.solve(np.eye(9) - A, B)
    np.testing.assert_allclose(model.dc_gain(), dc_gain, rtol=0.0, atol=1e-11)


def test_a_product_of_rows():
    rng = np.random.default_rng(0)
    matrix, vector = rng.normal(size=(3, 4)), rng.normal(size=4)
    found = product(as_rows(matrix), tuple(vector))
    np.testing.assert_allclose(found, matrix @ vector, rtol=1e-12)


# Refused input

EYE = np.eye(3)
MODEL = observability_form(p558.model("7"))
MULTI = catalog.multi_axis(filtered=False)
NOMINAL = catalog.nominal(filtered=False).parts[0]
CHANNEL = Channel([[0.5]], [1.0], [[1.0], [0.5], [0.1]], 2e-3)


def changed(controller, **values):
    fields = {name: getattr(controller, name) for name in vars(controller)}
    return type(controller)(**(fields | values))


def state_space(n, inputs, outputs, direct=0.0):
    A = np.diag(np.linspace(0.2, 0.8, n))
    D = np.full((outputs, inputs), direct)
    return StateSpace(A, np.ones((n, inputs)), np.ones((outputs, n)), D, 2e-3)


def test_a_diagonal_controls_as_its_matrix():
    law = {"proportional": (0.5, 1.0, 2.0), "integral": (30.0, 50.0, 40.0)}
    law["derivative"] = DERIVATIVE["multi-axis"]
    others = {"reaching": (0.9, 0.5, 0.4), "decoupling": (-0.3, -0.2, -0.3)}
    surface = ((0.49,) * 3, (-1.4, -1.3, -1.2), (1.0,) * 3)

    def run(form):
        controller = changed(
            MULTI,
            law=changed(MULTI.law, **{name: form(gain) for name, gain in law.items()}),
            surface=[form(gains) for gains in surface],
            **{name: form(gain) for name, gain in others.items()},
        )
        inputs = loop_inputs(jnp.asarray(MOVING[:LENGTH]), jnp.asarray(DRAWS[:LENGTH]))
        loop = catalog.loop(controller)
        rest = loop.init(tuple(map(jnp.asarray, (0.0,) * 3)))
        return packed(simulate(loop, inputs, rest)[1]).command

    np.testing.assert_allclose(run(tuple), run(np.diag), rtol=1e-12, atol=1e-12)


REFUSED = [
    (lambda: PerAxis((NOMINAL,), ("Z", "Rx")), r"1 parts but names \('Z', 'Rx'\)"),
    (lambda: as_rows([[1.0, 2.0], [1.0]]), "rows of lengths 2, 1; they must be equal"),
    (lambda: as_rows([]), "rows of lengths none"),
    (lambda: as_matrix(()), "rows of lengths none"),
    (lambda: changed(MULTI, reaching=(0.5, 0.5)), "reaching is 2 x 2; .* 3 x 3"),
    (
        lambda: changed(MULTI, law=changed(MULTI.law, integral=(1.0,) * 4)),
        "law.integral is 4 x 4; .* 3 x 3",
    ),
    (
        lambda: check_square("gain", as_rows(np.ones((2, 3))), 3),
        "gain is 2 x 3; it must be 3 x 3",
    ),
    (
        lambda: check_square("gain", as_rows([[np.nan]]), 1),
        "gain is nan; it must be finite",
    ),
    (lambda: changed(CHANNEL, A=EYE), "A is 3 x 3; it must be 1 x 1"),
    (
        lambda: changed(CHANNEL, C=[[1.0, 2.0]]),
        "C has 2 columns; it must have one for each of 1 states",
    ),
    (lambda: changed(CHANNEL, B=[np.inf]), "B is inf; it must be finite"),
    (lambda: changed(CHANNEL, dt=0.0), "dt in s is 0; .* above 0"),
    (
        lambda: Channels((CHANNEL, changed(CHANNEL, dt=1e-3))),
        r"channels differ in \(outputs, sample time\): \[\(3, 0.001\), \(3, 0.002\)\]",
    ),
    (lambda: Channels(()), "there must be at least one"),
    (lambda: channels_of([state_space(2, 2, 2)]), "2 inputs; it must have 1"),
    (lambda: channels_of([state_space(2, 1, 2, 1.0)]), "D is not zero"),
    (lambda: MatrixARMA([EYE], [], 2e-3), "1 autoregressive and 0 moving matrices"),
    (
        lambda: MatrixARMA([EYE], [np.ones((3, 2))], 2e-3),
        r"moving\[0\] is 3 x 2; it must be 3 x 3",
    ),
    (
        lambda: MatrixARMA([np.eye(2)], [EYE], 2e-3),
        r"autoregressive\[0\] is 2 x 2; it must be 3 x 3",
    ),
    (lambda: MatrixARMA([EYE], [EYE], -1.0), "dt in s is -1; .* above 0"),
    (lambda: observability_form(state_space(4, 1, 2)), "1 inputs and 2 outputs"),
    (lambda: observability_form(state_space(4, 2, 2, 0.1)), "D is not zero"),
    (lambda: observability_form(state_space(4, 2, 2)), r"\(7.4\) is singular"),
    (lambda: changed(MULTI, decoupling=np.eye(2)), "decoupling is 2 x 2; .* 3 x 3"),
    (lambda: changed(MULTI.law, integral=EYE * np.nan), "integral .* is nan"),
    (
        lambda: changed(MULTI, law=changed(MULTI.law, derivative=np.eye(2))),
        "law.derivative is 2 x 2; .* 3 x 3",
    ),
    (lambda: changed(MULTI, surface=[EYE]), "surface holds 1 matrices; .* hold 3"),
    (
        lambda: changed(MULTI, surface=[EYE, EYE, np.eye(2)]),
        r"surface\[2\] is 2 x 2; it must be 3 x 3",
    ),
    (
        lambda: changed(NOMINAL, model=ARMA((0.5,), (1.0, 0.0, 0.0))),
        "the model has 1 a and 3 b coefficients; it must have 2 and 3",
    ),
    (lambda: changed(NOMINAL, error_weight=0.0), "error_weight is 0; .* above 0"),
    (lambda: changed(NOMINAL, control_weight=-1.0), "control_weight is -1"),
    (lambda: changed(NOMINAL.law, proportional=np.nan), "proportional .* is nan"),
    (lambda: changed(NOMINAL.law, dt=0.0), "dt in s is 0; .* above 0"),
    (
        lambda: changed(NOMINAL, reading="true_state"),
        r"reading 'true_state'; it must be one of \['nominal_state', 'measured_state'",
    ),
    (partial(catalog.multi_axis, "fast"), r"gains 'fast'; .* \['step', 'dynamic'\]"),
    (partial(catalog.nominal, "true"), "ARX model 'true'; it must be one of"),
]


@pytest.mark.parametrize(("make", "message"), REFUSED)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
