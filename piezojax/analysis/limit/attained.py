"""The controller of the limit itself, run on the stage: is the limit one?

A disturbance that comes from hysteresis is not given: another controller moves the
stage otherwise and meets another. So the best one linear controller for what a loop's
runs left over is run on the same stage, with the same noise; what it leaves over itself
is measured, a controller is made for that, and so on. Where this settles, predicted and
simulated error agree as far as the linear picture holds, and the limit is a figure that
a linear controller has reached, with hysteresis, creep and the actuator's limits.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import Scalar, State, as_array
from ...core.rollout import simulate
from ...core.system import Feedback, LoopSample, System
from ..stability.operating_point import loop_sample_time
from .linear_plant import LinearPlant
from .linear_problem import Problem, problem_of
from .loop_runs import simulated
from .performance import SEGMENT
from .wiener import common_response, error_shares, inner_response

_TAIL = 1e-7  # of the largest tap: where the controller's memory ends


class Ahead(NamedTuple):
    """What the controller knows beforehand of sample k, and what it does not.

    ``voltage`` (V) makes the linear plant follow; ``foretold`` (um) is what the
    disturbance should be, ``reference`` in um; ``noise`` a draw of unit variance,
    ``disturbance`` (um) moves the displacement at k + 1.
    """

    voltage: Scalar
    foretold: Scalar
    reference: Scalar
    noise: Scalar
    disturbance: Scalar


class LinearLimit(System):
    """The stage of ``loop`` under u = voltage ahead - Q (measured - foreseen).

    ``taps`` are the impulse response of Q (V/um); what is foreseen is the linear
    ``model`` under u and the foretold disturbance.
    """

    loop: Feedback
    model: LinearPlant
    taps: Float[Array, " taps"] = eqx.field(converter=as_array)

    def init(self, input: Any = 0.0) -> State:
        start = self.loop.init(input)
        resting = self.model.at(start.voltage, start.displacement)
        return start, resting, resting.init(start.voltage), jnp.zeros_like(self.taps)

    def step(self, state: State, input: Ahead) -> tuple[State, LoopSample]:
        at, model, states, surprises = state
        loop = self.loop
        sensor, measured = loop.sensor.step(at.sensor, (at.displacement, input.noise))
        # What the model does now it was told one sample ago.
        surprise = measured - at.reference - input.foretold
        surprises = jnp.concatenate([surprise[None], surprises[:-1]])
        command = input.voltage - self.taps @ surprises
        actuator, voltage = loop.actuator.step(at.actuator, command)
        plant, displacement = loop.plant.step(at.plant, voltage)
        states, modelled = model.step(states, voltage)
        sample = LoopSample(
            input.reference, at.displacement, measured, command, voltage
        )
        at = at._replace(
            actuator=actuator,
            plant=plant,
            sensor=sensor,
            displacement=displacement + input.disturbance,
            reference=modelled,
            voltage=voltage,
        )
        return (at, model, states, surprises), sample


class Attained(NamedTuple):
    """RMS errors [references] in um: what was predicted, and what the stage did.

    Both without the mean of a run, which no spectrum holds and the slowest integral
    would take away.
    """

    predicted: np.ndarray
    simulated: np.ndarray


def attained(
    loop: Feedback,
    references: Any,
    noise: Any,
    disturbance: Any = None,
    *,
    start: int = 0,
    segment: float = SEGMENT,
    dt: float | None = None,
    rounds: int = 5,
) -> list[Attained]:
    """Return what the best one linear controller reaches on the stage of ``loop``.

    One entry a round: the first controller is made for what the runs of ``loop`` left
    over, each later one for what the one before did. Arguments as for
    ``performance_limit``, and what is raised.
    """
    references, noise = as_array(references), as_array(noise)
    dt = loop_sample_time(loop) if dt is None else dt
    known = np.asarray(references)
    runs, rest = simulated(loop, references, noise, disturbance)
    found = []
    for _ in range(rounds):
        posed = problem_of(loop, runs, rest, known, start, segment, dt)
        plant = posed.plant.response(posed.points)
        inner = inner_response(*posed.plant.obstacles(), posed.points)
        T = common_response(posed.spectra, posed.variance, inner)
        predicted = [
            np.sqrt(sum(error_shares(T, spectrum, posed.variance)))
            for spectrum in posed.spectra
        ]
        taps = np.fft.ifft(T / plant).real[: posed.points // 2]
        taps = taps[: 1 + np.flatnonzero(np.abs(taps) > _TAIL * np.abs(taps).max())[-1]]
        control = LinearLimit(loop, posed.plant, taps)
        foretold = posed.known.foretold(posed.left)
        voltage = _ahead(posed, known, foretold) + rest.reshape(noise.shape[:2])[:, :1]
        moved = 0.0 if disturbance is None else disturbance
        still = jnp.broadcast_to(moved, noise.shape)
        logs = _logs(control, voltage, foretold, references, noise, still)
        runs = jax.tree.map(lambda x: np.asarray(x).reshape(-1, x.shape[-1]), logs)
        error = posed.known.cut(np.asarray(logs.displacement - logs.reference))
        reached = np.sqrt(np.mean(error**2, axis=(1, 2)))
        found.append(Attained(np.array(predicted), reached))
    return found


def _ahead(posed: Problem, references: np.ndarray, foretold: np.ndarray) -> np.ndarray:
    """Return the voltages [references, samples] over those at rest that follow."""
    wanted = references - references[:, :1] - foretold
    margin = wanted.shape[1] // 2
    wanted = np.pad(wanted, ((0, 0), (margin, margin)), mode="edge")
    # Less a ramp from end to end the record is periodic, for a ramp is slow enough.
    ramp = np.linspace(wanted[:, 0], wanted[:, -1], wanted.shape[1], axis=1)
    plant = posed.plant.response(wanted.shape[1])
    voltage = np.fft.ifft(np.fft.fft(wanted - ramp) / plant).real
    voltage += ramp / plant[0].real
    return voltage[:, margin : margin + references.shape[1]]


@jax.jit
def _logs(
    control: LinearLimit,
    voltage: Any,
    foretold: Any,
    references: Any,
    noise: Any,
    disturbance: Any,
) -> LoopSample:
    def one(voltage, foretold, reference, noise, disturbance):
        inputs = Ahead(voltage, foretold, reference, noise, disturbance)
        return simulate(control, inputs, control.init(reference[0]))[1]

    each = jax.vmap(one, in_axes=(None, None, None, 0, 0))
    return jax.vmap(each)(voltage, foretold, references, noise, disturbance)
