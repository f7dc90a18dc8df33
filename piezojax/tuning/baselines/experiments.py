"""Experiments that find the ultimate gain and period of a stage in its loop."""

from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...control import PID
from ...core.arrays import Scalar, as_array, check
from ...core.feedback import Feedback, Observation, loop_inputs
from ...core.rollout import simulate
from ...core.system import System
from ...solve.clock import Clock
from .rules import Ultimate

GAINS = 64
"""Number of proportional gains simulated at once."""

NARROWINGS = 3
"""Number of refinements of the interval between the last gain whose oscillation decays
and the first whose oscillation does not."""

STEP = 0.02
"""Step of the ultimate-gain experiment, as a share of the references' amplitude."""

RELAY = 0.1
"""Height of the relay, as a share of the voltage span."""

SIGMAS = 3.0
"""Hysteresis of the relay, in standard deviations of the sensor's noise."""

_DECADES = (-6.0, 1.0)  # powers of ten of the gains over (voltage span / step)
_WILD = 10.0  # times the step: a larger displacement has left the linear range
_CALM = 0.05  # times the step: a smaller oscillation has settled
_FEWEST = 3.0  # periods of an oscillation


class RelayState(NamedTuple):
    """State of a relay: its ``side``, +1 or -1, and its ``centre`` voltage, V."""

    side: Scalar
    centre: Scalar


class Relay(System):
    """Relay ``u = centre + height * sign(error)``, um to V.

    It switches when the error exceeds ``hysteresis`` (um) with the opposite sign, so
    that noise does not switch it. The centre is the voltage at rest. Source: Astrom and
    Hagglund (1984). Raises ValueError unless ``height`` (V) is positive and
    ``hysteresis`` is not negative.
    """

    height: Scalar = eqx.field(converter=as_array)
    hysteresis: Scalar = eqx.field(converter=as_array, default=0.0)

    def __check_init__(self):
        check("height of the relay in V", self.height, above=0.0)
        check("hysteresis of the relay in um", self.hysteresis, least=0.0)

    def init(self, input: Observation) -> RelayState:
        centre = as_array(input.applied)
        return RelayState(jnp.ones_like(centre), centre)

    def step(self, state: RelayState, input: Observation) -> tuple[RelayState, Scalar]:
        error = input.reference - input.measured
        switched = jnp.where(error < 0.0, -1.0, 1.0)
        side = jnp.where(jnp.abs(error) > self.hysteresis, switched, state.side)
        command = state.centre + self.height * side
        return RelayState(side, state.centre), command


def ultimate_by_gain(
    loop: Feedback, *, step: float, span: float, dt: float, samples: int, clock: Clock
) -> Ultimate:
    """Return the ultimate gain and period by increasing a proportional gain.

    ``loop`` has a P controller and no noise, and follows a step of ``step`` um from
    rest at 0. The ultimate gain is the lowest one whose oscillation does not decay from
    the second to the last quarter of ``samples``. The gains tried range from 1e-6 to 10
    times ``span`` (V) over ``step``. Raises ValueError if the oscillation decays at
    every gain, or does not decay at the lowest.
    """
    reference = jnp.full(samples, step).at[0].set(0.0)

    def displacement(loop, gain):
        controller = PID(gain, 0.0, 0.0, 0.0, 0.0, dt=dt)
        around = Feedback(controller, loop.plant, loop.actuator, loop.sensor)
        log = simulate(around, loop_inputs(reference), around.init(reference[0]))[1]
        return log.displacement

    def swings(loop, gains):
        runs = jax.vmap(lambda gain: displacement(loop, gain))(gains)
        return jax.vmap(lambda run: _oscillates(run, step))(runs)

    low, high = (10.0**decade * span / step for decade in _DECADES)
    gains = np.geomspace(low, high, GAINS)
    program = clock.compiled(jax.jit(swings), loop, as_array(gains))
    for _ in range(1 + NARROWINGS):
        wild = np.asarray(program(loop, as_array(gains)))
        first = int(np.argmax(wild))
        if wild[0] or not wild.any():
            raise ValueError(
                "no ultimate gain: a proportional loop oscillates at "
                f"{'all' if wild[0] else 'none'} of the gains from {gains[0]:.3g} to "
                f"{gains[-1]:.3g} V/um"
            )
        low, high = gains[first - 1], gains[first]
        gains = np.geomspace(low, high, GAINS)
    run = clock.compiled(jax.jit(displacement), loop, as_array(high))
    last = np.asarray(run(loop, as_array(high)))[samples // 4 :]
    return Ultimate(float(high), period_of(np.diff(last), dt))


def _oscillates(run: Float[jax.Array, " samples"], step: float) -> jax.Array:
    """Return whether the oscillation of a step response does not decay."""
    quarter = run.shape[0] // 4
    early = jnp.std(run[quarter : 2 * quarter])
    late = jnp.std(run[3 * quarter :])
    far = jnp.max(jnp.abs(run)) > _WILD * abs(step)
    growing = (late >= early) & (late > _CALM * abs(step))
    return far | growing | ~jnp.all(jnp.isfinite(run))


def ultimate_by_relay(
    loop: Feedback,
    *,
    height: float,
    hysteresis: float,
    dt: float,
    noise: Float[np.ndarray, " samples"],
    clock: Clock,
) -> Ultimate:
    """Return the ultimate gain and period by a relay in place of the controller.

    The run has the loop's own sensor and its noise, and starts from rest at the
    reference 0. By the describing function of the relay the gain is 4 h / (pi a). Here
    h is the ``height`` (V), and a (um) the amplitude, at the cycle's frequency, of the
    measurement in the second half of the run. ``hysteresis`` (um) is that of the relay,
    ``noise`` [samples] a draw of unit variance. Raises ValueError if there is no cycle.
    """

    def run(loop, relay, noise):
        around = Feedback(relay, loop.plant, loop.actuator, loop.sensor)
        reference = jnp.zeros_like(noise)
        log = simulate(around, loop_inputs(reference, noise), around.init(0.0))[1]
        return log.measured, log.voltage

    drawn = as_array(noise)
    relay = Relay(height, hysteresis)
    program = clock.compiled(jax.jit(run), loop, relay, drawn)
    measured, voltage = (np.asarray(x) for x in program(loop, relay, drawn))
    half = noise.size // 2
    amplitude, period = cycle_of(measured[half:], voltage[half:], dt)
    return Ultimate(4.0 * height / (np.pi * amplitude), period)


def cycle_of(
    wave: Float[np.ndarray, " samples"],
    switched: Float[np.ndarray, " samples"],
    dt: float,
) -> tuple[float, float]:
    """Return the amplitude of the fundamental and the period (s) of a relay's cycle.

    ``switched`` is the output of the relay, ``wave`` the response to it. Because noise
    moves the instants of switching, the fundamental is computed for each period, from
    rise to rise, and averaged. Raises ValueError for fewer than three periods.
    """
    middle = 0.5 * (switched.max() + switched.min())
    period = period_of(switched - middle, dt)
    above = switched >= middle
    rises = np.flatnonzero(~above[:-1] & above[1:]) + 1
    sums = []
    for start, stop in pairwise(rises):
        turns = np.arange(stop - start) / (stop - start)
        sums.append(2.0 * np.mean(wave[start:stop] * np.exp(-2j * np.pi * turns)))
    return float(np.abs(np.mean(sums))), period


def period_of(wave: Float[np.ndarray, " samples"], dt: float) -> float:
    """Return the mean period (s) of ``wave`` from its upward zero crossings.

    Crossings are interpolated between samples. Raises ValueError for fewer than three
    periods.
    """
    rises = np.flatnonzero((wave[:-1] < 0.0) & (wave[1:] >= 0.0))
    if rises.size < _FEWEST + 1 or not np.all(np.isfinite(wave)):
        raise ValueError(
            f"no oscillation: {max(rises.size - 1, 0)} periods in {wave.size} samples; "
            f"at least {_FEWEST:g} are needed"
        )
    places = rises + wave[rises] / (wave[rises] - wave[rises + 1])
    return float((places[-1] - places[0]) / (rises.size - 1) * dt)
