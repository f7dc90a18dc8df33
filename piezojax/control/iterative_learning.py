"""Iterative learning control: feedforward learned from trial to trial."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core.arrays import Scalar, as_array, as_scalars, check
from ..core.feedback import Feedback, loop_inputs
from ..core.metrics import root
from ..core.parameter import check_declared, parameter
from ..core.rollout import simulate
from ..core.system import System

Signal = Float[Array, " samples"]


class Trials(NamedTuple):
    """Outcome of ``learn``.

    ``feedforward`` [samples] of the next trial; ``error`` [samples], r - y of the last
    trial in um; ``rms_error`` [trials] in um.
    """

    feedforward: Signal
    error: Signal
    rms_error: Float[Array, " trials"]


class LearningLaw(eqx.Module):
    """``u_next = Q (u + gain z^lead e)``, with e = r - y of the trial in um.

    The time-domain form of (2.14). Its learning function rho / G is a gain and a
    ``lead`` in samples, which compensates the lag of the system that u drives. ``gain``
    is in the unit of u per um: V/um for a stage, dimensionless for a loop whose
    reference is corrected. Q is a zero-phase FIR filter with unit DC gain:
    ``smoothing`` holds the weights w_1, w_2, ... of the neighbours one, two, ...
    samples away on either side, and the weight of the sample itself is
    1 - 2 (w_1 + w_2 + ...). Without weights Q = 1. Beyond the ends of a trial the end
    values are used.

    Let L = gain z^lead. On a linear system with the matrix G from u to y, the trials
    contract to the fixed point ``(I - Q (I - L G))^-1 Q L r`` if ``Q (I - L G)`` has
    norm below 1. For trials much longer than the transients the condition is
    ``|Q (1 - L G)| < 1`` at all frequencies. The remaining error is zero only at
    frequencies where Q = 1.
    """

    gain: Scalar = parameter(
        "[u]/um", "learning gain, [u] the unit of the feedforward", typical=(0.0, 1.0)
    )
    smoothing: tuple[Scalar, ...] = parameter(
        "1",
        "weights of the neighbours in the Q-filter",
        typical=(0.0, 0.25),
        converter=as_scalars,
        default=(),
    )
    lead: int = parameter(
        "samples",
        "lag of the system that the feedforward drives",
        least=0.0,
        whole=True,
        static=True,
        default=0,
    )

    def __check_init__(self):
        check_declared(self)

    def corrected(
        self, feedforward: Signal, error: Signal, sample: Int[Array, ""]
    ) -> Scalar:
        """Return one ``sample`` of the next feedforward; arguments as in ``next``."""

        def wanted(at: Int[Array, ""]) -> Scalar:
            ahead = jnp.minimum(at + self.lead, error.shape[0] - 1)
            return feedforward[at] + self.gain * error[ahead]

        middle = smooth = wanted(sample)
        for distance, weight in enumerate(self.smoothing, start=1):
            before = jnp.maximum(sample - distance, 0)
            after = jnp.minimum(sample + distance, error.shape[0] - 1)
            smooth = smooth + weight * (wanted(before) + wanted(after) - 2.0 * middle)
        return smooth

    def next(self, feedforward: Signal, error: Signal) -> Signal:
        """Return the next feedforward from that of a trial and its error [samples]."""
        samples = jnp.arange(error.shape[0])
        return jax.vmap(self.corrected, (None, None, 0))(feedforward, error, samples)


def learn(
    law: LearningLaw,
    system: System,
    reference: Signal,
    trials: int,
    noise: Float[Array, "trials samples"] | None = None,
    feedforward: Signal | None = None,
) -> Trials:
    """Repeat ``reference`` (um) on ``system``, learning from trial to trial.

    Each trial starts from the same state at rest. ``system`` is a stage, V to um, whose
    input u is learned (y(k) is the output of the step with u(k)), or a Feedback loop,
    whose reference is corrected to r + u. ``noise`` [trials, samples] is added to the
    measurement. For a stage it is in um; for a loop it holds draws of unit variance,
    which the sensor scales. ``feedforward`` of the first trial is zero by default, as
    in (2.14). The function is pure, and differentiable in ``law`` and ``system``. The
    returned errors are those of the true displacement.

    Raises ValueError for fewer than one trial or signals of different lengths.
    """
    reference = as_array(reference)
    start = jnp.zeros_like(reference) if feedforward is None else as_array(feedforward)
    check("trials", trials, least=1.0)
    if noise is None:
        noise = jnp.zeros((trials, *reference.shape))
    if start.shape != reference.shape or noise.shape != (trials, *reference.shape):
        raise ValueError(
            f"reference, feedforward and noise have the shapes {reference.shape}, "
            f"{start.shape} and {noise.shape}; they must be (samples,), (samples,) and "
            f"({trials}, samples)"
        )
    run = _loop_trial if isinstance(system, Feedback) else _stage_trial

    def trial(feedforward, draws):
        displacement, measured = run(system, reference, feedforward, draws)
        error = reference - displacement
        following = law.next(feedforward, reference - measured)
        return following, (error, jnp.mean(error**2))

    # The errors of all trials but the last are dropped, so only one is carried.
    def step(carry, draws):
        following, (error, square) = trial(carry[0], draws)
        return (following, error), square

    carry = (start, jnp.zeros_like(reference))
    (following, error), squares = jax.lax.scan(step, carry, noise)
    return Trials(following, error, root(squares))


Trial = Callable[[System, Signal, Signal, Signal], tuple[Signal, Signal]]


def _stage_trial(
    system: System, reference: Signal, feedforward: Signal, noise: Signal
) -> tuple[Signal, Signal]:
    del reference
    outputs = simulate(system, feedforward, system.init(feedforward[0]))[1]
    return outputs, outputs + noise


def _loop_trial(
    system: System, reference: Signal, feedforward: Signal, noise: Signal
) -> tuple[Signal, Signal]:
    # The loop starts at rest at r, so a correction of the first sample acts as a step.
    inputs = loop_inputs(reference + feedforward, noise)
    samples = simulate(system, inputs, system.init(reference[0]))[1]
    return samples.displacement, samples.measured
