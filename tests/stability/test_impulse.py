"""Margins from an impulse response, against the exact report, and their slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.analysis.stability import sensitivity, stability_report
from piezojax.analysis.stability.impulse import (
    UNREACHED,
    delay_margin_of,
    disk_margin_of,
    peak_of,
)
from piezojax.catalog import p753, p753_stage
from piezojax.core.paths import replace

INTEGRAL = "controller.integral"


def pid_loop(integral=3000.0):
    return p753.loop(pj.control.PID(0.5, integral, 0.0, 1e-4, 100.0, dt=p753.DT))


LOOPS = {
    "PID": pid_loop,
    "PID-SMC": lambda: p753.loop(p753.sliding_mode()),
    "observer": lambda: replace(
        p753.loop(p753.disturbance_observer()), {"controller.feedback.integral": 10.0}
    ),
    "stage with a mode": lambda: pj.Feedback(
        pj.control.PID(0.3, 1500.0, dt=p753.DT),
        p753_stage.stage(delay=0.4),
        p753.actuator(),
        pj.hardware.Sensor(0.0),
    ),
}


@pytest.mark.parametrize("branch", ["ascending", "descending"])
@pytest.mark.parametrize("name", LOOPS)
def test_figures_are_those_of_the_exact_report(name, branch):
    loop = LOOPS[name]()
    exact = stability_report(loop, 5.0, branch)
    found = jax.jit(lambda loop: sensitivity(loop, 5.0, branch))(loop)
    # A peak between two lines, 5 Hz apart, is missed by little.
    assert peak_of(found) == pytest.approx(exact.sensitivity_peak, rel=5e-3)
    assert disk_margin_of(found) == pytest.approx(exact.disk_margin, rel=5e-3)
    assert delay_margin_of(found) == pytest.approx(exact.delay_margin_samples, rel=5e-3)


def test_a_loop_that_is_never_as_strong_as_1_has_no_delay_margin():
    weak = pj.control.PID(0.01, 0.0, dt=p753.DT)
    loop = pj.Feedback(weak, p753.plant(), p753.actuator(), pj.Sensor(0.0))
    found = sensitivity(loop, 0.0)
    assert delay_margin_of(found) == UNREACHED


def test_slopes_are_those_of_differences():
    @jax.jit
    def figures(integral):
        found = sensitivity(replace(pid_loop(), {INTEGRAL: integral}), 5.0)
        return jnp.stack([f(found) for f in (peak_of, disk_margin_of, delay_margin_of)])

    at, step = 2000.0, 1e-2
    difference = (figures(at + step) - figures(at - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(figures))(at), difference, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.jacrev(figures))(at), difference, rtol=1e-5)


def test_an_unstable_loop_is_a_barrier_with_a_slope():
    def peak(integral):
        return jnp.log(peak_of(sensitivity(pid_loop(integral), 5.0)))

    assert stability_report(pid_loop(3e5), 5.0).stable is False
    value, slope = jax.jit(jax.value_and_grad(peak))(jnp.asarray(3e5))
    assert value > 5.0
    assert np.isfinite(slope)
    assert slope > 0.0


def test_an_unknown_branch_is_refused():
    with pytest.raises(ValueError, match=r"branch 'up'; it must be one of"):
        sensitivity(pid_loop(), 0.0, "up")
