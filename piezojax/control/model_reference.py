"""Model-reference sliding mode control (section 4.5.3.3)."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array, as_scalars
from ..core.feedback import Observation
from ..core.parameter import PartUnits, parameter
from ..core.system import System
from ..dynamics.arma import ARMA
from .observer import Observer
from .output_tracking import check_has_poles, check_inversion, dot, inversion_gain
from .switching import SwitchingLaw


class ModelReferenceState(NamedTuple):
    """States of the parts; histories, newest first, of y_d and errors in um.

    ``desired`` starts at y_d(k); ``forward`` and ``feedback`` hold past values of u1
    and of u_eq + du in V, at least the last ones.
    """

    filter: State
    reference_model: State
    desired: tuple[Scalar, ...]
    errors: tuple[Scalar, ...]
    forward: tuple[Scalar, ...]
    feedback: tuple[Scalar, ...]
    law: State


class ModelReferenceSlidingMode(System):
    """Sliding mode control along a reference model, for a model of any order n.

    The error is e = y - y_d, with y from ``filter`` and y_d the output of
    ``reference_model``. The sliding variable is ``s(k) = surface[0] e(k-n+1) + ... +
    surface[n-2] e(k-1) + e(k)`` in um: (4.41) at the last n known errors, because the
    printed form contains the unknown e(k+1). The voltage is u1 + u_eq + du: u1 moves
    ``model`` (a_1, ..., a_n | b_0, ..., b_0 not zero) along y_d (4.32), u_eq takes s to
    zero (4.42) and du is the output of ``law`` in V, a ``SwitchingPID`` in (4.43). Both
    u1 and u_eq contain the inverse of b_0, in the form ``inversion`` of ``INVERSIONS``;
    du does not. ``reference_model`` maps r(k) to y_d(k+1), so y_d lags r by a sample
    and by the lag of the reference model; ``Anticipation`` compensates both.

    Input an Observation, whose next reference is not used; output in V. Raises
    ValueError for a model without a_1, a surface that does not hold n - 1 weights, b_0
    = 0 or an unknown inversion.
    """

    part_units: ClassVar[PartUnits] = {"law": {"s": "um", "v": "[u]"}}

    law: SwitchingLaw
    model: ARMA
    reference_model: System
    filter: Observer
    surface: tuple[Scalar, ...] = parameter(
        "1", "weights of older errors in s", typical=(-0.99, 0.99), converter=as_scalars
    )
    error_weight: Scalar = parameter(
        "1", "weight Q of the inversion; only Q / R counts", above=0.0, scale="log"
    )
    control_weight: Scalar = parameter(
        "1", "weight R of the inversion", least=0.0, scale="log", typical=(1e-4, 1e3)
    )
    inversion: str = eqx.field(static=True, default="tikhonov")

    def __check_init__(self):
        check_has_poles(self.model)
        order = len(self.model.autoregressive)
        if len(self.surface) != order - 1:
            raise ValueError(
                f"surface holds {len(self.surface)} weights; it must hold {order - 1} "
                f"for a model of order {order}"
            )
        check_inversion(self.inversion, self.model)

    def _inverse(self, wanted: Scalar, past: tuple[Scalar, ...]) -> Scalar:
        """Return the input that makes the model add ``wanted`` (um) to its output."""
        later = self.model.moving[1:]
        gain = inversion_gain(
            self.inversion, self.model, self.error_weight, self.control_weight
        )
        return gain * (wanted - dot(later, past))

    def _advanced(self, outputs: tuple[Scalar, ...]) -> Scalar:
        """Return the contribution of the past ``outputs`` to the model's next one."""
        return as_array(dot(self.model.autoregressive, outputs))

    def _sliding(self, errors: tuple[Scalar, ...]) -> Scalar:
        newest, *older = errors
        return newest + dot(reversed(self.surface), older)

    def _equivalent(
        self, errors: tuple[Scalar, ...], past: tuple[Scalar, ...]
    ) -> Scalar:
        # S A_e delta: each error one sample older, the newest predicted by the model.
        shifted = dot(reversed(self.surface), errors)
        return self._inverse(-(self._advanced(errors) + shifted), past)

    def init(self, input: Observation) -> ModelReferenceState:
        reference = as_array(input.reference)
        order, lags = len(self.model.autoregressive), len(self.model.moving) - 1
        desired = (reference,) * order
        # At rest u1 equals its past: the fixed point of an affine map, from two values.
        wanted = reference - self._advanced(desired)
        none = (jnp.zeros_like(reference),) * lags
        start = self._inverse(wanted, none)
        slope = self._inverse(jnp.zeros_like(reference), (as_array(1.0),) * lags)
        forward = start / (1.0 - slope)
        feedback = input.applied - forward
        errors = (input.measured - reference,) * order
        # The law gives the part of the feedback that u_eq does not.
        equivalent = slope * feedback + self._equivalent(errors, none)
        return ModelReferenceState(
            filter=self.filter.init(input),
            reference_model=self.reference_model.init(reference),
            desired=desired,
            errors=errors[1:],
            forward=(forward,) * max(lags, 1),
            feedback=(feedback,) * max(lags, 1),
            law=self.law.start(self._sliding(errors), feedback - equivalent),
        )

    def step(
        self, state: ModelReferenceState, input: Observation
    ) -> tuple[ModelReferenceState, Scalar]:
        filter_state, motion = self.filter.step(state.filter, input)
        errors = (motion.position - state.desired[0], *state.errors)
        reference_model, following = self.reference_model.step(
            state.reference_model, input.reference
        )

        wanted = following - self._advanced(state.desired)
        forward = self._inverse(wanted, state.forward)

        sliding = self._sliding(errors)
        equivalent = self._equivalent(errors, state.feedback)
        shortfall = input.applied - (state.forward[0] + state.feedback[0])
        driven = self.law.driven(state.law, shortfall)
        law, switching = self.law.step(driven, sliding)
        feedback = equivalent + switching

        state = ModelReferenceState(
            filter=filter_state,
            reference_model=reference_model,
            desired=(following, *state.desired[:-1]),
            errors=errors[:-1],
            forward=(forward, *state.forward)[: len(state.forward)],
            feedback=(feedback, *state.feedback)[: len(state.feedback)],
            law=law,
        )
        return state, forward + feedback
