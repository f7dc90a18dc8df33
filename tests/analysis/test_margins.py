"""Margins of linear loops against python-control and against simulations."""

import json
import math

import control
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from oracles import published, transfer

import piezojax as pj
from piezojax.analysis.stability import stability_reports
from piezojax.analysis.stability.assess import worst_margins
from piezojax.analysis.stability.conserved import LinearLoop
from piezojax.analysis.stability.crossings import angle_grid, peak, roots
from piezojax.analysis.stability.margins import linear_loop, report_of
from piezojax.catalog import p753
from piezojax.core.feedback import LoopInput

DT = 5e-5
A, B = published.T2_P, published.T2_G
SLOPE = 0.15  # um/V
GAINS = published.smc_gains("dob", "5-3")
PIDS = {
    "integral": (0.0, 3000.0, 0.0, 0.0),
    "all": (1.0, 6000.0, 1e-4, 1e-4),
    "hard": (12.0, 9000.0, 1e-3, 2e-4),
}


def around(controller, gain=1.0, delay=0):
    parts = {
        "slope": pj.core.system.Affine(gain * SLOPE),
        "dynamics": pj.dynamics.ARMA(A, B),
    }
    if delay:
        parts["delay"] = pj.core.system.Delay(delay)
    limits = pj.hardware.Saturation(-1e300, 1e300)
    return pj.Feedback(controller, pj.series(**parts), limits, pj.hardware.Sensor(0.0))


def test_a_state_that_only_integrates_its_input_has_margins():
    # The pole of 1 + g / (z - 1) is 1 - g; it leaves the unit circle at g = 2.
    found = report_of(LinearLoop(np.eye(1), np.ones(1), np.array([0.5]), DT))
    assert found.gain_margin == pytest.approx(4.0)
    assert LinearLoop(np.eye(1), np.ones(1), np.ones(1), DT).integrates()
    assert not LinearLoop(0.9 * np.eye(1), np.ones(1), np.ones(1), DT).integrates()


def pid(name):
    return pj.control.PID(*PIDS[name], 50.0, dt=DT)


def dob():
    return p753.disturbance_observer()


LOOPS = {
    **{f"pid, {name}": (pid, name) for name in PIDS},
    "disturbance observer": (lambda _: dob(), ""),
}


def loop_of(name):
    make, argument = LOOPS[name]
    return around(make(argument))


def written(name):
    num, den = transfer.plant(A, B, SLOPE)
    if name.startswith("pid"):
        gains = PIDS[name.removeprefix("pid, ")]
        return transfer.pid_loop(*gains, DT, num, den)
    return transfer.disturbance_observer_loop(GAINS, DT, num, den)


@pytest.fixture(scope="module", params=list(LOOPS))
def pair(request):
    loop = loop_of(request.param)
    return loop, written(request.param), pj.stability_report(loop, 3.0)


def test_the_transfer_function_equals_the_equations(pair):
    loop, oracle, _ = pair
    frequency = np.geomspace(1.0, 10_000.0, 200)
    ours = linear_loop(loop, 3.0)[0].response(2.0 * np.pi * frequency * DT)
    theirs = oracle(np.exp(2j * np.pi * frequency * DT))
    np.testing.assert_allclose(ours, theirs, rtol=1e-7)


def test_the_closed_loop_response_equals_that_of_a_run(pair):
    """The loops are linear: the response to an impulse of the reference is y/r."""
    loop, _, report = pair
    samples = 24_000
    impulse = np.full(samples + 1, 3.0)
    impulse[1] += 1.0
    _, log = pj.simulate(loop, pj.loop_inputs(jnp.asarray(impulse)), loop.init(3.0))
    moved = np.asarray(log.displacement)[1:] - 3.0
    assert np.abs(moved[-400:]).max() < 1e-9
    hertz = np.arange(0.0, 10_000.0, 0.5)
    found = np.abs(scipy.signal.freqz(moved, worN=hertz, fs=1.0 / DT)[1])
    at = 2.0 * np.pi * hertz[1:] * DT
    ours = np.abs(linear_loop(loop, 3.0)[0].followed.response(at))
    np.testing.assert_allclose(ours, found[1:], rtol=1e-6, atol=1e-9)
    for field, decibel in (("bandwidth_Hz", -3.0), ("bandwidth_1dB_Hz", -1.0)):
        first = hertz[np.argmax(found < 10.0 ** (decibel / 20.0))]
        assert first - 0.5 <= getattr(report.following, field) <= first
    assert report.following.closed_loop_peak == pytest.approx(found.max(), rel=1e-4)


@pytest.mark.parametrize("name", list(PIDS))
def test_a_limited_reference_follows_small_motions_as_without_limits(name):
    """Its state sums up the changes of r, and only r(k) and r(k+1) alone move it."""
    limited = pj.control.LimitedReference(pid(name), 1e4, DT, acceleration=1e8)
    plain, found = (
        pj.stability_report(around(one), 3.0) for one in (pid(name), limited)
    )
    assert found.stable
    for figure in ("bandwidth_Hz", "bandwidth_1dB_Hz", "closed_loop_peak"):
        expected = getattr(plain.following, figure)
        assert getattr(found.following, figure) == pytest.approx(expected, rel=1e-6)


def test_a_loop_that_does_not_follow_has_no_bandwidth():
    report = pj.stability_report(around(pj.control.PID(0.5, 0.0, dt=DT)), 0.0)
    assert report.following.bandwidth_Hz == 0.0
    assert report.following.closed_loop_peak < 0.5


def test_poles(pair):
    _, oracle, report = pair
    ours = np.array(report.poles)
    ours = ours[np.abs(ours) > 0.1]  # deadbeat states add poles at 0
    slope = (oracle(ours * (1 + 1e-7)) - oracle(ours * (1 - 1e-7))) / (2e-7 * ours)
    miss = np.abs((1.0 + oracle(ours)) / slope)
    assert miss.max() < 1e-6
    assert report.stable
    assert report.conserved == 0
    if isinstance(oracle, control.TransferFunction):
        theirs = control.feedback(oracle, 1).poles()
        theirs = theirs[np.abs(theirs) > 0.1]
        assert len(theirs) == len(ours)
        assert max(np.abs(ours - pole).min() for pole in theirs) < 1e-6


def sampled(oracle):
    """Return a sampled response for python-control, accurate for any order."""
    omega = np.geomspace(3.0, 0.99999 * np.pi / DT, 8_000)
    return control.frd(oracle(np.exp(1j * omega * DT)), omega, smooth=True)


def test_gain_phase_and_delay_margins(pair):
    _, oracle, report = pair
    factors, phases, _, at_factor, at_phase, _ = control.stability_margins(
        sampled(oracle), returnall=True
    )
    factors = np.append(factors, -1.0 / oracle(-1.0 + 0j).real)
    at_factor = np.append(at_factor, np.pi / DT)
    first = np.argmin(np.where(factors > 1.0, factors, np.inf))
    assert report.gain_margin == pytest.approx(factors[first], rel=1e-6)
    assert report.gain_margin_dB == pytest.approx(
        20.0 * math.log10(factors[first]), rel=1e-6
    )
    hertz = at_factor[first] / (2.0 * np.pi)
    assert report.phase_crossover_Hz == pytest.approx(hertz, rel=1e-6)
    worst = np.argmin(np.abs(phases))
    assert report.phase_margin_deg == pytest.approx(np.abs(phases[worst]), rel=1e-6)
    hertz = at_phase[worst] / (2.0 * np.pi)
    assert report.gain_crossover_Hz == pytest.approx(hertz, rel=1e-6)
    delay = np.min(np.radians(phases % 360.0) / at_phase)
    assert report.delay_margin_s == pytest.approx(delay, rel=1e-6)
    assert report.delay_margin_samples == pytest.approx(delay / DT, rel=1e-6)


# python-control 0.10.2 sets the shape of an array, which NumPy 2.5 warns about.
@pytest.mark.filterwarnings("ignore:Setting the shape on a NumPy array")
def test_sensitivity_peaks_and_disk_margins(pair):
    loop, oracle, report = pair
    distance = control.stability_margins(sampled(oracle))[2]
    assert report.sensitivity_peak == pytest.approx(1.0 / distance, rel=1e-6)
    # At our peaks the oracle has the same value, and nowhere a larger one.
    for name, function in (
        ("complementary_peak", lambda L: L / (1.0 + L)),
        ("sensitivity_peak", lambda L: 1.0 / (1.0 + L)),
    ):
        top = 2.0 * np.pi * getattr(report, f"{name}_Hz")
        grid = np.append(np.geomspace(1e-2, np.pi / DT, 8_000), top)
        values = np.abs(function(oracle(np.exp(1j * grid * DT))))
        assert values.max() == pytest.approx(getattr(report, name), rel=1e-7)
    linear = linear_loop(loop, 3.0)[0]  # compared with the oracle in the test above
    model = control.ss(linear.A, linear.B[:, None], linear.C[None], 0.0, DT)
    grid = np.geomspace(10.0, np.pi / DT, 400)
    worst = grid[np.argmin(disk(model, grid)[0])]
    fine = np.minimum(worst * np.linspace(0.98, 1.02, 2_001), np.pi / DT)
    alpha, decibel, phase = (values.min() for values in disk(model, fine))
    assert report.disk_margin == pytest.approx(alpha, rel=1e-6)
    ours = 20.0 * math.log10(report.disk_gain_margin)
    assert ours == pytest.approx(decibel, rel=1e-6)
    assert report.disk_phase_margin_deg == pytest.approx(phase, rel=1e-6)


def disk(model, omega):
    """Return the disk margin of python-control: gain in dB, phase in degrees."""
    return control.disk_margins(model, omega, skew=0.0, returnall=True)


def error_growth(loop, samples=4_000):
    """Return the ratio of the last tenth of an impulse response to the tenth before."""
    inputs = LoopInput(
        jnp.zeros(samples), jnp.zeros(samples), jnp.zeros(samples).at[0].set(1e-3)
    )
    _, log = pj.simulate(loop, inputs)
    size = np.abs(np.asarray(log.displacement))
    tenth = samples // 10
    return size[-tenth:].max() / size[-2 * tenth : -tenth].max()


@pytest.mark.parametrize("name", ["pid, hard", "disturbance observer"])
def test_a_delay_beyond_the_margin_makes_the_loop_unstable(name):
    make, argument = LOOPS[name]
    report = pj.stability_report(loop_of(name))
    assert 1.0 < report.delay_margin_samples < 50.0
    whole = math.floor(report.delay_margin_samples)
    below, above = (around(make(argument), delay=n) for n in (whole, whole + 1))
    assert pj.stability_report(below).stable
    assert not pj.stability_report(above).stable
    assert error_growth(below) < 1.0 < error_growth(above)


@pytest.mark.parametrize("name", ["pid, hard", "disturbance observer"])
def test_a_gain_beyond_the_margin_makes_the_loop_unstable(name):
    make, argument = LOOPS[name]
    margin = pj.stability_report(loop_of(name)).gain_margin
    below, above = (around(make(argument), gain=margin * x) for x in (0.98, 1.02))
    assert pj.stability_report(below).stable
    assert not pj.stability_report(above).stable
    assert error_growth(below) < 1.0 < error_growth(above)


def test_the_slowest_pole_equals_the_decay_of_a_run():
    report = pj.stability_report(loop_of("disturbance observer"))
    samples = 12_000
    kick = jnp.zeros(samples).at[0].set(1.0)
    inputs = LoopInput(jnp.zeros(samples), jnp.zeros(samples), kick)
    _, log = pj.simulate(loop_of("disturbance observer"), inputs)
    left = np.abs(np.asarray(log.displacement))
    first, last = 9_000, 11_000
    pole = (left[last] / left[first]) ** (1.0 / (last - first))
    assert abs(report.poles[0]) == pytest.approx(pole, abs=1e-7)
    assert report.slowest_time_constant_s == pytest.approx(
        -DT / math.log(pole), rel=1e-3
    )


def test_an_unstable_loop_has_poles_and_no_margins():
    report = pj.stability_report(around(pid("hard"), gain=10.0))
    assert not report.stable
    assert abs(report.poles[0]) > 1.0
    assert report.gain_margin is None
    assert report.sensitivity_peak is None
    assert report.slowest_time_constant_s is None
    json.dumps(report.as_dict(), allow_nan=False)


def test_a_loop_without_crossover_has_a_gain_margin_only():
    """L = 0.5 p is a circle of radius 0.5: only a larger gain destabilises the loop."""
    one = np.ones(1)
    report = report_of(LinearLoop(np.zeros((1, 1)), one, 0.5 * one, DT))
    assert report.gain_margin == pytest.approx(2.0)  # at the Nyquist frequency
    assert report.phase_crossover_Hz == pytest.approx(0.5 / DT)
    assert report.gain_reduction_margin == 0.0
    assert report.phase_margin_deg == math.inf
    assert report.delay_margin_s == math.inf
    assert report.sensitivity_peak == pytest.approx(2.0)
    assert report.complementary_peak == pytest.approx(1.0)
    values = report.as_dict()
    assert values["phase_margin_deg"] is None
    assert json.loads(json.dumps(values, allow_nan=False)) == values


def test_positive_feedback_becomes_unstable_at_frequency_zero():
    one = np.ones(1)
    report = report_of(LinearLoop(np.array([[0.5]]), one, -0.25 * one, DT))
    assert report.gain_margin == pytest.approx(2.0)
    assert report.phase_crossover_Hz == 0.0


def test_a_conditionally_stable_loop_can_lose_too_much_gain():
    """An unstable plant y(k+1) = 1.2 y + u under u = -0.5 y: 0.2 < gain < 2.2."""
    one = np.ones(1)
    report = report_of(LinearLoop(np.array([[1.2]]), one, 0.5 * one, DT))
    assert report.stable
    assert report.gain_reduction_margin == pytest.approx(0.4)
    assert report.gain_margin == pytest.approx(4.4)


def test_a_pole_on_the_unit_circle_is_not_stable():
    """y(k+1) = u under u = -y oscillates for ever, with its pole at -1."""
    one = np.ones(1)
    report = report_of(LinearLoop(np.zeros((1, 1)), one, one, DT))
    assert not report.stable
    assert report.poles == (-1.0,)


@pytest.mark.parametrize("gain", [0.3, 1.4])
def test_growth_of_the_gain_by_less_than_two_is_no_loss(gain):
    """The same plant: for a gain of 1.4 the factor 2.2 / 1.4 lies between 1 and 2."""
    one = np.ones(1)
    report = report_of(LinearLoop(np.array([[1.2]]), one, gain * one, DT))
    assert report.gain_margin == pytest.approx(2.2 / gain)
    assert report.gain_reduction_margin == pytest.approx(0.2 / gain)


def test_curves_equal_the_responses_of_the_equations():
    loop, oracle = loop_of("pid, all"), written("pid, all")
    reports = stability_reports({"after": loop}, 3.0)
    (curves,) = reports.curves("after", 2.5).values()
    frequency = curves.frequency
    assert frequency[-1] == pytest.approx(0.5 / DT, rel=1e-12)
    lowest = 0.5 / DT * 10.0**-2.5
    assert lowest < frequency[0] < 1.05 * lowest
    L = oracle(np.exp(2j * np.pi * frequency * DT))
    np.testing.assert_allclose(curves.L, L, rtol=1e-6)
    np.testing.assert_allclose(curves.S, 1.0 / (1.0 + L), rtol=1e-6)
    np.testing.assert_allclose(curves.T, L / (1.0 + L), rtol=1e-6)


def test_different_branches_have_separate_curves():
    loop = pj.Feedback(
        p753.pid(), p753.plant(), p753.actuator(), pj.hardware.Sensor(0.0)
    )
    reports = stability_reports({"after": loop}, 8.0)
    assert list(reports.curves("after", 3.0)) == ["ascending", "descending"]
    up, down = reports.curves("after", 3.0).values()
    slopes = [np.abs(branch.L[len(branch.L) // 2]) for branch in (up, down)]
    assert abs(slopes[0] / slopes[1] - 1.0) > 1e-3


def test_the_default_reference_is_the_middle():
    loop = pj.Feedback(
        p753.pid(), p753.plant(), p753.actuator(), pj.hardware.Sensor(0.0)
    )
    default, middle, other = (
        stability_reports({"after": loop}, *at).as_dict() for at in ((), (0.0,), (1.0,))
    )
    assert default == middle
    assert default != other


def test_every_loop_of_several_axes_is_reported():
    def loop(*names):
        return pj.Feedback(
            pj.PerAxis(tuple(pid(name) for name in names)),
            pj.PerAxis(tuple(around(pid("all")).plant for _ in names)),
            pj.PerAxis(tuple(around(pid("all")).actuator for _ in names)),
            pj.PerAxis(tuple(pj.hardware.Sensor(0.0) for _ in names)),
        )

    both = {"before": loop("integral", "all"), "after": loop("all", "all")}
    reports = stability_reports(both, (3.0, 3.0), DT, ("X", "Y"))
    assert list(reports.axes) == ["before", "after"]
    assert reports.problems == {}


def test_curves_of_several_axes_equal_those_of_each_axis():
    both = {
        name: pj.Feedback(
            pj.PerAxis(tuple(pid(n) for n in names)),
            pj.PerAxis(tuple(around(pid("all")).plant for _ in names)),
            pj.PerAxis(tuple(around(pid("all")).actuator for _ in names)),
            pj.PerAxis(tuple(pj.hardware.Sensor(0.0) for _ in names)),
        )
        for name, names in {"after": ("integral", "all")}.items()
    }
    reports = stability_reports(both, (3.0, 3.0), DT, ("X", "Y"))
    curves = reports.axes["after"].curves()
    assert curves.frequency[-1] == pytest.approx(0.5 / DT, rel=1e-12)
    z = np.exp(2j * np.pi * curves.frequency * DT)
    each = [np.abs(1.0 / (1.0 + written(f"pid, {n}")(z))) for n in ("integral", "all")]
    np.testing.assert_allclose(curves.each, each, rtol=1e-5)
    np.testing.assert_allclose(curves.largest, np.max(each, axis=0), rtol=1e-5)


def test_the_worst_margins_are_those_of_all_loops():
    loops = [
        LinearLoop(np.array([[a]]), np.ones(1), gain * np.ones(1), 1e-4)
        for a, gain in ((0.9, 0.4), (0.5, 0.2), (1.2, 0.7), (0.5, 2.0))
    ]
    *stable, unstable = map(report_of, loops)
    found = worst_margins(stable)._asdict()
    assert found.pop("sensitivity_peak") == max(r.sensitivity_peak for r in stable)
    for name, value in found.items():
        assert value == min(getattr(report, name) for report in stable)
    assert worst_margins([*stable, unstable]) is None


def test_roots_lie_where_the_function_is_zero():
    grid = np.linspace(-2.0, 2.0, 8)
    found = roots(lambda x: x**3 - x, grid, grid**3 - grid)
    assert sorted(found) == pytest.approx([-1.0, 0.0, 1.0], abs=1e-12)
    on_the_grid = np.array([0.0, 1.0, 2.0])
    assert list(roots(lambda x: x - 1.0, on_the_grid, on_the_grid - 1.0)) == [1.0]


@pytest.mark.parametrize(("offset", "nearest"), [(1.0, 0.0), (-1.5, 1.0)])
def test_a_sign_due_to_rounding_gives_the_end_nearest_to_zero(offset, nearest):
    """The values on the grid change sign, those of the function do not."""
    grid = np.array([0.0, 1.0])
    found = roots(lambda x: x + offset, grid, np.array([-1e-17, 1e-17]))
    assert list(found) == [nearest]


def test_branches_that_differ_by_rounding_share_their_curves():
    loop = around(pid("all"))
    weights = np.array([1e-7 * SLOPE])
    play = pj.hysteresis.PrandtlIshlinskii((SLOPE,), (1.0,), weights)
    plant = pj.series(slope=play, dynamics=pj.dynamics.ARMA(A, B))
    loop = pj.Feedback(loop.controller, plant, loop.actuator, loop.sensor)
    reports = stability_reports({"after": loop}, 3.0)
    up, down = (report.gain_margin for report in reports.reports["after"].values())
    assert 1e-9 < abs(up / down - 1.0) < 1e-6
    assert list(reports.curves("after", 3.0)) == ["ascending"]


def test_both_branches_of_several_axes_are_reported():
    """Plays of negative weight: the stage moves more on the descending branch."""
    one = around(pid("hard"))
    play = pj.hysteresis.PrandtlIshlinskii((SLOPE,), (1.0,), (-0.2 * SLOPE,))
    plant = pj.series(slope=play, dynamics=pj.dynamics.ARMA(A, B))
    parts = (one.controller, plant, one.actuator, one.sensor)
    loop = pj.Feedback(*(pj.PerAxis((part, part)) for part in parts))
    (found,) = stability_reports(
        {"after": loop}, (3.0, 3.0), DT, ("X", "Y")
    ).axes.values()
    expected = pj.stability_report(around(pid("hard")))
    assert found.report.disk_margin == pytest.approx(expected.disk_margin, rel=1e-6)
    assert found.report.branch == "descending"
    # The slope of the ascending branch is 0.8 SLOPE.
    expected = pj.stability_report(around(pid("hard"), 0.8))
    assert found.other.disk_margin == pytest.approx(expected.disk_margin, rel=1e-6)
    assert found.other.branch == "ascending"


def test_phase_lead_at_both_crossovers():
    """L = -k / A(z) of a mode: the phase margin lies on the side of the lead."""
    radius, angle = 0.99, 0.3
    a = np.array([1.0, -2.0 * radius * np.cos(angle), radius**2])
    k = 1.5 * (1.0 - radius) * 2.0 * np.sin(angle)
    companion = np.array([[-a[1], -a[2]], [1.0, 0.0]])
    loop = LinearLoop(companion, np.array([1.0, 0.0]), np.array([0.0, -k]), DT)
    omega = np.linspace(0.0, np.pi, 2_000_001)
    L = -k / np.polyval(a, np.exp(1j * omega))
    crossovers = np.flatnonzero(np.diff(np.abs(L) > 1.0))
    phases = np.angle(L[crossovers])
    assert len(phases) == 2
    assert phases.min() > 0.2
    report = report_of(loop)
    expected = 180.0 - np.degrees(phases.max())
    assert report.phase_margin_deg == pytest.approx(expected, abs=1e-2)
    samples = ((np.pi + phases) / omega[crossovers]).min()
    assert report.delay_margin_samples == pytest.approx(samples, rel=1e-4)


@pytest.mark.parametrize("damping", [1e-2, 1e-7])
def test_the_grid_is_dense_within_the_width_of_a_resonance(damping):
    place = 0.3137
    pole = np.exp(complex(-damping, place))
    A = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
    loop = LinearLoop(A, np.array([1.0, 0.0]), np.array([0.0, 0.0]), DT)
    distance = np.abs(angle_grid(loop) - place)
    assert (distance < damping).sum() > 20
    assert distance.min() < 1e-9


def test_a_peak_between_two_points_of_the_grid_is_found():
    """Twenty wide maxima, and a narrow one of which the grid shows 64 %."""
    grid = np.linspace(0.0, 1.0, 1001)
    centres, narrow = np.linspace(0.03, 0.97, 20), 0.5004

    def bumps(x):
        wide = 0.4 * np.exp(-(((x[:, None] - centres) / 0.01) ** 2)).sum(axis=1)
        return wide + np.exp(-np.log(2.0) * ((x - narrow) / 0.0005) ** 2)

    value, place = peak(bumps, grid, bumps(grid))
    assert place == pytest.approx(narrow, abs=1e-6)
    assert value == pytest.approx(float(bumps(np.array([narrow]))[0]), rel=1e-6)
