"""Linearisation: hysteresis at rest, the cut, derivatives, and refused input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import published

import piezojax as pj
from piezojax.analysis.stability import (
    OperatingPoint,
    broken_loop,
    closed_loop_poles,
    open_loop,
    stability_reports,
)
from piezojax.catalog import p753
from piezojax.core.feedback import LoopInput
from piezojax.dynamics import linearise
from piezojax.report.bode import write_stability

a, b, c = published.HYSTERESIS
SIDES = {"ascending": 1.0, "descending": -1.0}


def pid():
    return pj.control.PID(0.5, 3000.0, 1e-4, 1e-4, 50.0, dt=5e-5)


def loop_of(plant, controller=None):
    limits = pj.hardware.Saturation(-20.0, 120.0)
    return pj.Feedback(controller or pid(), plant, limits, pj.hardware.Sensor(0.0))


def linear(slope):
    dynamics = pj.dynamics.ARMA(published.T2_P, published.T2_G)
    return pj.series(slope=pj.core.system.Affine(slope), dynamics=dynamics)


def test_linearising_a_linear_system_returns_its_matrices():
    rng = np.random.default_rng(3)
    A, B, C, D = (rng.normal(size=s) for s in ((3, 3), (3, 2), (2, 3), (2, 2)))
    system = pj.dynamics.StateSpace(A, B, C, D, 1e-3)
    found = linearise(system, jnp.ones(2))
    for name in "ABCD":
        np.testing.assert_allclose(getattr(found, name), getattr(system, name))
    assert found.dt == 1e-3


def test_derivatives_of_a_nonlinear_system_equal_finite_differences():
    oscillator = pj.hysteresis.HystereticOscillator(
        2.0, 10.0, 5e4, pj.hysteresis.BoucWen(5e4, 1e3, 0.8e3), 1.0 / 750.0
    )
    state, _ = pj.simulate(oscillator, 100.0 * jnp.sin(jnp.arange(50) * 0.3))
    found = linearise(oscillator, 40.0, state)
    gradient = []
    for i, value in enumerate(state):
        h = 1e-6 * (abs(float(value)) + 1e-4)
        up, down = (
            oscillator.step(state._replace(**{state._fields[i]: value + s}), 40.0)[0]
            for s in (h, -h)
        )
        gradient.append(
            [(float(u) - float(d)) / (2.0 * h) for u, d in zip(up, down, strict=True)]
        )
    np.testing.assert_allclose(found.A, np.transpose(gradient), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("branch", list(SIDES))
def test_hysteresis_is_linearised_to_the_slope_of_its_branch(branch):
    """The slope is b + s (a x + c y) on the virgin curve; the memory adds no pole."""
    report = pj.stability_report(p753.loop(pid()), OperatingPoint(5.0, branch))
    x = report.voltage_V
    p = -a / c
    y = p * x + (p - b) / c * (1.0 - np.exp(c * x))
    assert y == pytest.approx(5.0, abs=1e-9)
    slope = b + SIDES[branch] * (a * x + c * y)
    twin = pj.stability_report(loop_of(linear(slope)), 5.0)
    assert report.conserved == 1
    assert twin.conserved == 0
    for name in ("gain_margin_dB", "phase_margin_deg", "sensitivity_peak"):
        assert getattr(report, name) == pytest.approx(getattr(twin, name), rel=1e-6)
    poles = [np.sort_complex(np.array(r.poles)) for r in (report, twin)]
    poles = [p[np.abs(p) > 0.1] for p in poles]
    np.testing.assert_allclose(poles[0], poles[1], atol=1e-6)


def test_an_inverse_hysteresis_has_the_branch_of_the_plant():
    """If the model equals the plant, both slopes cancel on either branch."""
    loop = p753.loop(p753.inversion())
    reports = [
        pj.stability_report(loop, OperatingPoint(reference, branch))
        for reference in (0.0, 4.0)
        for branch in SIDES
    ]
    assert all(report.conserved == 2 for report in reports)
    peaks = [report.sensitivity_peak for report in reports]
    np.testing.assert_allclose(peaks, peaks[0], rtol=1e-7)


def test_plays_move_on_the_ascending_branch_only():
    plant = pj.hysteresis.PrandtlIshlinskii((0.1,), (2.0, 5.0), (0.02, 0.03))
    loop = loop_of(plant >> pj.dynamics.ARMA(published.T2_P, published.T2_G))
    for branch, slope in (("ascending", 0.15), ("descending", 0.1)):
        twin = pj.stability_report(loop_of(linear(slope)), 3.0)
        report = pj.stability_report(loop, OperatingPoint(3.0, branch))
        assert report.sensitivity_peak == pytest.approx(twin.sensitivity_peak, rel=1e-6)


def test_closing_the_cut_loop_gives_the_closed_loop():
    loop = p753.loop(p753.disturbance_observer(), 0.0)
    samples = 200
    kick = jnp.zeros(samples).at[0].set(0.01)
    inputs = LoopInput(jnp.full(samples, 4.0), jnp.zeros(samples), kick)
    _, log = pj.simulate(loop, inputs, loop.init(4.0))

    broken = broken_loop(loop, 4.0)
    broken = eqx.tree_at(
        lambda x: (x.voltage_push, x.reference_push), broken, (0.0, 0.0)
    )
    state, seen = broken.init(), []
    voltage = state.applied
    step = jax.jit(lambda state, voltage: broken.step(state, voltage))
    for k in range(samples):
        seen.append(float(state.displacement))
        # The command of sample k moves the plant at k, for any injected voltage.
        voltage = -step(state, 0.0)[1]
        state, _ = step(state, voltage)
        if k == 0:
            state = state._replace(displacement=state.displacement + 0.01)
    np.testing.assert_allclose(seen, log.displacement, atol=1e-9)


def test_the_injected_voltage_is_hidden_from_the_observer():
    """The controller stores its own voltage: only the state of the plant is moved."""
    loop = p753.loop(p753.disturbance_observer(), 0.0)
    broken = broken_loop(loop, 4.0)
    still, moved = (broken.step(broken.init(), 30.0 + dv)[0] for dv in (0.0, 1.0))
    assert float(moved.displacement) != float(still.displacement)
    same = ("controller", "actuator", "sensor", "applied")
    for name in same:
        pair = (jax.tree.leaves(getattr(x, name)) for x in (still, moved))
        assert all(float(x) == float(y) for x, y in zip(*pair, strict=True))


def test_limits_and_converters_are_not_linearised():
    plain = pj.stability_report(loop_of(linear(0.15)), 0.0)
    parts = (
        pj.hardware.Saturation(0.0, 100.0),
        pj.hardware.SlewLimit(1e5, 5e-5),
        pj.hardware.Quantiser(1e-3),
    )
    hard = pj.Feedback(
        pid(), linear(0.15), parts[0] >> parts[1] >> parts[2], pj.hardware.Sensor(0.0)
    )
    report = pj.stability_report(hard, 0.0)  # on the lower limit itself
    assert report.sensitivity_peak == pytest.approx(plain.sensitivity_peak, rel=1e-9)


def test_an_operating_point_from_a_run():
    loop = p753.loop(pid(), 0.0)
    time = jnp.arange(4_000) * 5e-5
    reference = 5.0 + 3.0 * jnp.sin(2.0 * jnp.pi * 10.0 * time)
    inputs = pj.loop_inputs(reference)
    state, _ = pj.simulate(loop, inputs, loop.init(5.0))
    report = pj.stability_report(loop, OperatingPoint(reference[-1], state=state))
    memory = state.plant[0]
    slope = b + a * float(memory.input) + c * float(memory.output)
    twin = pj.stability_report(loop_of(linear(slope)), 5.0)
    assert report.sensitivity_peak == pytest.approx(twin.sensitivity_peak, rel=1e-5)


def test_poles_are_differentiable():
    loop = loop_of(linear(0.15))
    report = pj.stability_report(loop, 2.0)

    def with_gain(integral):
        return eqx.tree_at(lambda x: x.controller.integral, loop, integral)

    def largest(integral):
        return jnp.max(jnp.abs(closed_loop_poles(with_gain(integral), 2.0)))

    gain = jnp.asarray(3000.0)
    value, slope = jax.jit(jax.value_and_grad(largest))(gain)
    assert float(value) == pytest.approx(abs(report.poles[0]), rel=1e-9)
    compiled = jax.jit(largest)
    difference = (compiled(gain + 0.1) - compiled(gain - 0.1)) / 0.2
    assert float(slope) == pytest.approx(float(difference), rel=1e-4)


def test_jit_equals_eager():
    plant = linear(0.15)
    compiled = jax.jit(lambda plant, u: linearise(plant, u, dt=5e-5))(plant, 3.0)
    eager = linearise(plant, 3.0, dt=5e-5)
    for name in "ABCD":
        np.testing.assert_allclose(
            getattr(eager, name), getattr(compiled, name), rtol=1e-13
        )


def test_the_response_equals_that_of_the_report():
    loop = loop_of(linear(0.15))
    report = pj.stability_report(loop, 2.0)
    hertz = jnp.array([report.phase_crossover_Hz])
    response = jax.jit(lambda loop: open_loop(loop, 2.0).frequency_response(hertz))(
        loop
    )
    assert complex(response[0, 0, 0]) == pytest.approx(
        -1.0 / report.gain_margin, rel=1e-6
    )


def test_bad_operating_points_are_refused():
    loop = loop_of(linear(0.15))
    with pytest.raises(ValueError, match=r"cannot rest at 40 um.*rests at 18 um"):
        pj.stability_report(loop, 40.0)
    with pytest.raises(ValueError, match="branch 'up'; it must be one of"):
        OperatingPoint(branch="up")
    with pytest.raises(ValueError, match=r"Affine are none; give dt"):
        linearise(pj.core.system.Affine(2.0))
    two = pj.dynamics.FirstOrderLag(1.0, 1e-3) >> pj.dynamics.FirstOrderLag(1.0, 2e-3)
    with pytest.raises(ValueError, match=r"are 0\.001 s, 0\.002 s; give dt"):
        linearise(two)
    assert linearise(two, dt=1e-3).A.shape == (2, 2)


def test_a_comparison_names_the_reason_without_margins(tmp_path):
    loop = loop_of(linear(0.15))
    found = stability_reports({"before": loop_of(linear(0.1)), "after": loop}, 15.0)
    assert "cannot rest at 15 um" in found.problems["before"]
    assert set(found.as_dict()["after"]) == set(SIDES)
    write_stability(found, tmp_path)
    assert (tmp_path / "stability.png").read_bytes().startswith(b"\x89PNG")


def test_a_picture_of_an_unstable_loop(tmp_path):
    wild = eqx.tree_at(lambda x: x.controller.proportional, loop_of(linear(0.15)), 1e3)
    found = stability_reports({"before": wild})
    assert not found.reports["before"]["ascending"].stable
    write_stability(found, tmp_path)
    assert (tmp_path / "stability.png").read_bytes().startswith(b"\x89PNG")
