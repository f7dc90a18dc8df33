"""Repetitive control: the error of one period corrects the reference of the next."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core.arrays import Scalar, State, as_array
from ..core.feedback import Observation
from ..core.parameter import parameter
from ..core.system import System


class RepetitiveState(NamedTuple):
    """States of controller and Q-filter, w(k) in um, and the delay line.

    ``line`` is a ring buffer of ``period - advance`` samples in um, ``index`` the place
    of sample k in it. A step writes two samples and reads one, whatever the period.
    """

    feedback: State
    filter: State
    correction: Scalar
    line: Float[Array, " period"]
    index: Int[Array, ""]


class RepetitiveControl(System):
    """``feedback`` with its reference corrected by the errors of past periods.

    The plug-in form of section 2.6.3, Figure 2.17: ``feedback``, any controller, sees
    r + w in place of r, with

    ``w = Q z^-period (w + gain z^lead e)``

    and the error e, reference less measurement, in um. ``filter`` Q is any low pass
    from um to um with unit DC gain and no offset. Its delay ``advance`` is subtracted
    from the length of the delay line. A ``FirstOrderLag`` with time constant tau has a
    delay of about tau / dt; symmetric ``ARMA`` coefficients make Q exactly zero-phase.

    Let T be the inner loop from reference to measurement, and take Q without its delay.
    The error of a linear loop decays from period to period if
    ``|Q (1 - gain z^lead T)| < 1`` at all frequencies. There is no anti-windup: an
    unreachable reference winds w up.

    Input an Observation, output that of ``feedback``. At rest without error w is zero.
    Raises ValueError for ``lead + advance >= period``.
    """

    feedback: System
    filter: System
    gain: Scalar = parameter("1", "learning gain", least=0.0, typical=(0.0, 1.0))
    period: int = parameter(
        "samples",
        "period of the reference",
        least=2.0,
        most=1e6,
        whole=True,
        static=True,
    )
    lead: int = parameter(
        "samples",
        "approximate lag of the inner loop",
        least=0.0,
        whole=True,
        static=True,
        default=0,
    )
    advance: int = parameter(
        "samples",
        "delay of the Q-filter",
        least=0.0,
        whole=True,
        static=True,
        default=0,
    )

    def __check_init__(self):
        if self.lead + self.advance >= self.period:
            raise ValueError(
                f"lead is {self.lead} and advance {self.advance} samples; "
                f"their sum must be below the period, {self.period}"
            )

    def init(self, input: Observation) -> RepetitiveState:
        zero = jnp.zeros_like(as_array(input.reference))
        return RepetitiveState(
            feedback=self.feedback.init(input),
            filter=self.filter.init(zero),
            correction=zero,
            line=jnp.zeros(self.period - self.advance),
            index=jnp.zeros((), jnp.int32),
        )

    def step(
        self, state: RepetitiveState, input: Observation
    ) -> tuple[RepetitiveState, Scalar]:
        length = self.period - self.advance
        error = input.reference - input.measured
        # e(k) corrects w(k - lead), which is still in the line.
        line = state.line.at[state.index].set(state.correction)
        learned = jnp.mod(state.index - self.lead, length)
        line = line.at[learned].add(self.gain * error)
        index = jnp.mod(state.index + 1, length)
        filter_state, correction = self.filter.step(state.filter, line[index])
        observation = input._replace(
            reference=input.reference + state.correction,
            next_reference=input.next_reference + correction,
        )
        feedback, command = self.feedback.step(state.feedback, observation)
        return RepetitiveState(feedback, filter_state, correction, line, index), command
