"""Tunable H-infinity control against the design with SciPy's Riccati solver."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from piezojax.control import (
    WeightedMixedSensitivity,
    first_order_weight,
    mixed_sensitivity,
)
from piezojax.core.paths import replace
from piezojax.dynamics import ARMA

DT = 5e-5
MODEL = ARMA((1.6035, -0.61995), (0.0050811, -0.0036354, 0.010553))  # (5.33)
WEIGHT = {"low": 1e3, "crossover": 600.0, "high": 0.5}
EFFORT = 0.1
DESIGN = mixed_sensitivity(MODEL, first_order_weight(**WEIGHT, dt=DT), EFFORT, dt=DT)
FREQUENCY = np.geomspace(0.1, 9.9e3, 50)


def controlled(bound):
    return WeightedMixedSensitivity(
        MODEL, **WEIGHT, effort_weight=EFFORT, bound=bound, dt=DT
    )


def response(law, frequency):
    """Return the frequency response of matrices in plain NumPy."""
    A, B, C, D = (np.asarray(m) for m in (law.A, law.B, law.C, law.D))
    z = np.exp(2j * np.pi * DT * frequency)
    return np.array(
        [(C @ np.linalg.solve(p * np.eye(len(A)) - A, B) + D)[0, 0] for p in z]
    )


@jax.jit
def law_of(bound):
    return replace(controlled(2.0), {"bound": bound}).resolved().law


def test_at_the_same_bound_the_design_equals_that_of_scipy():
    expected = response(DESIGN.controller.law, FREQUENCY)
    found = response(law_of(DESIGN.gamma), FREQUENCY)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("factor", [1.01, 1.5, 30.0])
def test_the_weighted_responses_keep_the_bound(factor):
    bound = factor * DESIGN.gamma
    law = law_of(bound)
    angles = np.linspace(1e-4, np.pi, 4000)
    frequency = angles / (2.0 * np.pi * DT)
    z = np.exp(1j * angles)
    a, b = (np.asarray(part) for part in (MODEL.autoregressive, MODEL.moving))
    # y(k+1) = a y(k) + ... + b u(k) + ...
    over = b[0] + b[1] / z + b[2] / z**2
    plant = over / (z - a[0] - a[1] / z)
    K = response(law, frequency)
    S = 1.0 / (1.0 + plant * K)
    assert np.max(np.abs(S)) < 3.0
    weight = response(first_order_weight(**WEIGHT, dt=DT), frequency)
    size = np.sqrt(np.abs(weight * S) ** 2 + np.abs(EFFORT * K * S) ** 2)
    assert np.max(size) < bound
    if factor == 1.01:
        assert np.max(size) > 0.9 * bound


def test_an_infeasible_bound_gives_nan():
    assert np.all(np.isnan(law_of(0.98 * DESIGN.gamma).C))


def test_gradients_equal_finite_differences():
    control = controlled(1.2 * DESIGN.gamma)
    names: tuple[str, ...] = ("low", "crossover", "high", "effort_weight", "bound")
    start = jnp.array([getattr(control, name) for name in names])

    def size(logs):
        values = dict(zip(names, start * jnp.exp(logs), strict=True))
        law = replace(control, values).resolved().law
        return jnp.log(jnp.abs(law.frequency_response(jnp.array([200.0]))[0, 0, 0]))

    step = 1e-5
    points = jnp.vstack([jnp.zeros(5), step * jnp.eye(5), -step * jnp.eye(5)])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(size)))(points)
    expected = (values[1:6] - values[6:]) / (2.0 * step)
    assert np.max(np.abs(expected)) > 0.1
    np.testing.assert_allclose(slopes[0], expected, rtol=1e-4, atol=1e-7)


def test_without_a_bound_the_design_is_h2():
    a, b = (np.asarray(part) for part in (MODEL.autoregressive, MODEL.moving))
    weight = first_order_weight(**WEIGHT, dt=DT)
    Aw, Bw, Cw, Dw = (float(m[0, 0]) for m in (weight.A, weight.B, weight.C, weight.D))
    y = np.eye(1, 4)
    A = np.zeros((4, 4))
    A[:3, :3] = np.eye(3, k=1)
    A[:2, 0] = a
    A[3] = [-Bw, 0.0, 0.0, Aw]
    B1, B2 = Bw * np.eye(4)[:, 3:], np.append(b, 0.0)[:, None]
    C = np.vstack([Cw * np.eye(4)[3] - Dw * y[0], np.zeros(4)])
    X = solve_discrete_are(A, B2, C.T @ C, [[EFFORT**2]])
    S = EFFORT**2 + B2.T @ X @ B2
    F, f = -(B2.T @ X @ A) / S, -(B2.T @ X @ B1) / S
    F = F + f * y
    law = SimpleNamespace(A=A + B1 @ y + B2 @ F, B=B1 + B2 @ f, C=F, D=f)
    found = response(law_of(1e6), FREQUENCY)
    np.testing.assert_allclose(found, response(law, FREQUENCY), rtol=1e-6)
