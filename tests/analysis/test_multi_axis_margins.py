"""Margins of the 3-DOF loops against python-control and against simulations.

The controllers of the oracle are plain loops; their matrices follow from runs with one
number of their state set to 1.
"""

import json
import math

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from oracles import three_dof
from oracles.three_dof import T
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment, minimize

import piezojax as pj
from piezojax import Feedback, Saturation, Sensor
from piezojax.analysis.stability import (
    BrokenLoop,
    axes_report_of,
    broken_loop,
    report_of,
)
from piezojax.analysis.stability.axes_margins import balancing, structured_bound
from piezojax.analysis.stability.conserved import LinearAxes, LinearLoop
from piezojax.analysis.stability.margins import _matrices, linear_axes
from piezojax.analysis.stability.operating_point import OperatingPoint
from piezojax.catalog import p558_control, p753
from piezojax.core.feedback import LoopInput

REST = (0.0, 0.0, 0.0)
STATE = {
    three_dof.PID: ("law.total", "law.before"),
    three_dof.PIDSMC: (
        *("filter.yh", "filter.v", "law.total", "law.before", "w"),
        *("yd.0", "yd.1", "e.0", "e.1", "u1.0", "u1.1", "u2.0", "u2.1"),
    ),
}


def place(controller, path):
    """Return the place of a number of the controller's state: container and key."""
    owner, _, key = path.rpartition(".")
    if not owner:
        return vars(controller), key
    kept = getattr(controller, owner)
    return (kept, int(key)) if isinstance(kept, list) else (vars(kept), key)


def controller_matrices(make):
    """Return A, B, C, D of a plain controller from measurements to commands."""
    paths = STATE[type(make())]
    shapes = [(3, 2) if path == "w" else (3,) for path in paths]
    sizes = [math.prod(shape) for shape in shapes]
    n = sum(sizes)

    def stepped(x, z):
        controller = make()
        parts = np.split(x, np.cumsum(sizes)[:-1])
        for path, part, shape in zip(paths, parts, shapes, strict=True):
            kept, key = place(controller, path)
            kept[key] = part.reshape(shape)
        command, _ = controller.step(z, np.zeros(3), np.zeros(3))
        after = (place(controller, path) for path in paths)
        following = [np.ravel(kept[key]) for kept, key in after]
        return np.concatenate([*following, command])

    columns = [stepped(row[:n], row[n:]) for row in np.eye(n + 3)]
    both = np.array(columns).T
    return both[:n, :n], both[:n, n:], both[n:, :n], both[n:, n:]


LOOPS = {
    "pid": (p558_control.pid, three_dof.PID),
    "dynamic": (p558_control.multi_axis, three_dof.PIDSMC),
}


@pytest.fixture(scope="module", params=list(LOOPS))
def both(request):
    """Return the report of a loop, and the stage and controller of the oracle."""
    ours, theirs = LOOPS[request.param]
    report = pj.stability_report(p558_control.loop(ours()), REST)
    stage = control.ss(*three_dof.stacked(), np.zeros((3, 3)), T)
    return report, stage, control.ss(*controller_matrices(theirs), T)


@pytest.fixture(scope="module")
def pair(both):
    report, stage, K = both
    return report, -(K * stage)


def response(system, hertz):
    """Return the response [lines, q, q] on the unit circle at ascending frequencies."""
    omega = 2.0 * np.pi * np.atleast_1d(hertz)
    return np.moveaxis(control.frequency_response(system, omega).frdata, -1, 0)


def largest(matrices):
    return np.linalg.svd(matrices, compute_uv=False)[:, 0]


def closed_poles(L, gains):
    """Return the closed-loop poles of python-control's L with gains in front."""
    return np.linalg.eigvals(L.A - L.B @ gains @ L.C)


def test_poles(pair):
    report, L = pair
    theirs = closed_poles(L, np.eye(3))
    # Deadbeat states give a multiple pole at 0, which rounding errors separate.
    theirs = theirs[np.abs(theirs) > 0.1]
    ours = np.array(report.poles)
    ours = ours[np.abs(ours) > 0.1]
    assert len(ours) == len(theirs)
    distance = np.abs(ours[:, None] - theirs)
    assert distance[linear_sum_assignment(distance)].max() < 1e-6
    assert report.stable
    assert report.conserved == 0
    assert report.dt_s == T
    assert report.slowest_time_constant_s == pytest.approx(
        -T / math.log(np.abs(theirs).max()), rel=1e-6
    )


def test_peaks_of_the_largest_singular_value(pair):
    report, L = pair
    for name in ("sensitivity_peak", "complementary_peak"):
        at, expected = getattr(report, f"{name}_Hz"), getattr(report, name)
        everywhere = np.unique([*np.geomspace(1e-3, 0.5 / T, 6_000), at])
        S = np.linalg.inv(np.eye(3) + response(L, everywhere))
        values = largest(S if name == "sensitivity_peak" else np.eye(3) - S)
        assert values[everywhere == at] == pytest.approx(expected, rel=1e-6)
        assert values.max() == pytest.approx(expected, rel=1e-6)


def test_the_peak_of_the_loop_cut_at_its_displacements(both):
    report, stage, K = both
    L = -(stage * K)
    at, expected = report.output_sensitivity_peak_Hz, report.output_sensitivity_peak
    everywhere = np.unique([*np.geomspace(1e-3, 0.5 / T, 6_000), at])
    values = largest(np.linalg.inv(np.eye(3) + response(L, everywhere)))
    assert values[everywhere == at] == pytest.approx(expected, rel=1e-6)
    assert values.max() == pytest.approx(expected, rel=1e-6)
    peaks = report.sensitivity_peak, expected
    assert report.largest_sensitivity_peak == max(peaks)
    assert peaks[0] != pytest.approx(peaks[1], rel=1e-4)


def test_one_axis_has_the_same_sensitivity_at_both_cuts():
    loop = Feedback(p753.pid(), p753.plant(), Saturation(-20.0, 120.0), Sensor(0.0))
    angle = np.geomspace(1e-4, np.pi, 50)
    before, behind = (
        cut.sensitivity(angle) for cut in linear_axes(loop, OperatingPoint(2.0))[:2]
    )
    np.testing.assert_allclose(behind, before, rtol=1e-8)


def one_axis(matrices, axis):
    """Return L of one axis with the other loops closed, by elimination."""
    others = [i for i in range(3) if i != axis]
    rest = np.eye(2) + matrices[:, others][:, :, others]
    back = np.linalg.solve(rest, matrices[:, others, axis][..., None])[..., 0]
    across = matrices[:, axis][:, others]
    return matrices[:, axis, axis] - np.sum(across * back, axis=1)


# python-control 0.10.2 sets the shape of an array, which NumPy 2.5 warns about.
@pytest.mark.filterwarnings("ignore:Setting the shape on a NumPy array")
@pytest.mark.parametrize("axis", range(3))
def test_margins_of_each_axis_alone(pair, axis):
    report, L = pair
    found = report.axes[axis]
    omega = 2.0 * np.pi * np.geomspace(1e-3, 0.4999 / T, 6_000)
    alone = one_axis(response(L, omega / (2.0 * np.pi)), axis)
    factors, phases, distance, _, at_phase, _ = control.stability_margins(
        control.frd(alone, omega, smooth=True), returnall=True
    )
    nyquist = one_axis(response(L, 0.5 / T), axis)[0].real
    factors = np.append(factors, -1.0 / nyquist)
    assert found.gain_margin == pytest.approx(factors[factors > 1.0].min(), rel=1e-6)
    assert found.sensitivity_peak == pytest.approx(1.0 / distance.min(), rel=1e-5)
    if len(phases):
        assert found.phase_margin_deg == pytest.approx(np.abs(phases).min(), rel=1e-6)
        delay = np.min(np.radians(phases % 360.0) / at_phase) / T
        assert found.delay_margin_samples == pytest.approx(delay, rel=1e-6)
    disk = np.abs(0.5 * (1.0 - alone) / (1.0 + alone)).max()
    assert found.disk_margin == pytest.approx(1.0 / disk, rel=1e-5)
    # The margin of all axes at once is at most that of one axis alone.
    assert report.disk_margin <= found.disk_margin


def worst_phases(matrix):
    """Return the largest spectral radius of M U over diagonal unitary U, and that U."""

    def radius(phases):
        turned = matrix * np.exp(1j * np.append(phases, 0.0))
        return -np.abs(np.linalg.eigvals(turned)).max()

    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    start = min(((a, b) for a in turn for b in turn), key=radius)
    options = {"xatol": 1e-9, "fatol": 1e-13}
    best = minimize(radius, start, method="Nelder-Mead", options=options)
    return -best.fun, np.exp(1j * np.append(best.x, 0.0))


def test_the_smallest_destabilising_change_equals_the_margin_of_all_axes(pair):
    report, L = pair
    at = report.disk_margin_Hz
    matrix = response(L, at)[0]
    half = np.linalg.inv(np.eye(3) + matrix) - 0.5 * np.eye(3)
    radius, U = worst_phases(half)
    assert report.disk_margin == pytest.approx(1.0 / radius, rel=1e-6)
    # Perturbations of this size, one per axis, move a pole to the unit circle.
    values = np.linalg.eigvals(half * U)
    delta = U / values[np.argmax(np.abs(values))]
    assert np.abs(delta) == pytest.approx(report.disk_margin, rel=1e-6)
    factors = (2.0 + delta) / (2.0 - delta)
    assert np.linalg.svd(np.eye(3) + matrix * factors)[1][-1] < 1e-6
    # No other frequency has a smaller one, and scaling reduces the bound.
    others = np.linalg.inv(np.eye(3) + response(L, np.geomspace(0.01, 249.0, 40)))
    for other in others - 0.5 * np.eye(3):
        assert worst_phases(other)[0] <= 1.0 / report.disk_margin * (1.0 + 1e-9)
        assert structured_bound(other)[0] <= np.linalg.norm(other, 2) * (1.0 + 1e-12)


def test_gains_within_the_margin_are_stable(pair):
    report, L = pair
    limit = math.log(report.disk_gain_margin)
    draws = np.random.default_rng(0).uniform(-limit, limit, (40, 3))
    for gains in np.exp(draws):
        assert np.abs(closed_poles(L, np.diag(gains))).max() < 1.0


@pytest.fixture(scope="module")
def loop():
    return p558_control.loop(p558_control.multi_axis())


def test_a_free_run_equals_the_prediction_of_the_matrices(loop):
    # as in the reports, before its states are balanced
    A, B, C, _, dt, _ = _matrices(loop, OperatingPoint(REST), BrokenLoop)
    model = LinearAxes(A, B, C, dt)
    rest = eqx.filter_jit(broken_loop)(loop, REST)
    kicked = tuple(jnp.array(x) for x in (1.0, -2.0, 0.5))
    state = rest.init()._replace(displacement=kicked)
    x = np.asarray(ravel_pytree(state)[0] - ravel_pytree(rest.init())[0])
    closed, C = model.closed(), model.C
    poles = np.abs(np.linalg.eigvals(closed))
    predicted = []
    for _ in range(5_000):
        predicted.append(-C @ x)
        x = closed @ x
    quiet = (jnp.zeros(5_000),) * 3
    start = rest.start._replace(displacement=kicked)
    _, log = pj.simulate(loop, LoopInput(quiet, quiet, None), start)
    run = np.stack(log.voltage, axis=-1)
    np.testing.assert_allclose(run, predicted, rtol=0.0, atol=1e-9)
    # The remainder decays with the slowest pole.
    left = np.abs(np.stack(log.displacement, axis=-1)).max(axis=1)
    pole = (left[4_900] / left[4_500]) ** (1.0 / 400.0)
    assert poles.max() == pytest.approx(pole, abs=1e-6)


@pytest.mark.parametrize(
    ("gains", "filtered", "pole"),
    [("dynamic", True, 0.9985), ("step", True, 0.996), ("step", False, 0.990)],
)
def test_largest_poles_of_chapter_7(gains, filtered, pole):
    """Compare the poles with those of an independent linearisation."""
    loop = p558_control.loop(p558_control.multi_axis(gains, filtered))
    linear, *_ = linear_axes(loop, REST)
    largest = np.abs(np.linalg.eigvals(linear.closed())).max()
    assert largest == pytest.approx(pole, abs=5e-4)


def test_the_printed_sign_of_phi_is_unstable(loop):
    def reaching(loop):
        return loop.controller.controller.reaching

    flipped = eqx.tree_at(reaching, loop, jax.tree.map(lambda x: -x, reaching(loop)))
    report = pj.stability_report(flipped, np.zeros(3))
    assert not report.stable
    assert abs(report.poles[0]) == pytest.approx(1.33, abs=5e-3)
    assert report.axes == ()
    assert report.disk_margin is None
    values = report.as_dict()
    assert json.loads(json.dumps(values, allow_nan=False)) == values


def test_limits_of_every_axis_are_removed(loop):
    def limits(loop):
        leaves = jax.tree.leaves(
            loop.actuator, is_leaf=lambda x: isinstance(x, pj.hardware.Saturation)
        )
        return [x for x in leaves if isinstance(x, pj.hardware.Saturation)]

    assert len(limits(loop)) == 3
    assert limits(broken_loop(loop, REST).loop) == []


def test_a_reference_beyond_the_limits_is_refused(loop):
    with pytest.raises(ValueError, match="the loop cannot rest at 0, 20000, 0 um"):
        pj.stability_report(loop, (0.0, 2e4, 0.0))


def scalar_loops():
    """Return stable loops y(k+1) = a y + g u, u = -y, with known margins."""
    one = np.ones(1)
    return [
        LinearLoop(np.array([[a]]), one, gain * one, T)
        for a, gain in ((0.9, 0.4), (0.5, 0.2), (1.2, 0.7))
    ]


def test_uncoupled_axes_have_the_margins_of_scalar_loops():
    loops = scalar_loops()
    A, B, C = (
        block_diag(*(getattr(x, name).reshape(1, 1) for x in loops)) for name in "ABC"
    )
    report = axes_report_of(LinearAxes(A, B, C, T))
    alone = [report_of(loop) for loop in loops]
    for ours, theirs in zip(report.axes, alone, strict=True):
        assert ours.gain_margin == pytest.approx(theirs.gain_margin, rel=1e-9)
        assert ours.disk_margin == pytest.approx(theirs.disk_margin, rel=1e-9)
    smallest = min(one.disk_margin for one in alone)
    assert report.disk_margin == pytest.approx(smallest, rel=1e-9)
    highest = max(one.sensitivity_peak for one in alone)
    assert report.sensitivity_peak == pytest.approx(highest, rel=1e-9)
    values = report.as_dict()
    assert json.loads(json.dumps(values, allow_nan=False)) == values


def test_the_margin_of_all_axes_does_not_depend_on_their_units():
    rng = np.random.default_rng(1)
    A = 0.3 * rng.standard_normal((4, 4))
    B, C = rng.standard_normal((4, 3)), 0.05 * rng.standard_normal((3, 4))
    units = np.array([1.0, 1e3, 1e-2])
    one = axes_report_of(LinearAxes(A, B, C, T))
    other = axes_report_of(LinearAxes(A, B * units, C / units[:, None], T))
    assert other.disk_margin == pytest.approx(one.disk_margin, rel=1e-6)
    assert other.sensitivity_peak != pytest.approx(one.sensitivity_peak, rel=1e-2)


def test_balancing_finds_the_units_of_a_symmetric_matrix():
    rng = np.random.default_rng(2)
    matrices = rng.standard_normal((5, 3, 3)) + 1j * rng.standard_normal((5, 3, 3))
    matrices += np.swapaxes(matrices, 1, 2)
    units = np.exp(rng.uniform(-5.0, 5.0, (5, 3)))
    units /= units[:, -1:]
    found, balanced = balancing(matrices / units[:, :, None] * units[:, None, :])
    np.testing.assert_allclose(found, units, rtol=1e-6)
    np.testing.assert_allclose(balanced, matrices, rtol=1e-6)
