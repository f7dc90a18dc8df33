"""Check of the limit: the optimal linear controller, simulated on the stage.

The disturbance that hysteresis makes depends on the controller: another controller
moves the stage differently and meets another disturbance. The one linear controller
that is best for the disturbance of a loop's runs is therefore simulated on the same
stage, with the same noise. The disturbance of its own runs is measured, the best
controller for that is simulated, and so on. Once this converges, predicted and
simulated error agree as far as the linear model holds. A linear controller has then
reached the limit on a stage with hysteresis, creep and limits of the actuator.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import Scalar, State, as_array
from ...core.feedback import Feedback, LoopSample
from ...core.rollout import simulate
from ...core.system import System
from ..stability.operating_point import loop_sample_time
from .linear_plant import LinearPlant
from .linear_problem import LinearProblem, problem_of
from .loop_runs import simulate_runs
from .performance import SEGMENT
from .wiener import common_response, error_shares, inner_response

_TAIL = 1e-7  # share of the largest tap below which trailing taps are cut off


class LimitInput(NamedTuple):
    """Inputs of a LinearLimit at sample k: three known in advance, two unknown.

    Known: ``voltage`` (V), with which the linear plant follows the reference;
    ``prediction`` (um), the predicted disturbance; ``reference`` (um). Unknown:
    ``noise``, a draw of unit variance; ``disturbance`` (um), which is added to the
    displacement at k + 1.
    """

    voltage: Scalar
    prediction: Scalar
    reference: Scalar
    noise: Scalar
    disturbance: Scalar


class LinearLimit(System):
    """Stage of ``loop`` under the controller u = voltage - Q (measured - predicted).

    ``voltage`` is that of LimitInput. ``taps`` are the impulse response of Q (V/um).
    The predicted displacement is that of the linear ``model`` under u plus the
    predicted disturbance.
    """

    loop: Feedback
    model: LinearPlant
    taps: Float[Array, " taps"] = eqx.field(converter=as_array)

    def init(self, input: Any = 0.0) -> State:
        start = self.loop.init(input)
        resting = self.model.at(start.voltage, start.displacement)
        return start, resting, resting.init(start.voltage), jnp.zeros_like(self.taps)

    def step(self, state: State, input: LimitInput) -> tuple[State, LoopSample]:
        at, model, states, innovations = state
        loop = self.loop
        sensor, measured = loop.sensor.step(at.sensor, (at.displacement, input.noise))
        # at.reference holds the model's displacement of the last step.
        innovation = measured - at.reference - input.prediction
        innovations = jnp.concatenate([innovation[None], innovations[:-1]])
        command = input.voltage - self.taps @ innovations
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
        return (at, model, states, innovations), sample


class LimitErrors(NamedTuple):
    """RMS errors [references] in um, predicted and simulated on the stage.

    Both leave out the mean of a run. It is not part of a spectrum, and even the slowest
    integral action would remove it.
    """

    predicted: np.ndarray
    simulated: np.ndarray


def verify_limit(
    loop: Feedback,
    references: Any,
    noise: Any,
    disturbance: Any = None,
    *,
    start: int = 0,
    segment: float = SEGMENT,
    dt: float | None = None,
    rounds: int = 5,
) -> list[LimitErrors]:
    """Return the errors of the best single linear controller on the stage of ``loop``.

    There is one entry for each of ``rounds``: the first controller is designed for the
    disturbance of the runs of ``loop``, each later one for that of the controller
    before it. Other arguments and errors are those of ``performance_limit``.
    """
    references, noise = as_array(references), as_array(noise)
    dt = loop_sample_time(loop) if dt is None else dt
    known = np.asarray(references)
    runs, rest = simulate_runs(loop, references, noise, disturbance)
    found = []
    for _ in range(rounds):
        problem = problem_of(loop, runs, rest, known, start, segment, dt)
        plant = problem.plant.response(problem.points)
        inner = inner_response(*problem.plant.delay_and_zeros(), problem.points)
        T = common_response(problem.spectra, problem.variance, inner)
        predicted = [
            np.sqrt(sum(error_shares(T, spectrum, problem.variance)))
            for spectrum in problem.spectra
        ]
        taps = np.fft.ifft(T / plant).real[: problem.points // 2]
        taps = taps[: 1 + np.flatnonzero(np.abs(taps) > _TAIL * np.abs(taps).max())[-1]]
        control = LinearLimit(loop, problem.plant, taps)
        prediction = problem.predictor.predicted(problem.residual)
        voltage = (
            _following_voltage(problem, known, prediction)
            + rest.reshape(noise.shape[:2])[:, :1]
        )
        moved = 0.0 if disturbance is None else disturbance
        disturbances = jnp.broadcast_to(moved, noise.shape)
        logs = _logs(control, voltage, prediction, references, noise, disturbances)
        runs = jax.tree.map(lambda x: np.asarray(x).reshape(-1, x.shape[-1]), logs)
        error = problem.predictor.centred(
            np.asarray(logs.displacement - logs.reference)
        )
        reached = np.sqrt(np.mean(error**2, axis=(1, 2)))
        found.append(LimitErrors(np.array(predicted), reached))
    return found


def _following_voltage(
    problem: LinearProblem, references: np.ndarray, prediction: np.ndarray
) -> np.ndarray:
    """Return the voltages [references, samples] that make the linear plant follow.

    They are deviations (V) from the voltages at rest.
    """
    wanted = references - references[:, :1] - prediction
    margin = wanted.shape[1] // 2
    wanted = np.pad(wanted, ((0, 0), (margin, margin)), mode="edge")
    # Without the ramp between its ends the record is periodic. The ramp is so slow that
    # the gain at rest applies to it.
    ramp = np.linspace(wanted[:, 0], wanted[:, -1], wanted.shape[1], axis=1)
    plant = problem.plant.response(wanted.shape[1])
    voltage = np.fft.ifft(np.fft.fft(wanted - ramp) / plant).real
    voltage += ramp / plant[0].real
    return voltage[:, margin : margin + references.shape[1]]


@jax.jit
def _logs(
    control: LinearLimit,
    voltage: Any,
    prediction: Any,
    references: Any,
    noise: Any,
    disturbance: Any,
) -> LoopSample:
    def one(voltage, prediction, reference, noise, disturbance):
        inputs = LimitInput(voltage, prediction, reference, noise, disturbance)
        return simulate(control, inputs, control.init(reference[0]))[1]

    each = jax.vmap(one, in_axes=(None, None, None, 0, 0))
    return jax.vmap(each)(voltage, prediction, references, noise, disturbance)
