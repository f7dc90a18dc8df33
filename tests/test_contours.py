"""Contours and contour errors, against NumPy and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.core.feedback import LoopSample
from piezojax.signals import (
    ContourError,
    contours,
    motions,
)
from piezojax.signals import waveforms as signals
from piezojax.signals.contour_error import distance_to

TIME = signals.time_grid(1.0, 2000.0)
AXES = ("Z", "Rx", "Ry")


def sample_of(reference, displacement):
    reference, displacement = (
        tuple(np.asarray(points).T) for points in (reference, displacement)
    )
    return LoopSample(reference, displacement, displacement, displacement, displacement)


@jax.jit
def figures(metric, samples):
    def add(carry, sample):
        total, index = carry
        return (metric.update(total, index, sample), index + 1), None

    (total, _), _ = jax.lax.scan(add, (metric.init(), 0), samples)
    return metric.result(total)


def bend(angles, radii=(5.0, 5.0)):
    return np.stack([radii[0] * np.cos(angles), radii[1] * np.sin(angles)], axis=1)


# ---- contours ----


def test_a_circle_is_exact_from_its_first_sample():
    path = contours.circle(TIME, 5.0, (4.0, 3.0), (1.0, -2.0), rise=0.2)
    x, y = np.asarray(path).T
    on = ((x - 5.0) / 4.0) ** 2 + ((y - 1.0) / 3.0) ** 2
    np.testing.assert_allclose(on, 1.0, rtol=1e-12)
    np.testing.assert_allclose(path[0], [1.0, 1.0], atol=1e-12)
    # Half a turn less than without the rise of 0.2 s, then at equal speed.
    late = contours.circle(TIME, 5.0, (4.0, 3.0), (1.0, -2.0))
    np.testing.assert_allclose(path[600:], late[400:-200], atol=1e-9)


@pytest.mark.parametrize("path", [contours.circle, contours.lissajous, contours.raster])
def test_a_rise_removes_the_jump_in_speed(path):
    for rise, jump in ((0.0, True), (0.2, False)):
        speed = np.diff(np.asarray(path(TIME, rise=rise)), axis=0)
        first = np.abs(speed[0]).max() / np.abs(speed).max()
        assert (first > 0.02) == jump


@pytest.mark.parametrize(("cycles"), [(1, 1), (5, 4), (4, 5), (3, 1), (1, 2), (2, 1)])
def test_a_lissajous_closes_after_a_period_without_retracing(cycles):
    time = jnp.arange(2001) / 2000.0
    path = np.asarray(contours.lissajous(time, 1.0, cycles))
    np.testing.assert_allclose(path[0], path[-1], atol=1e-12)
    for column, count in zip(path.T, cycles, strict=True):
        spectrum = np.abs(np.fft.rfft(column[:-1] - 5.0)) / 1000.0
        np.testing.assert_allclose(spectrum[count], 5.0, rtol=1e-12)
        assert np.delete(spectrum, count).max() < 1e-12
    # A retraced figure has zero speed on both axes at its ends.
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert speed.min() > 0.02 * speed.max()


def test_a_raster_has_triangles_at_constant_speed():
    path = contours.raster(TIME, 10.0, (5.0, 2.0), (1.0, 3.0), lines=8, turnaround=0.0)
    turns = np.asarray(TIME) * 10.0
    fast = 1.0 + 10.0 * _tri(turns)
    slow = 3.0 + 4.0 * _tri(turns / 8.0)
    np.testing.assert_allclose(path, np.stack([fast, slow], 1), atol=1e-9)


def _tri(turns):
    return np.interp(turns % 1.0, [0.0, 0.5, 1.0], [0.0, 1.0, 0.0])


def test_turnarounds_have_constant_acceleration_and_keep_the_range():
    time = jnp.arange(20_000) / 20_000.0
    share = 0.2
    x = np.asarray(contours.raster(time, 2.0, 5.0, turnaround=share))[:, 0]
    np.testing.assert_allclose([x.min(), x.max()], [0.0, 10.0], atol=1e-12)
    second = np.diff(x, 2) * 20_000.0**2
    speed = 10.0 / (0.5 - share / 2.0) * 2.0  # um/s between the turns
    turning = speed / (share / 2.0 / 2.0)
    levels = np.unique(np.round(second / turning, 3))
    inside = np.abs(second) > 0.999 * turning
    assert set(levels[np.abs(levels) > 0.999]) == {-1.0, 1.0}
    np.testing.assert_allclose(inside.mean(), 2.0 * share, atol=0.01)
    straight = np.abs(second) < 1e-3 * turning
    np.testing.assert_allclose(straight.mean(), 1.0 - 2.0 * share, atol=0.01)


def test_stairs_rise_in_the_turns_only():
    path = contours.raster(TIME, 10.0, 5.0, lines=5, turnaround=0.1, stepped=True)
    y = np.asarray(path)[:, 1]
    levels = y.reshape(20, 100)[:, 50]  # the middle of each line
    up_and_down = [0.0, 2.5, 5.0, 7.5, 10.0, 7.5, 5.0, 2.5]
    np.testing.assert_allclose(levels, (up_and_down * 3)[:20], atol=1e-12)
    line = np.asarray(TIME) * 20.0
    away = np.abs(line - np.round(line)) > 0.1
    assert np.abs(np.diff(y)[away[1:] & away[:-1]]).max() < 1e-12


@pytest.mark.parametrize("stepped", [False, True])
def test_gradients_of_a_raster_equal_finite_differences(stepped):
    time = TIME[1:700]

    @jax.jit
    def moved(values):
        path = contours.raster(time, values[0], values[1], lines=6, stepped=stepped)
        return jnp.sum(path * jnp.sin(3.0 * path))

    at = jnp.array([9.7, 4.0])
    slope = jax.grad(moved)(at)
    for i, h in enumerate((1e-6, 1e-6)):
        step = jnp.zeros(2).at[i].set(h)
        difference = (moved(at + step) - moved(at - step)) / (2.0 * h)
        np.testing.assert_allclose(slope[i], difference, rtol=2e-5)


def test_gradients_of_a_circle_equal_the_closed_form():
    frequency, radius = 3.0, 4.0
    dx = jax.jacfwd(contours.circle, argnums=(1, 2))(TIME, frequency, radius)
    t = np.asarray(TIME)
    w = 2.0 * np.pi * frequency * t
    by_frequency = 2.0 * np.pi * t * radius * np.stack([np.sin(w), np.cos(w)])
    np.testing.assert_allclose(dx[0], by_frequency.T, atol=1e-10)
    np.testing.assert_allclose(dx[1], np.stack([1 - np.cos(w), 1 + np.sin(w)], 1))


# ---- names ----


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Rx+Ry:CIRCLE5", {"Rx": "SIN5", "Ry": "COS5"}),
        ("Ry+Rx:CIRCLE2.5", {"Ry": "SIN2.5", "Rx": "COS2.5"}),
        ("Rx+Ry:LISSAJOUS5/4", {"Rx": "SIN5", "Ry": "COS4"}),
        ("Rx+Ry:LISSAJOUS2/1.5", {"Rx": "COS2", "Ry": "SIN1.5"}),
        ("Rx+Ry:LISSAJOUS6/2", {"Rx": "SIN6", "Ry": "COS2"}),
        ("Rx+Ry:RASTER10", {"Rx": "SCAN10", "Ry": "TRI0.5"}),
        ("Rx+Ry:RASTER0.001", {"Rx": "SCAN0.001", "Ry": "TRI0.00005"}),
        ("Rx+Ry:RASTER10/0.25 Z:SIN1", {"Rx": "SCAN10", "Ry": "TRI0.25", "Z": "SIN1"}),
    ],
)
def test_names_stand_for_two_signals(name, expected):
    assert motions.parse(name, AXES) == expected
    amplitudes, offsets = (5.0, 50.0, 40.0), (0.0, 1.0, 2.0)
    spelled = " ".join(f"{axis}:{kind}" for axis, kind in expected.items())
    np.testing.assert_array_equal(
        motions.motion(name, TIME, AXES, amplitudes, offsets),
        motions.motion(spelled, TIME, AXES, amplitudes, offsets),
    )
    one, other = name.partition(":")[0].split("+")
    assert motions.contour_axes(name, AXES) == (AXES.index(one), AXES.index(other))
    assert motions.contour_axes(spelled, AXES) is None


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("Rx+Ry:CIRCLE5", contours.circle(TIME, 5.0)),
        ("Rx+Ry:LISSAJOUS5/4", contours.lissajous(TIME, 1.0, (5, 4))),
        ("Rx+Ry:LISSAJOUS4/10", contours.lissajous(TIME, 2.0, (2, 5))),
        ("Rx+Ry:RASTER10", contours.raster(TIME, 10.0)),
        ("Rx+Ry:RASTER10/2", contours.raster(TIME, 10.0, lines=5)),
    ],
)
def test_named_contours_equal_the_functions(name, path):
    found = motions.motion(name, TIME, AXES, (5.0,) * 3, (0.0,) * 3)
    np.testing.assert_allclose(found[:, 1:], path, atol=1e-9)
    np.testing.assert_array_equal(found[:, 0], 0.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Rx+Ry:SIN5", "contour 'SIN5' is unknown; it must have the form of one"),
        ("Rx+Ry:CIRCLE5/4", "contour 'CIRCLE5/4' is unknown"),
        ("Rx+Ry:CIRCLE", "contour 'CIRCLE' is unknown"),
        ("Rx+Ry:LISSAJOUS5", "contour 'LISSAJOUS5' is unknown"),
        ("Rx+Ry:LISSAJOUS5/0", "contour 'LISSAJOUS5/0' is unknown"),
        ("Rx+Ry:RASTER0", "frequencies in Hz above 0"),
        ("Rx:CIRCLE5", "signal 'CIRCLE5' is unknown"),
        ("Rx+Rx:CIRCLE5", "drives Rx twice"),
        ("Rx+Ry:CIRCLE5 Ry:SIN1", "drives Ry twice"),
        ("Rx+W:CIRCLE5", "must be an axis, one of Z, Rx, Ry"),
        ("Z+Rx+Ry:CIRCLE5", "or two axes and a contour, as in X\\+Y:CIRCLE5"),
    ],
)
def test_other_names_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        motions.parse(name, AXES)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: contours.circle(TIME, rise=-1.0), "rise in s is -1; it must be"),
        (lambda: contours.lissajous(TIME, 1.0, (4, 2)), "cycles are \\(4, 2\\)"),
        (lambda: contours.lissajous(TIME, 1.0, (0, 1)), "positive whole numbers"),
        (lambda: contours.raster(TIME, lines=1), "lines is 1; it must be a whole"),
        (lambda: contours.raster(TIME, turnaround=0.6), "turnaround is 0.6; it must"),
        (lambda: distance_to(np.zeros((1, 2)), np.zeros((1, 2))), "path has 1 points"),
    ],
)
def test_bad_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# ---- contour error ----


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize(("gain", "lag"), [(1.0, 0.3), (0.9, 0.0), (1.1, 0.5)])
def test_the_error_on_a_circle_excludes_the_lag(gain, lag, direction):
    angles = direction * 2.0 * np.pi * 5.0 * np.asarray(TIME)
    reference, found = bend(angles), gain * bend(angles - direction * lag)
    run = sample_of(reference, found)
    result = figures(ContourError(start=100), run)
    np.testing.assert_allclose(result, abs(gain - 1.0) * 5.0, rtol=1e-9, atol=1e-9)
    exact = distance_to(found[:50], bend(np.linspace(0.0, 2.0 * np.pi, 20_001)))
    np.testing.assert_allclose(exact, abs(gain - 1.0) * 5.0, atol=1e-6)


def test_the_error_along_a_line_does_not_count():
    along, across = np.array([0.8, 0.6]), np.array([-0.6, 0.8])
    reference = 30.0 * np.asarray(TIME)[:, None] * along
    run = sample_of(reference, reference - 2.0 * along + 0.25 * across)
    np.testing.assert_allclose(figures(ContourError(), run), 0.25, rtol=1e-9)


def test_at_rest_and_at_reversals_the_whole_distance_counts():
    still = np.zeros((50, 2)) + 3.0
    run = sample_of(still, still + [0.3, 0.4])
    np.testing.assert_allclose(figures(ContourError(), run), 0.5, rtol=1e-12)
    back = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(
        figures(ContourError(), sample_of(back, back + [0.3, 0.4])), 0.5, rtol=1e-12
    )


def circles(reference, displacement):
    """Return distances from circles through three points, by a linear solve."""
    found = []
    for k in range(1, len(reference) - 1):
        a, b, c = reference[k - 1 : k + 2]
        middle = np.linalg.solve(
            2.0 * np.array([b - a, c - b]), np.array([b @ b - a @ a, c @ c - b @ b])
        )
        radius = np.linalg.norm(b - middle)
        found.append(abs(np.linalg.norm(displacement[k] - middle) - radius))
    return np.array(found)


def wavy(seed=1):
    t = TIME[:400]
    noise = np.random.default_rng(seed).normal(size=(len(t), 2))
    path = np.asarray(contours.lissajous(t, 4.87, (3, 2), (5.0, 8.0), rise=0.01))
    return path, path + 0.3 + 0.1 * noise


@pytest.mark.parametrize("start", [0, 1, 2, 150, 398])
def test_figures_equal_those_of_an_oracle(start):
    reference, found = wavy()
    expected = circles(reference, found)[max(start - 1, 0) :]
    three = [np.insert(points, 1, 99.0, axis=1) for points in (reference, found)]
    result = figures(ContourError((0, 2), start), sample_of(*three))
    np.testing.assert_allclose(result.rms, np.sqrt(np.mean(expected**2)), rtol=1e-7)
    np.testing.assert_allclose(result.peak, expected.max(), rtol=1e-7)


def test_the_error_is_close_to_the_distance_from_the_path():
    reference, _ = wavy()
    found = reference[:-3] + [0.02, -0.03]  # 3 samples late, with an error
    exact = distance_to(found[100:], reference)
    result = figures(ContourError(start=100), sample_of(reference[3:], found))
    np.testing.assert_allclose(result.rms, np.sqrt(np.mean(exact**2)), rtol=0.05)
    assert np.linalg.norm(reference[3:] - found, axis=1)[100:].mean() > 5 * result.rms


def test_a_run_that_ends_before_the_start_has_no_figures():
    reference, found = wavy()
    result = figures(ContourError(start=399), sample_of(reference, found))
    assert np.all(np.isnan(result))


def test_gradient_equals_finite_differences_and_is_zero_without_error():
    reference, found = wavy()

    def total(displacement):
        run = sample_of(reference, reference)
        run = run._replace(displacement=(displacement[:, 0], displacement[:, 1]))
        result = figures(ContourError(), run)
        return result.rms + result.peak

    slope = jax.grad(total)(jnp.asarray(found))
    direction = np.random.default_rng(2).normal(size=found.shape)
    h = 1e-6
    difference = (total(found + h * direction) - total(found - h * direction)) / (2 * h)
    np.testing.assert_allclose(np.sum(slope * direction), difference, rtol=1e-6)
    perfect = jax.grad(total)(jnp.asarray(reference))
    np.testing.assert_array_equal(perfect, np.zeros_like(perfect))
    still = jnp.zeros((20, 2))
    at_rest = jax.grad(
        lambda d: (
            figures(
                ContourError(),
                LoopSample(
                    *(((still[:, 0], still[:, 1]),) + ((d[:, 0], d[:, 1]),) * 4)
                ),
            ).rms
        )
    )(still)
    np.testing.assert_array_equal(at_rest, still)
