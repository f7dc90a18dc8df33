"""Iterative learning inside a run: each period of the reference is a trial."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core.arrays import Scalar, State, as_array, as_scalars
from ..core.feedback import Observation
from ..core.parameter import parameter
from ..core.system import System
from .iterative_learning import LearningLaw


class LearningState(NamedTuple):
    """State of the feedback, corrections and errors of two trials, and two indices.

    ``corrections`` and ``errors`` [2, period] in um; ``trial`` is the row of the trial
    under way, ``index`` the sample in it.
    """

    feedback: State
    corrections: Float[Array, "2 period"]
    errors: Float[Array, "2 period"]
    trial: Int[Array, ""]
    index: Int[Array, ""]


class LearningControl(System):
    """``feedback`` with its reference corrected from trial to trial, (2.14).

    A trial is a ``period`` of the reference. ``feedback``, any controller, sees r + u
    in place of r. In each trial the ``LearningLaw`` with ``gain``, ``smoothing`` and
    ``lead`` computes the correction u of every sample from the trial before; in the
    first trial u is 0. The law also uses later samples of the trial before, and its
    Q-filter has zero phase; ``RepetitiveControl`` learns continuously instead, without
    trials. The loop does not rest between trials; the errors decay provided that the
    transients are shorter than a period.

    Input an Observation, output that of ``feedback``. At rest without error u is zero.
    Raises ValueError unless ``lead`` plus the number of weights in ``smoothing`` is
    below the period.
    """

    feedback: System
    gain: Scalar = parameter("1", "learning gain", typical=(0.0, 1.0))
    period: int = parameter(
        "samples",
        "period of the reference",
        least=2.0,
        most=1e6,
        whole=True,
        static=True,
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
        "lag of the loop",
        least=0.0,
        whole=True,
        static=True,
        default=0,
    )

    def __check_init__(self):
        reach = self.lead + len(self.smoothing)
        if reach >= self.period:
            raise ValueError(
                f"lead and smoothing reach {reach} samples ahead; they must reach less "
                f"than the period, {self.period}"
            )

    def init(self, input: Observation) -> LearningState:
        none = jnp.zeros((2, self.period))
        start = jnp.zeros((), jnp.int32)
        return LearningState(self.feedback.init(input), none, none, start, start)

    def step(
        self, state: LearningState, input: Observation
    ) -> tuple[LearningState, Scalar]:
        law = LearningLaw(self.gain, self.smoothing, self.lead)
        place = state.trial, state.index
        errors = state.errors.at[place].set(input.reference - input.measured)
        ends = (state.index + 1) // self.period
        trial, index = state.trial ^ ends, (state.index + 1) % self.period
        last = 1 - trial
        following = law.corrected(state.corrections[last], errors[last], index)
        observation = input._replace(
            reference=input.reference + state.corrections[place],
            next_reference=as_array(input.next_reference) + following,
        )
        feedback, command = self.feedback.step(state.feedback, observation)
        corrections = state.corrections.at[trial, index].set(following)
        return LearningState(feedback, corrections, errors, trial, index), command
