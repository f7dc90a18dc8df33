"""The 3-DOF stage on four actuators in closed loop, with and without a locked one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    loop_inputs,
    simulate,
)
from piezojax.catalog import p558, p558_actuators, p558_control
from piezojax.core.axes import (
    Packed,
    PerAxis,
    packed,
)
from piezojax.core.feedback import holding_input
from piezojax.core.system import rest_output, series
from piezojax.dynamics import ARMA, LinearMap
from piezojax.hysteresis import PrandtlIshlinskii
from piezojax.signals import motions
from piezojax.signals import waveforms as signals

SAMPLES, SETTLE = 400, 150
STUCK = 20.0  # um, of the actuator that is locked
REFERENCE = motions.motion(
    "Z:SIN2 Rx+Ry:CIRCLE4",
    signals.time_grid(SAMPLES * p558.DT, 1.0 / p558.DT),
    p558.OUTPUTS,
    (5.0, 40.0, 40.0),
    (20.0, -40.0, -40.0),
)
CONTROLLER, PIDS = p558_control.multi_axis(), p558_control.pid()


def actuator(gain, play):
    """Return an actuator: a play of 1 um, then the dynamics of (8.40)."""
    a, b = p558_control.ARX[0]
    loop = PrandtlIshlinskii((gain * (1.0 - play),), (1.0,), (gain * play,))
    return series(hysteresis=loop, dynamics=ARMA(a, (*b, 0.0)))


ALIKE = (actuator(1.0, 0.0),) * 4
EACH_ITS_OWN = tuple(
    actuator(*own) for own in ((1.0, 0.02), (1.02, 0.01), (0.98, 0.03), (1.01, 0.02))
)


def allocation(locked, method="bounded"):
    whole = p558_actuators.allocation(method)
    return whole.locked(0, STUCK) if locked else whole


@eqx.filter_jit
def run(plant):
    loop = p558_control.loop(CONTROLLER, (0.0, 0.0, 0.0), plant)
    return packed(simulate(loop, loop_inputs(REFERENCE), loop.init(REFERENCE[0]))[1])


def rms(log):
    error = np.asarray(log.displacement - log.reference)[SETTLE:]
    return np.sqrt(np.mean(error**2, axis=0))


@pytest.mark.parametrize("locked", [False, True])
def test_equal_actuators_give_three_uncoupled_axes(locked):
    # Geometry and dynamics commute: each axis has the response of one actuator.
    found = run(p558_actuators.axes_stage(ALIKE, allocation(locked)))
    expected = run(PerAxis(tuple(part.parts[1] for part in ALIKE[:3])))
    for name in ("displacement", "command"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=0.0, atol=1e-9
        )


def test_four_actuators_and_any_three_follow_the_reference():
    logs = [
        run(p558_actuators.axes_stage(EACH_ITS_OWN, allocation(locked)))
        for locked in (False, True)
    ]
    with_all, with_three = map(rms, logs)
    # The error is that of the controller of chapter 7 on its own stage; see Table 7-4.
    assert np.all(with_all < [1.0, 4.0, 4.0])
    np.testing.assert_allclose(with_three, with_all, rtol=0.15)
    commands = [
        np.array([allocation(locked).allocate(pose).commands for pose in log[::20]])
        for locked, log in zip(
            (False, True), (log.command for log in logs), strict=True
        )
    ]
    assert np.ptp(commands[0][:, 0]) > 5.0
    np.testing.assert_array_equal(commands[1][:, 0], STUCK)
    for each in commands:
        assert np.all((each >= 0.0) & (each <= 50.0))


@pytest.mark.parametrize("locked", [False, True])
def test_a_loop_starts_at_rest_on_its_pose(locked):
    pose = (20.0, -40.0, 30.0)
    plant = p558_actuators.axes_stage(EACH_ITS_OWN, allocation(locked))
    wanted = tuple(map(jnp.asarray, pose))
    command = jax.jit(lambda wanted: holding_input(plant, wanted))(wanted)
    np.testing.assert_allclose(rest_output(plant, command), pose, atol=1e-9)


def test_the_catalogued_stage_has_the_geometry_of_its_actuators():
    time = np.arange(300)[:, None] / 100.0
    poses = (1.0 - np.cos(np.pi * time)) * [15.0, 40.0, -30.0]

    @jax.jit
    def moved(stage, poses):
        return packed(simulate(stage, tuple(poses.T), stage.init(tuple(poses[0])))[1])

    found = moved(p558_actuators.four_actuators(), jnp.asarray(poses))
    (a, b), *_ = p558_control.ARX
    scale = (1.0 - sum(a)) / sum(b)
    play, force, y = np.zeros(4), np.zeros((2, 4)), np.zeros((2, 4))
    expected = []
    for pose in poses:
        q = p558_actuators.elongations() @ pose  # no twist, within the travel
        assert np.all((q >= 0.0) & (q <= 50.0))
        play = np.clip(play, q - 4.0, q + 4.0)
        new = p558_actuators.GAINS * (0.98 * q + 0.02 * play)
        moved_by = a[0] * y[0] + a[1] * y[1]
        y = [moved_by + scale * (b[0] * new + b[1] * force[0]), y[0]]
        force = [new, force[0]]
        expected.append(p558_actuators.geometry() @ y[0])
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    assert np.ptp(found, axis=0).min() > 20.0


def test_gradient_in_closed_loop_is_finite_differences():
    plant = p558_actuators.axes_stage(EACH_ITS_OWN, allocation(True))
    few = REFERENCE[:60]

    @jax.jit
    def cost(proportional):
        gains = eqx.tree_at(lambda c: c.parts[0].proportional, PIDS, proportional)
        loop = p558_control.loop(gains, (0.0, 0.0, 0.0), plant)
        log = simulate(loop, loop_inputs(few), loop.init(few[0]))[1]
        return jnp.mean((packed(log.displacement) - few) ** 2)

    at, h = jnp.asarray(1.5), 1e-4
    slope = jax.grad(cost)(at)
    difference = (cost(at + h) - cost(at - h)) / (2.0 * h)
    assert abs(difference) > 1e-3
    np.testing.assert_allclose(slope, difference, rtol=1e-5)


def test_a_packed_system_equals_the_system():
    matrix = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    _, found = Packed(LinearMap(matrix)).step((), (jnp.asarray(1.0), jnp.asarray(-2.0)))
    assert isinstance(found, tuple)
    np.testing.assert_allclose(found, matrix @ [1.0, -2.0], rtol=1e-15)


def test_another_number_of_actuators_is_refused():
    with pytest.raises(ValueError, match="3 actuators; there must be 4"):
        p558_actuators.axes_stage(ALIKE[:3])
