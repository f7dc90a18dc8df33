"""Reduced models, and models whose order n is not a multiple of q."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag

import piezojax as pj
from piezojax.analysis.stability.margins import linear_axes
from piezojax.catalog import p558, p558_control
from piezojax.core.axes import PerAxis, packed
from piezojax.dynamics import (
    SecondOrderLag,
    StateSpace,
    balanced_reduction,
    fast_part,
    matrix_arma,
    observability_form,
)

WHOLE = p558.model("6")  # 15 states, 3 axes


def impulse_response(model, samples):
    """Return C A^s B [samples, q, q], by plain multiplication."""
    A, state, C = (np.asarray(matrix) for matrix in (model.A, model.B, model.C))
    found = []
    for _ in range(samples):
        found.append(C @ state)
        state = A @ state
    return np.array(found)


def run(system, samples):
    """Return the impulse response of a system with tuples, for each input in turn."""
    columns = []
    for axis in range(3):
        inputs = tuple(
            jnp.zeros(samples).at[0].set(1.0 if i == axis else 0.0) for i in range(3)
        )
        _, outputs = pj.simulate(system, inputs, system.init((jnp.zeros(()),) * 3))
        columns.append(np.asarray(packed(outputs)))
    return np.stack(columns, axis=-1)


def companion(form):
    """Return the block companion matrix of a MatrixARMA."""
    A = [np.array(matrix) for matrix in form.autoregressive]
    q, p = len(A[0]), len(A)
    matrix = np.eye(p * q, k=-q)
    matrix[:q] = np.hstack(A)
    return matrix


@pytest.fixture(scope="module", params=[7, 8])
def reduced(request):
    return balanced_reduction(WHOLE, request.param)


def test_hankel_singular_values_equal_those_of_the_hankel_matrix():
    h = impulse_response(WHOLE, 599)
    hankel = h[np.arange(300)[:, None] + np.arange(300)]
    whole = hankel.transpose(0, 2, 1, 3).reshape(900, 900)
    singular = np.linalg.svd(whole, compute_uv=False)[:15]
    ours = balanced_reduction(WHOLE, 15).hankel_singular_values
    np.testing.assert_allclose(ours, singular, rtol=1e-6, atol=1e-9)


def test_the_difference_is_within_its_bounds(reduced):
    order = reduced.model.order
    assert np.abs(reduced.model.poles()).max() < 1.0
    angles = np.concatenate([[0.0], np.geomspace(1e-4, np.pi, 2_000)])
    z = np.exp(1j * angles)[:, None, None]
    whole, less = (
        model.C @ np.linalg.solve(z * np.eye(model.order) - model.A, model.B + 0j)
        for model in (WHOLE, reduced.model)
    )
    worst = np.linalg.norm(whole - less, 2, axis=(1, 2)).max()
    left_out = reduced.hankel_singular_values[order:]
    assert reduced.error_bound == pytest.approx(2.0 * left_out.sum(), rel=1e-12)
    # No model of this order has a smaller error than the largest omitted value.
    assert left_out[0] < worst < reduced.error_bound


def test_keeping_all_states_changes_nothing():
    kept = balanced_reduction(WHOLE, 15)
    assert kept.error_bound == 0.0
    np.testing.assert_allclose(
        impulse_response(kept.model, 200), impulse_response(WHOLE, 200), atol=1e-9
    )


@pytest.mark.parametrize("more", [0, 1])
def test_any_number_of_states_in_observability_form(reduced, more):
    model = reduced.model
    form = observability_form(model, 3 + more)
    np.testing.assert_allclose(run(form, 300), impulse_response(model, 300), atol=1e-9)
    np.testing.assert_allclose(form.dc_gain(), model.dc_gain(), atol=1e-9)
    # the poles of the model, and additional stable ones
    poles = np.linalg.eigvals(companion(form))
    for pole in model.poles():
        nearest = np.argmin(np.abs(poles - pole))
        assert abs(poles[nearest] - pole) < 1e-6
        poles = np.delete(poles, nearest)
    assert len(poles) == 3 * (3 + more) - model.order
    assert np.abs(poles).max() < 0.8


@pytest.mark.parametrize(("chapter", "lags"), [("7", 3), ("6", 5)])
def test_as_many_states_as_rows_give_the_printed_form(chapter, lags):
    model = p558.model(chapter)
    A, C = np.asarray(model.A), np.asarray(model.C)
    form = observability_form(model)
    assert len(form.moving) == lags
    F = np.vstack([C @ np.linalg.matrix_power(A, i) for i in range(lags)])
    last = (F @ A @ np.linalg.inv(F))[-3:]
    ours = np.hstack([np.array(x) for x in reversed(form.autoregressive)])
    # F of (6.23)-(6.25) has a condition number of 2e6.
    np.testing.assert_allclose(ours, last, atol=1e-9 if chapter == "7" else 1e-6)
    np.testing.assert_allclose(run(form, 300), impulse_response(model, 300), atol=1e-9)


@pytest.mark.parametrize("order", [7, 8])
def test_a_controller_on_a_reduced_model_stabilises_the_stage(order):
    model = observability_form(balanced_reduction(WHOLE, order).model)
    unit = np.eye(3)
    controller = pj.control.MultiAxisSlidingMode(
        pj.control.SwitchingPID(0.5 * unit, 20.0 * unit, 0.0 * unit, dt=p558.DT),
        reaching=0.9 * unit,
        decoupling=-0.3 * unit,
        surface=(unit, unit, unit),
        model=model,
        reference_model=PerAxis((SecondOrderLag(200.0, 0.9, p558.DT),) * 3),
    )
    # With 7 states the controller stabilises the stage of 15, with 8 only its model.
    plant = p558_control.stage("6") if order == 7 else model
    loop = p558_control.loop(controller, plant=plant)
    linear, *_ = linear_axes(loop, (0.0, 0.0, 0.0))
    assert np.abs(np.linalg.eigvals(linear.closed())).max() < 0.99


def test_bad_reductions_are_refused():
    with pytest.raises(ValueError, match="order is 16; it must be between 1 and 15"):
        balanced_reduction(WHOLE, 16)
    gain = StateSpace(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]], 1.0
    )
    with pytest.raises(ValueError, match="the model has no states; a reduction keeps"):
        balanced_reduction(gain, 1)
    unstable = StateSpace(1.1 * np.eye(3), np.eye(3), np.eye(3), np.zeros((3, 3)), 1e-3)
    with pytest.raises(ValueError, match=r"a pole at radius 1\.1; only a stable model"):
        balanced_reduction(unstable, 2)
    idle = StateSpace(block_diag(0.5, 0.4), [[1.0], [0.0]], [[1.0, 1.0]], [[0.0]], 1e-3)
    with pytest.raises(ValueError, match="order is 2; only 1 states are controllable"):
        balanced_reduction(idle, 2)
    with pytest.raises(ValueError, match="lags is 4; 15 states and 3 outputs need 5"):
        observability_form(WHOLE, 4)
    twice = StateSpace(
        0.5 * np.eye(4), np.eye(4)[:, :2], np.eye(4)[:2], np.zeros((2, 2)), 1e-3
    )
    with pytest.raises(ValueError, match="cannot be observed in 2 samples"):
        observability_form(twice)


def response(model, angle):
    z = np.exp(1j * angle)
    A, B, C, D = (np.asarray(m) for m in (model.A, model.B, model.C, model.D))
    return (C @ np.linalg.solve(z * np.eye(len(A)) - A, B + 0j) + D)[0, 0]


def single(poles, residues, through):
    """Return sum_i residues[i] / (z - poles[i]) + through, in mixed coordinates."""
    change = np.random.default_rng(3).normal(size=(len(poles),) * 2)
    return StateSpace(
        change @ np.diag(poles) @ np.linalg.inv(change),
        change @ np.ones((len(poles), 1)),
        np.array([residues]) @ np.linalg.inv(change),
        [[through]],
        1e-3,
    )


def test_only_a_mode_that_was_added_is_blamed():
    nearly = single([1.0 - 1e-15, 0.9], [1.0, 1.0], 0.0)
    assert len(observability_form(nearly).moving) == 2  # none was added
    lag = single([0.5], [0.5], 0.0)
    # (z - 0.5) (z - 1.2)
    with pytest.raises(ValueError, match=r"to fill 2 lags has radius 1\.2; it must"):
        matrix_arma._check_added(lag, [np.array([[1.7]]), np.array([[-0.6]])])


def test_creep_and_memory_are_not_in_the_fast_part():
    # a lag of 3 samples, creep of 10 % in 1000 and 5 % in 5000 samples, a memory
    lag, creep, slower = np.exp([-1 / 3, -1 / 1000, -1 / 5000])
    whole = single(
        [lag, creep, slower, 1.0],
        [1 - lag, 0.1 * (1 - creep), 0.05 * (1 - slower), 0.0],
        0.2,
    )
    fast = fast_part(whole, 0.1)
    np.testing.assert_allclose(fast.poles(), [lag], rtol=1e-9)
    assert float(fast.dc_gain()[0, 0]) == pytest.approx(1.2, rel=1e-6)
    assert response(fast, 0.1) == pytest.approx(response(whole, 0.1), rel=0.02)


def test_a_slow_plant_keeps_its_dynamics():
    # The lag is slow, but it determines the response at the angle; creep does not.
    lag, creep = np.exp([-1 / 300, -1 / 30_000])
    whole = single([lag, creep], [1 - lag, 0.1 * (1 - creep)], 0.0)
    np.testing.assert_allclose(fast_part(whole, 0.1).poles(), [lag], rtol=1e-9)
    alone = single([lag], [1 - lag], 0.0)
    assert fast_part(alone, 0.1) is alone
    integrator = single([1.0], [0.1], 0.0)
    assert fast_part(integrator, 0.1) is integrator


def test_unconnected_states_are_removed():
    lag = single([0.7], [0.3], 0.0)
    assert pj.dynamics.reduced(lag, 2) is lag
    hidden = single([0.7, 0.5, 0.2], [0.3, 0.0, 0.0], 0.1)
    found = pj.dynamics.reduced(hidden, 2)
    np.testing.assert_allclose(found.poles(), [0.7], rtol=1e-9)
    assert response(found, 0.4) == pytest.approx(response(hidden, 0.4), rel=1e-9)
    three = single([0.9, 0.5, -0.3], [0.1, 0.2, 0.05], 0.1)
    expected = balanced_reduction(three, 2).model
    np.testing.assert_allclose(pj.dynamics.reduced(three, 2).A, expected.A)


def test_a_difference_equation_has_the_same_response():
    model = single([0.9, 0.5, -0.3], [0.1, 0.2, 0.05], 0.1)
    arma = model.as_arma()
    z = np.exp(0.4j)
    numerator = np.polyval(arma.moving, z)
    denominator = np.polyval([1.0, *(-float(a) for a in arma.autoregressive)], z)
    assert numerator / denominator == pytest.approx(response(model, 0.4), rel=1e-9)
    with pytest.raises(ValueError, match="the model has 3 inputs and 3 outputs"):
        WHOLE.as_arma()
