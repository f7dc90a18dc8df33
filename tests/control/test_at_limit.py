"""Controllers that limit their own command: the loop says so, and it counts."""

import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.control import E727, NV200, PyRPL, Servo, Stabilizer
from piezojax.core.axes import PerAxis
from piezojax.core.feedback import Feedback, loop_inputs
from piezojax.core.limited import Watched, at_limit
from piezojax.core.metrics import Tracking
from piezojax.core.rollout import simulate
from piezojax.core.system import Affine, resolve
from piezojax.dynamics import FirstOrderLag
from piezojax.engines import metered
from piezojax.hysteresis import PrandtlIshlinskii
from piezojax.hysteresis.inverse import InverseHysteresis

DT = 5e-5
ENDS = {"lower": -20.0, "upper": 130.0}
RANGE = {"avmin": -20.0, "avmax": 130.0, "posmin": 0.0, "posmax": 80.0}
WIRES = {"sensor_gain": 0.1, "amplifier_gain": 15.0, "offset": 55.0}
DEVICES = {
    "nv200": lambda: NV200(ki=400.0, **RANGE),
    "e727": lambda: E727(proportional=0.02, integral_time=2e-4, scale=2.5, **ENDS),
    "servo": lambda: Servo(proportional=0.1, integral=300.0, dt=DT, **ENDS),
    "stabilizer": lambda: Stabilizer(p=0.05, i=300.0, **WIRES),
    "pyrpl": lambda: PyRPL(
        p=0.0, i=-60.0, sensor_gain=0.012, amplifier_gain=75.0, offset=55.0, dt=DT
    ),
}


def loop_of(controller):
    """Return a loop whose actuator limits nothing."""
    plant = pj.series(gain=Affine(0.4), lag=FirstOrderLag(2e-4, DT))
    sensor = pj.series(noise=pj.hardware.Sensor(1e-4))
    return Feedback(controller, plant, Affine(), sensor)


@pytest.mark.parametrize("engine", ["native", "loop"])
@pytest.mark.parametrize("name", DEVICES)
def test_samples_at_the_limits_of_a_device_are_saturated(name, engine):
    loop = resolve(loop_of(DEVICES[name]()))
    reference = jnp.asarray(np.repeat([8.0, 1e4, 8.0, -1e4, 8.0], 400))
    noise = jnp.asarray(np.random.default_rng(2).standard_normal(reference.size))
    inputs, state = loop_inputs(reference, noise), loop.init(8.0)
    voltage = np.asarray(simulate(loop, inputs, state)[1].voltage)
    held = np.isclose(voltage, voltage.max(), rtol=1e-9)
    held |= np.isclose(voltage, voltage.min(), rtol=1e-9)
    assert 0.2 < held.mean() < 0.95
    watched = Watched(loop)
    figures, _ = metered(watched, inputs, state, Tracking(0), engine=engine)
    assert float(figures.saturated) == pytest.approx(held.mean(), abs=1e-12)


def test_a_numerical_inverse_reports_its_limits():
    inverse = InverseHysteresis(
        PrandtlIshlinskii((0.1,), (5.0, 15.0), (0.02, 0.02), 0.0), 0.0, 100.0
    )
    state = inverse.init(3.0)
    for wanted, expected in ((3.0, False), (1e3, True), (-1e3, True)):
        voltage = inverse.step(state, wanted)[1]
        assert bool(at_limit(inverse, voltage)) is expected


def test_only_the_axis_of_the_device_is_at_a_limit():
    pid = pj.control.PID(0.0, 10.0, dt=DT)
    device = resolve(NV200(ki=70.0, **RANGE))
    both = PerAxis((pid, device))
    free, held = at_limit(both, (jnp.asarray(130.0), jnp.asarray(130.0)))
    assert not bool(free)
    assert bool(held)
    assert at_limit(PerAxis((pid, pid)), (jnp.ones(()), jnp.ones(()))) is None
    assert at_limit(pid, jnp.ones(())) is None
