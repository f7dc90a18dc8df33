"""The objective of a search from given figures, against its formulas in NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.core.metrics import TrackingFigures
from piezojax.solve.problem import FAILED_LOSS
from piezojax.study import Study, build
from piezojax.tuning.data import make_data
from piezojax.tuning.objective import Objective, StepTest

STUDY = {
    "title": "integral action on a lag",
    "rate": 20_000.0,
    "plant": {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": 5e-5},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.01},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 500.0, "dt": 5e-5},
    "references": {"tune": ["SIN50", "SIN20"], "duration": 0.02, "settle": 0.01},
    "parameters": {
        "controller.integral": {"lower": 20.0, "upper": 2e4, "scale": "log"}
    },
    "objective": {"noise_draws": 3},
}
PLANTS, REFERENCES, DRAWS = 4, 2, 3
SPAN = 140.0


@pytest.fixture(scope="module")
def objective():
    case = build(Study.model_validate(STUDY), "study.toml")
    scale = jnp.array([[0.5, 2.0]] * PLANTS)
    return Objective(
        case.loop, case.space, make_data(case).tuning, scale, jnp.asarray(SPAN), 200
    )


@pytest.fixture(scope="module")
def figures():
    shape = PLANTS, REFERENCES, DRAWS
    random = np.random.default_rng(4)
    error, effort, slew = (jnp.asarray(random.uniform(0.1, 3.0, shape)) for _ in "eus")
    none = jnp.zeros(shape)
    return TrackingFigures(error, none, effort, slew, none, none)


def normalised(figures):
    """Return the RMS error over the draws, relative to the scale [plants, 2]."""
    errors = np.asarray(figures.rms_error)
    return np.sqrt(np.mean(errors**2, axis=2)) / np.array([0.5, 2.0])


@pytest.mark.parametrize("weights", [None, (3.0, 1.0)])
def test_references_are_joined_by_the_named_rule(objective, figures, weights):
    shares = np.array([0.5, 0.5] if weights is None else [0.75, 0.25])
    parts = normalised(figures)
    largest = np.log(np.sum(2.0 * shares * parts**20.0, axis=1)) / 20.0
    expected = {
        "mean_square": np.mean(parts**2 @ shares),
        "geometric_mean": np.mean(np.log(parts) @ shares),
        "worst": np.mean(largest),
    }
    for aggregate, value in expected.items():
        given = dataclasses.replace(
            objective,
            aggregate=aggregate,
            weights=None if weights is None else jnp.array(weights),
        )
        assert given._error(figures) == pytest.approx(value, rel=1e-9)


def test_a_resting_trace_counts_above_its_scale_only(objective, figures):
    small = figures._replace(rms_error=0.1 * figures.rms_error)
    resting = dataclasses.replace(objective, resting=(False, True))
    parts = normalised(small)
    above = (1.0 + parts[:, 1] ** 20.0) ** (1.0 / 20.0)
    expected = np.mean(0.5 * np.log(parts[:, 0]) + 0.5 * np.log(above))
    assert resting._error(small) == pytest.approx(expected, rel=1e-9)


def test_effort_and_slew_are_shares_of_the_voltage_span(objective, figures):
    given = dataclasses.replace(objective, effort_weight=2.0, slew_weight=0.5)
    effort, slew = given._prices(figures)
    assert effort[0] * effort[1] == pytest.approx(
        2.0 * np.mean(figures.rms_effort) / SPAN
    )
    assert slew[0] * slew[1] == pytest.approx(0.5 * np.mean(figures.rms_slew) / SPAN)


def test_without_weights_effort_and_slew_cost_nothing(objective):
    loss, verdict = objective.value_and_verdict(jnp.array([0.5]))
    error = objective._error(objective.figures(jnp.array([0.5])).tracking)
    assert loss == verdict.loss == pytest.approx(float(error), rel=1e-12)


def test_a_run_at_a_voltage_limit_fails(objective, figures):
    railed = figures._replace(saturated=figures.saturated.at[1, 0, 2].set(0.91))
    assert objective._error(railed) == np.inf
    brief = figures._replace(saturated=figures.saturated + 0.9)
    assert objective._error(brief) == objective._error(figures)


def test_lanes_and_constraints_are_counted(objective):
    assert objective.lanes == PLANTS * REFERENCES * DRAWS
    assert objective.constraints == 0
    limited = objective.with_limits({"effort": 50.0})
    assert limited.constraints == PLANTS
    found = limited.value_and_verdict(jnp.array([0.5]))[1].violations
    # The loop has one plant; the scale was given for PLANTS.
    assert found.shape == (1,)


def test_limits_on_steps_use_the_step_test(objective):
    unit, ends = jnp.array([0.8]), jnp.array([[2.0, 4.0], [4.0, 2.0]])
    test = StepTest(ends, jnp.array(0.01), 400, 5e-5)
    limited = dataclasses.replace(objective, step_test=test).with_limits(
        {"rise_time": 1e-3}
    )
    rises = np.asarray(limited.figures(unit).steps.rise_time)
    assert rises.shape == (1, 2)
    found = limited.value_and_verdict(unit)[1].violations
    np.testing.assert_allclose(found, np.log(rises.max() / 1e-3), rtol=1e-9)
    assert objective.figures(unit).steps is None


@pytest.mark.parametrize("limits", [{}, {"effort": 1e-3}])
def test_the_squares_of_the_residuals_sum_to_the_loss(objective, limits):
    square = dataclasses.replace(
        objective,
        aggregate="mean_square",
        scale=objective.scale[:1],
        effort_weight=0.3,
        slew_weight=20.0,
    ).with_limits(limits)
    unit = jnp.array([0.4])
    residuals, loss = square.residuals(unit), square.loss(unit)
    assert jnp.sum(residuals**2) == pytest.approx(float(loss), rel=1e-12)
    slopes = jax.grad(lambda u: jnp.sum(square.residuals(u) ** 2))(unit)
    np.testing.assert_allclose(slopes, jax.grad(square.loss)(unit), rtol=1e-9)


def test_a_loop_that_diverges_has_the_loss_of_a_failure(objective):
    wild = dataclasses.replace(objective, aggregate="mean_square")
    lost = dataclasses.replace(wild, scale=jnp.full((1, 2), np.nan))
    assert lost.loss(jnp.array([0.4])) == FAILED_LOSS
    whole = jnp.sum(lost.residuals(jnp.array([0.4])) ** 2)
    assert whole == pytest.approx(FAILED_LOSS, rel=1e-12)


def test_residuals_need_squares(objective):
    with pytest.raises(ValueError, match="cannot minimise 'geometric_mean'"):
        objective.residuals(jnp.array([0.5]))
