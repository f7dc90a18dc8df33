"""Least errors, against closed forms, Riccati equations and loops in NumPy."""

import numpy as np
import pytest
from scipy import linalg, signal

from piezojax.analysis.limit.wiener import (
    best_response,
    common_response,
    error_shares,
    inner_response,
    outer_factor,
    slow_delay,
)

POINTS = 2**14
W = np.exp(-2j * np.pi * np.arange(POINTS) / POINTS)  # 1/z


def response(numerator, denominator=(1.0,)):
    """Return a transfer function, coefficients in rising powers of 1/z."""
    return np.polyval(numerator[::-1], W) / np.polyval(denominator[::-1], W)


def inner_of(numerator):
    """Return the inner part of a plant with a stable denominator."""
    delay = int(np.flatnonzero(numerator)[0])
    zeros = np.roots(numerator[delay:])
    return inner_response(delay, zeros[np.abs(zeros) > 1.0], POINTS)


def least(spectrum, variance, inner):
    T = best_response(spectrum, variance, inner)
    return sum(error_shares(T, spectrum, variance))


def ar1(a, driven=1.0):
    return driven * np.abs(response((1.0,), (1.0, -a))) ** 2


def test_a_factor_is_stable_with_a_stable_inverse():
    wanted = response((1.0, 0.5), (1.0, -0.9))
    np.testing.assert_allclose(outer_factor(np.abs(wanted)), wanted, rtol=1e-10)
    # A zero outside the circle is reflected, with the same gain.
    outside = response((1.0, -2.0), (1.0, -0.9))
    found = outer_factor(np.abs(outside))
    np.testing.assert_allclose(found, response((2.0, -1.0), (1.0, -0.9)), rtol=1e-10)
    # A zero on the circle is a line of the grid, where the factor is small, not zero.
    on = response((1.0, -1.0))
    found = outer_factor(np.abs(on))
    np.testing.assert_allclose(
        found[POINTS // 8 : POINTS // 2], on[POINTS // 8 : POINTS // 2], rtol=1e-2
    )
    assert 0.0 < abs(found[0]) < 1e-6
    for wrong in (0.0 * outside, np.inf * np.abs(outside)):
        with pytest.raises(ValueError, match="finite and not zero everywhere"):
            outer_factor(np.abs(wrong))


def test_the_inner_part_is_the_delay_and_the_zeros_outside():
    plant = response((0.0, 0.0, 1.0, -2.0), (1.0, -0.9))
    found = inner_of((0.0, 0.0, 1.0, -2.0))
    np.testing.assert_allclose(np.abs(found), 1.0, rtol=1e-12)
    # The remaining factor is stable with a stable inverse: the outer factor.
    rest = plant / found
    np.testing.assert_allclose(rest, -outer_factor(np.abs(plant)), rtol=1e-9)
    angle = np.unwrap(np.angle(found))
    slope = -(angle[1] - angle[0]) * POINTS / (2.0 * np.pi)
    assert slow_delay(2, np.array([2.0])) == pytest.approx(slope, rel=1e-4)
    pair = np.array([0.5 + 1.2j, 0.5 - 1.2j])
    angle = np.unwrap(np.angle(inner_response(1, pair, POINTS)))
    slope = -(angle[1] - angle[0]) * POINTS / (2.0 * np.pi)
    assert slow_delay(1, pair) == pytest.approx(slope, rel=1e-4)


def test_a_white_disturbance_is_unpredictable():
    spectrum = np.full(POINTS, 0.7)
    assert least(spectrum, 0.2, W) == pytest.approx(0.7, rel=1e-12)
    # Without the delay the filter weighs the disturbance against the noise.
    assert least(spectrum, 0.2, np.ones(POINTS)) == pytest.approx(0.7 * 0.2 / 0.9)


@pytest.mark.parametrize("a", [0.5, 0.99])
@pytest.mark.parametrize("variance", [0.01, 1.0, 100.0])
def test_a_unit_delay_has_the_cost_of_the_scalar_riccati_equation(a, variance):
    # p = a^2 p s / (p + s) + 1, solved for p > 0.
    b = variance * (1.0 - a**2) - 1.0
    p = 0.5 * (-b + np.sqrt(b**2 + 4.0 * variance))
    assert least(ar1(a), variance, W) == pytest.approx(p, rel=1e-9)


@pytest.mark.parametrize("zero", [1.2, 3.0, -2.0])
def test_a_zero_outside_the_circle_raises_the_error_by_the_known_factor(zero):
    # The kernels at w = 0 and w = 1/zero span the part of V outside P_i H2.
    a, b = 0.9, 1.0 / zero
    factor = 1.0 + a**2 * (1.0 - b**2) / (1.0 - a * b) ** 2
    delayed = least(ar1(a), 0.0, W)
    assert delayed == pytest.approx(1.0, rel=1e-9)
    found = least(ar1(a), 0.0, inner_of((0.0, 1.0, -zero)))
    assert found == pytest.approx(factor, rel=1e-8)


def lqg(plant, model, driven, variance, effort):
    """Return Return E y^2 of the LQG loop; systems (numerator, denominator) in 1/z."""

    def states(numerator, denominator):
        # Controllable form of a strictly proper function of 1/z.
        order = len(denominator) - 1
        A = np.vstack([-np.array(denominator[1:]), np.eye(order)[:-1]])
        C = np.zeros((1, order))
        C[0, : len(numerator) - 1] = numerator[1:]
        return A, np.eye(order)[:, :1], C

    (Ap, Bp, Cp), (Ad, Bd, Cd) = states(*plant), states(*model)
    A, C = linalg.block_diag(Ap, Ad), np.hstack([Cp, Cd])
    B, G = np.vstack([Bp, 0 * Bd]), np.vstack([0 * Bp, Bd])
    X = linalg.solve_discrete_are(A, B, C.T @ C, np.array([[effort]]))
    K = np.linalg.solve(effort + B.T @ X @ B, B.T @ X @ A)
    noise = np.array([[variance]])
    Y = linalg.solve_discrete_are(A.T, C.T, driven * G @ G.T, noise)
    L = Y @ C.T / (C @ Y @ C.T + variance)
    # States and estimates one step ahead; u = -K (estimate with the new measurement).
    eye = np.eye(len(A))
    closed = np.block(
        [
            [A - B @ K @ L @ C, -B @ K @ (eye - L @ C)],
            [A @ L @ C - B @ K @ L @ C, (A - B @ K) @ (eye - L @ C)],
        ]
    )
    entry = np.vstack([-B @ K @ L, (A - B @ K) @ L])
    covariance = driven * linalg.block_diag(G @ G.T, 0 * A)
    covariance = linalg.solve_discrete_lyapunov(
        closed, covariance + variance * entry @ entry.T
    )
    n = len(A)
    return (C @ covariance[:n, :n] @ C.T).item()


PLANTS = {
    "delay and lag": ((0.0, 0.1), (1.0, -0.9)),
    "zeros outside": (
        # The dynamics of the P-753 stage, with the loop's sample.
        (0.0, 0.0050811, -0.0036354, 0.010553),
        (1.0, -1.6035, 0.61995, 0.0),
    ),
    "resonance": ((0.0, 0.0, 0.01), (1.0, -1.9, 0.98)),
}


@pytest.mark.parametrize("name", list(PLANTS))
@pytest.mark.parametrize("variance", [1e-3, 1.0])
def test_the_limit_equals_cheap_control_lqg(name, variance):
    model = ((0.0, 1.0, 0.3), (1.0, -1.9, 0.905))
    spectrum = 0.02 * np.abs(response(*model)) ** 2
    found = least(spectrum, variance, inner_of(PLANTS[name][0]))
    priced = [
        lqg(PLANTS[name], model, 0.02, variance, effort) for effort in (1e-5, 1e-9)
    ]
    assert found * (1.0 - 1e-9) <= priced[1] <= priced[0]
    assert found == pytest.approx(priced[1], rel=1e-3)


def test_the_error_falls_with_the_noise():
    inner = inner_of(PLANTS["zeros outside"][0])
    errors = [least(ar1(0.98), variance, inner) for variance in (10.0, 1.0, 0.1, 0.0)]
    assert np.all(np.diff(errors) < 0.0)


@pytest.fixture(scope="module")
def drawn():
    """Return a disturbance of ``ar1(0.98)`` and measurement noise of variance 4."""
    random = np.random.default_rng(5)
    draws, noise = random.standard_normal((2, 60_000))
    return signal.lfilter([1.0], [1.0, -0.98], draws), 2.0 * noise


def test_the_best_controller_reaches_the_limit_in_a_loop(drawn):
    numerator, denominator = PLANTS["zeros outside"]
    plant = response(numerator, denominator)
    T = best_response(ar1(0.98), 4.0, inner_of(numerator))
    predicted = sum(error_shares(T, ar1(0.98), 4.0))
    taps = np.fft.ifft(T / plant).real
    assert np.max(np.abs(taps[400:])) < 1e-9 * np.max(np.abs(taps))
    taps, (d, n) = taps[:400], drawn
    y, u, seen = (np.zeros(d.size + 400) for _ in range(3))
    moved = np.zeros(d.size + 400)
    for k in range(400, d.size + 400):
        # The controller simulates the same model as the stage.
        moved[k] = np.dot(numerator, u[k - 3 : k + 1][::-1])
        moved[k] -= np.dot(denominator[1:], moved[k - 3 : k][::-1])
        y[k] = moved[k] + d[k - 400]
        seen[k] = y[k] + n[k - 400] - moved[k]
        u[k] = -np.dot(taps, seen[k - 399 : k + 1][::-1])
    squares = y[1400:] ** 2
    batches = squares[: squares.size // 50 * 50].reshape(50, -1).mean(axis=1)
    spread = batches.std(ddof=1) / np.sqrt(50.0)
    assert spread < 0.05 * predicted
    assert abs(squares.mean() - predicted) < 4.0 * spread


def test_no_other_linear_controller_has_a_smaller_error(drawn):
    d, n = drawn
    bound = least(ar1(0.98), 4.0, W)
    found = []
    for integral in np.geomspace(0.02, 1.0, 12):
        for proportional in (0.0, 0.1, 0.5):
            # u(k) = -(proportional + integral / (1 - w)) z(k), y(k + 1) = u(k) + d.
            loop = [1.0, proportional + integral - 1.0, -proportional]
            sensitivity = signal.lfilter([1.0, -1.0], loop, d)
            heard = signal.lfilter(
                [0.0, proportional + integral, -proportional], loop, n
            )
            found.append(np.mean((sensitivity - heard)[1000:] ** 2))
    assert min(found) > 0.97 * bound  # 3 %: the accuracy of 60 000 samples
    assert min(found) < 1.3 * bound
    # the exact comparison, in spectra
    for integral in np.geomspace(0.02, 1.0, 12):
        T = integral * W / (1.0 - W + integral * W)
        assert sum(error_shares(T, ar1(0.98), 4.0)) >= bound


def test_one_controller_for_several_disturbances():
    spectra = np.stack([ar1(0.99, 1.0), ar1(0.6, 10.0), ar1(0.9, 0.01)])
    inner = inner_of(PLANTS["zeros outside"][0])

    def errors(T):
        return np.array([sum(error_shares(T, s, 0.5)) for s in spectra])

    shared = errors(common_response(spectra, 0.5, inner, tolerance=1e-9))
    own = [sum(error_shares(best_response(s, 0.5, inner), s, 0.5)) for s in spectra]
    assert np.all(shared >= own)
    # No weighted sum of the spectra gives a lower geometric mean.
    random = np.random.default_rng(2)
    for weights in (np.ones(3), 1.0 / np.array(own), *random.exponential(size=(50, 3))):
        mixed = errors(best_response(weights @ spectra / weights.sum(), 0.5, inner))
        assert np.prod(shared) <= np.prod(mixed) * (1.0 + 1e-9)
    alone = errors(common_response(spectra[:1], 0.5, inner))[0]
    assert alone == pytest.approx(own[0], rel=1e-9)
