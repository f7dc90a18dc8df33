"""Margins from an impulse response against the exact report, and their gradients."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.analysis.stability import (
    OperatingPoint,
    broken_loop,
    sensitivity,
    sensitivity_peak,
    stability_report,
)
from piezojax.analysis.stability.conserved import LinearLoop
from piezojax.analysis.stability.margins import report_of
from piezojax.analysis.stability.sampled_margins import (
    BANDS,
    UNLIMITED_DELAY,
    UNLIMITED_GAIN,
    bandwidth_of,
    closed_loop_peak_of,
    delay_margin_of,
    disk_margin_of,
    gain_margin_of,
    peak_of,
    peaks_of,
    phase_margin_of,
)
from piezojax.analysis.stability.small_motion import (
    _axes_impulse,
    references_followed,
    sensitivities,
)
from piezojax.catalog import p558, p558_control, p753, p753_stage
from piezojax.core.paths import replace
from piezojax.dynamics import linearise

INTEGRAL = "controller.integral"
BRANCHES = ("ascending", "descending")


def one_axis(sensitivity):
    return jnp.asarray(sensitivity)[:, None, None]


def pid_loop(integral=3000.0):
    return p753.loop(pj.control.PID(0.5, integral, 0.0, 1e-4, 100.0, dt=p753.DT))


LOOPS = {
    "PID": pid_loop,
    "PID-SMC": lambda: p753.loop(p753.sliding_mode()),
    "observer": lambda: replace(
        p753.loop(p753.disturbance_observer()),
        {"controller.feedback.law.integral": 10.0},
    ),
    "stage with a mode": lambda: pj.Feedback(
        pj.control.PID(0.3, 1500.0, dt=p753.DT),
        p753_stage.stage(delay=0.4),
        p753.actuator(),
        pj.hardware.Sensor(0.0),
    ),
}


@pytest.mark.parametrize("branch", BRANCHES)
@pytest.mark.parametrize("name", LOOPS)
def test_figures_equal_the_exact_report(name, branch):
    loop = LOOPS[name]()
    point = OperatingPoint(5.0, branch)
    exact = stability_report(loop, point)
    found = jax.jit(lambda loop: sensitivity(loop, point))(loop)
    # A peak between two frequency lines is underestimated slightly.
    assert peak_of(found) == pytest.approx(exact.sensitivity_peak, rel=5e-3)
    assert disk_margin_of(found) == pytest.approx(exact.disk_margin, rel=5e-3)
    assert delay_margin_of(found) == pytest.approx(exact.delay_margin_samples, rel=5e-3)
    assert gain_margin_of(found) == pytest.approx(exact.gain_margin_dB, rel=5e-3)
    assert phase_margin_of(found) == pytest.approx(exact.phase_margin_deg, rel=5e-3)
    followed = jax.jit(lambda loop: references_followed(loop, 5.0))(loop)
    followed = followed[BRANCHES.index(branch)]
    found, exact = bandwidth_of(followed, p753.DT), exact.following
    assert found == pytest.approx(exact.bandwidth_Hz, rel=5e-3)
    found = closed_loop_peak_of(followed)
    assert found == pytest.approx(exact.closed_loop_peak, rel=5e-3)


def test_a_lightly_damped_mode_between_two_lines_is_found():
    """The peak of the mode is 7 Hz wide, midway between two frequency lines."""
    dt = 1e-4
    loop = pj.Feedback(
        pj.control.PID(0.0, 20.0, dt=dt),
        pj.dynamics.Mode(347.5, 0.01, dt),
        pj.hardware.Saturation(-50.0, 50.0),
        pj.hardware.Sensor(0.0),
    )
    exact = stability_report(loop).sensitivity_peak
    assert 1.5 < exact < 3.0
    assert sensitivity_peak(loop) == pytest.approx(exact, rel=0.08)


def test_every_branch_equals_the_exact_report():
    # The branches differ, so one report cannot replace both.
    reports = [stability_report(pid_loop(), OperatingPoint(5.0, b)) for b in BRANCHES]
    exact = [report.sensitivity_peak for report in reports]
    assert max(exact) > 1.02 * min(exact)
    found = jax.jit(lambda loop: sensitivities(loop, 5.0))(pid_loop())
    np.testing.assert_allclose(jax.vmap(peak_of)(found), exact, rtol=5e-3)


def test_a_crossing_with_phase_lead_limits_the_delay_too():
    """L = -k / A(z) of a mode, rotated by 90 degrees: phase lead at both |L| = 1."""
    radius, angle = 0.99, 0.3
    A = np.array([1.0, -2.0 * radius * np.cos(angle), radius**2])
    k = 1.5 * (1.0 - radius) * 2.0 * np.sin(angle)

    def stable(delay):
        closed = np.append(A, np.zeros(delay))
        closed[-1] -= k
        return np.abs(np.roots(closed)).max() < 1.0

    whole = next(n for n in range(100) if not stable(n + 1))
    z = np.exp(1j * np.linspace(0.0, np.pi, 20_001))
    loop = -k / np.polyval(A, z)
    assert np.angle(loop[np.abs(loop) > 1.0]).min() > 0.2  # without lag
    assert whole > 5
    # z^-2 (...) in companion form: the loop as a state space.
    system = LinearLoop(
        np.array([[-A[1], -A[2]], [1.0, 0.0]]),
        np.array([1.0, 0.0]),
        np.array([0.0, -k]),
        p753.DT,
    )
    assert math.floor(report_of(system).delay_margin_samples) == whole
    assert math.floor(delay_margin_of(one_axis(1.0 / (1.0 + loop)))) == whole


@pytest.mark.parametrize("integral", [6000.0, 20_000.0, 30_000.0])
def test_the_two_sources_of_a_peak_agree_within_the_stated_error(integral):
    loop, duration = pid_loop(integral), 0.05
    exact = stability_report(loop, 5.0)
    # The quality factor at the peak is that of the nearest pole.
    poles = np.log(np.array(exact.poles))
    place = 2.0 * np.pi * exact.sensitivity_peak_Hz * p753.DT
    pole = poles[np.argmin(np.abs(poles - 1j * place))]
    lines = duration * exact.sensitivity_peak_Hz
    share = 0.5 * (0.5 * abs(pole) / abs(pole.real) / lines) ** 2
    found = float(sensitivity_peak(loop, 5.0, duration))
    assert exact.sensitivity_peak * (1.0 - share) < found
    assert found < exact.sensitivity_peak * (1.0 + 1e-6)


def test_a_loop_with_gain_below_1_has_no_delay_margin():
    weak = pj.control.PID(0.01, 0.0, dt=p753.DT)
    loop = pj.Feedback(weak, p753.plant(), p753.actuator(), pj.Sensor(0.0))
    found = sensitivity(loop, 0.0)
    assert delay_margin_of(found) == UNLIMITED_DELAY


def test_a_gain_margin_at_the_nyquist_frequency():
    """L = k / (z - a): its pole a - k leaves the unit circle at -1, where L is real."""
    a, k = 0.5, 0.6
    z = np.exp(1j * np.linspace(0.0, np.pi, 2001))
    found = gain_margin_of(one_axis(1.0 / (1.0 + k / (z - a))))
    assert found == pytest.approx(20.0 * np.log10((1.0 + a) / k), rel=1e-9)


def test_a_loop_without_gain_has_the_largest_margins():
    found = one_axis(jnp.ones(64, complex))
    assert gain_margin_of(found) == UNLIMITED_GAIN
    assert phase_margin_of(found) == 180.0


def test_a_bandwidth_beyond_nyquist_ends_at_the_nyquist_frequency():
    assert bandwidth_of(jnp.ones(64, complex), 1e-3) == 500.0
    # A loop that does not follow at frequency zero has no bandwidth.
    assert bandwidth_of(jnp.full(64, 0.5 + 0j), 1e-3) < 0.1


def test_gradients_equal_finite_differences():
    @jax.jit
    def figures(integral):
        loop = replace(pid_loop(), {INTEGRAL: integral})
        found, followed = sensitivity(loop, 5.0), references_followed(loop, 5.0)[0]
        both = (gain_margin_of, phase_margin_of)
        return jnp.stack(
            [f(found) for f in (peak_of, disk_margin_of, delay_margin_of, *both)]
            + [bandwidth_of(followed, p753.DT), closed_loop_peak_of(followed)]
        )

    at, step = 9000.0, 1e-2
    difference = (figures(at + step) - figures(at - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(figures))(at), difference, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.jacrev(figures))(at), difference, rtol=1e-5)


def test_an_unstable_loop_gives_a_barrier_with_a_gradient():
    def peak(integral):
        return jnp.log(peak_of(sensitivity(pid_loop(integral), 5.0)))

    assert stability_report(pid_loop(3e5), 5.0).stable is False
    value, slope = jax.jit(jax.value_and_grad(peak))(jnp.asarray(3e5))
    assert value > 5.0
    assert np.isfinite(slope)
    assert slope > 0.0


def test_an_unstable_loop_has_no_margins():
    found = sensitivity(pid_loop(1e5), 5.0)
    assert peak_of(found) > 1e3
    for margin in (gain_margin_of, phase_margin_of, delay_margin_of):
        assert margin(found) == 0.0


def test_an_unknown_branch_is_refused():
    with pytest.raises(ValueError, match=r"branch 'up'; it must be one of"):
        sensitivity(pid_loop(), OperatingPoint(branch="up"))


# Several axes

FIGURES = (
    peak_of,
    disk_margin_of,
    delay_margin_of,
    lambda S: jnp.log(peaks_of(S)) @ jnp.arange(1.0, BANDS + 1.0),
)
ANGLES = np.linspace(0.0, np.pi, 4001)


def coupled(gains, coupling=0.4):
    """Return S of two axes, L = K [[1, c], [c/2, 1]] z^-3 / (z - 1)."""
    z = np.exp(1j * ANGLES[1:])[:, None, None]
    mixing = jnp.array([[1.0, coupling], [0.5 * coupling, 1.0]])
    L = gains[:, None] * mixing * z**-3 / (z - 1.0)
    # By the adjugate: the LAPACK calls of XLA may deadlock on a CPU.
    F = jnp.eye(2) + L
    a, b, c, d = F[:, 0, 0], F[:, 0, 1], F[:, 1, 0], F[:, 1, 1]
    adjugate = jnp.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)
    S = adjugate / (a * d - b * c)[:, None, None]
    return jnp.concatenate([jnp.zeros((1, 2, 2)), S])


def test_figures_of_two_axes_equal_those_of_numpy():
    S = coupled(jnp.array([0.12, 0.2]))
    largest = np.linalg.svd(S, compute_uv=False)[:, 0].max()
    disk = np.linalg.svd(S - 0.5 * np.eye(2), compute_uv=False)[:, 0].max()
    assert largest > 1.02 * np.abs(np.einsum("kii->ki", S)).max()
    assert peak_of(S) == pytest.approx(largest, rel=1e-7)
    assert disk_margin_of(S) == pytest.approx(1.0 / disk, rel=1e-7)
    alone = [float(delay_margin_of(one_axis(S[:, i, i]))) for i in range(2)]
    assert delay_margin_of(S) == pytest.approx(min(alone))
    assert alone[1] < 0.9 * alone[0]


@pytest.mark.parametrize("lines", [257, 300, 513, 16_001])
def test_the_peaks_are_those_of_the_octaves(lines):
    rng = np.random.default_rng(lines)
    S = rng.standard_normal((lines, 2, 2)) + 1j * rng.standard_normal((lines, 2, 2))
    for matrices in (S, S[:, :1, :1]):
        found = peaks_of(matrices)
        sizes = np.linalg.svd(matrices, compute_uv=False)[:, 0]
        assert found.shape == (BANDS,)
        assert np.max(found) == pytest.approx(sizes.max(), rel=1e-7)
        for octave in range(1, 6):
            stop, start = (lines >> (octave - shift) for shift in (1, 0))
            expected = sizes[start:stop].max()
            assert found[-octave] == pytest.approx(expected, rel=1e-7)
    # Every line is in one band: a peak anywhere is seen.
    for line in (0, 1, 2, 5, lines // 3, lines - 1):
        lone = np.ones((lines, 1, 1), complex)
        lone[line] = 3.0
        assert sorted(peaks_of(lone)) == pytest.approx([1.0] * (BANDS - 1) + [3.0])


def test_a_delay_beyond_the_margin_of_one_axis_makes_two_axes_unstable():
    gains, mixing = np.array([0.12, 0.2]), np.array([[1.0, 0.4], [0.2, 1.0]])

    def stable(delay):
        """Simulate the loop with ``delay`` additional samples on the second axis."""
        x, past = np.array([1.0, 1.0]), [np.zeros(2)] * 60
        for _ in range(3000):
            acted = np.array([mixing[0] @ past[-4], mixing[1] @ past[-4 - delay]])
            x = x - gains * acted
            past.append(x)
        return bool(np.abs(x).max() < 1e-3)

    whole = next(n for n in range(40) if not stable(n + 1))
    second = delay_margin_of(one_axis(coupled(jnp.array(gains))[:, 1, 1]))
    assert math.floor(second) == whole


def test_gradients_of_two_axes_equal_finite_differences():
    @jax.jit
    def figures(gains):
        return jnp.stack([figure(coupled(gains)) for figure in FIGURES])

    at = jnp.array([0.12, 0.2])
    steps = 1e-6 * np.eye(2)
    difference = [(figures(at + e) - figures(at - e)) / 2e-6 for e in steps]
    forward = jax.jit(jax.jacfwd(figures))(at)
    np.testing.assert_allclose(forward, np.transpose(difference), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacrev(figures))(at), forward, rtol=1e-9)


def test_equal_singular_values_have_a_gradient():
    """Two equal axes: the gradient along both gains is that of one axis."""

    def peak(gain):
        return peak_of(coupled(gain * jnp.ones(2), coupling=0.0))

    def one(gain):
        return peak_of(one_axis(coupled(gain * jnp.ones(2), coupling=0.0)[:, 0, 0]))

    value, slope = jax.value_and_grad(peak)(0.2)
    assert value == pytest.approx(float(one(0.2)), rel=1e-7)
    assert slope == pytest.approx(float(jax.grad(one)(0.2)), rel=1e-6)


@pytest.fixture(scope="module")
def three_axes():
    """Return S of a loop of three axes on both branches, and its exact reports."""
    loop, rest = p558_control.loop(p558_control.pid()), (5.0, 5.0, 5.0)
    exact = [stability_report(loop, OperatingPoint(rest, b)) for b in BRANCHES]
    return jax.jit(lambda loop: sensitivities(loop, rest))(loop), exact


def test_figures_of_three_axes_equal_the_exact_report(three_axes):
    found, exact = three_axes
    assert found.shape[0] == len(exact)
    for S, report in zip(found, exact, strict=True):
        assert peak_of(S) == pytest.approx(report.sensitivity_peak, rel=5e-3)
        least = min(axis.delay_margin_samples for axis in report.axes)
        assert delay_margin_of(S) == pytest.approx(least, rel=2e-2)
        # Without scaling of the axes the bound is smaller than the structured one.
        assert disk_margin_of(S) < report.disk_margin * (1.0 + 5e-3)
        assert disk_margin_of(S) > 0.8 * report.disk_margin


@pytest.mark.parametrize("samples", [2, 3, 5, 6, 10, 17, 18, 50])
def test_the_impulse_of_several_axes_has_every_sample(samples):
    broken = broken_loop(p558_control.loop(p558_control.multi_axis()), (5.0, 5.0, 5.0))
    model = linearise(broken, broken.start.voltage, broken.init(), p558.DT)
    closed, state = np.asarray(model.A - model.B @ model.C), np.asarray(model.B)
    expected = [np.eye(3)]
    for _ in range(samples - 1):
        expected.append(-np.asarray(model.C) @ state)
        state = closed @ state
    found = _axes_impulse(broken, samples, p558.DT)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
