"""Recursive regression of the model of chapter 3, with forgetting."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core.arrays import Scalar, ScalarLike, as_array, check
from ...core.recursive_update import update_root
from ...core.rollout import simulate
from ...core.system import System
from ...hysteresis import HystereticARMA
from ...hysteresis.coleman_hodgdon import HysteresisState
from ...hysteresis.hysteretic_arma import operators
from ..records.record import Record
from .regressors import Orders


class Measured(NamedTuple):
    """Signals known at sample k: ``voltage`` u(k-1) in V, ``displacement`` z(k) in um.

    They are ``applied`` and ``measured`` in a controller's ``Observation``.
    """

    voltage: ScalarLike
    displacement: ScalarLike


REST = Measured(0.0, 0.0)
"""A plant at rest at zero."""


class RecursiveState(NamedTuple):
    """Coefficients, a root S of their covariance P = S S', and past regressors."""

    theta: Float[Array, " n"]
    root: Float[Array, "n n"]
    hysteresis: tuple[HysteresisState, ...]
    outputs: Float[Array, " autoregressive"]
    operated: Float[Array, "2 moving"]


class RecursiveLeastSquares(System):
    """Recursive least squares for the coefficients of a ``HystereticARMA``.

    The input is ``Measured``, the output the estimated ``HystereticARMA``. In a loop
    the estimate follows a plant that changes. ``c`` (1/V) is not estimated: take it
    from a fit. ``forgetting`` is lambda in (0, 1]: a sample n samples old has the
    weight lambda^n. ``prior`` is the variance of every coefficient before the first
    sample; a larger one weakens the start at zero. The covariance is stored as a
    square root (Potter's update), so that it stays positive over any run. Without
    noise, or at lambda = 1 and a large prior, the result is that of ``least_squares``,
    including its bias under noise.

    Raises ValueError for ``c >= 0``, forgetting outside (0, 1], a prior that is not
    positive, no coefficients or an unknown scheme.
    """

    c: Scalar = eqx.field(converter=as_array)
    forgetting: Scalar = eqx.field(converter=as_array, default=1.0)
    prior: Scalar = eqx.field(converter=as_array, default=1e6)
    rest_input: Scalar = eqx.field(converter=as_array, default=0.0)
    autoregressive: int = eqx.field(static=True, default=2)
    moving: int = eqx.field(static=True, default=3)
    scheme: str = eqx.field(static=True, default="trapezoid")

    def __check_init__(self):
        check("forgetting", self.forgetting, above=0.0, most=1.0)
        check("prior variance", self.prior, above=0.0)
        self._structure()
        self._operators()

    def init(self, input: Measured = REST) -> RecursiveState:
        """Return the state of zero coefficients and a plant at rest under ``input``."""
        size = self._structure().size
        hysteresis, now = self._operate(None, input.voltage)
        return RecursiveState(
            jnp.zeros(size),
            jnp.sqrt(self.prior) * jnp.eye(size),
            hysteresis,
            jnp.full(self.autoregressive, input.displacement),
            jnp.tile(now[:, None], self.moving),
        )

    def step(
        self, state: RecursiveState, input: Measured
    ) -> tuple[RecursiveState, HystereticARMA]:
        hysteresis, now = self._operate(state.hysteresis, input.voltage)
        operated = jnp.concatenate([now[:, None], state.operated[:, :-1]], axis=1)
        row = jnp.concatenate([state.outputs, operated.ravel(), jnp.ones(1)])
        measured = as_array(input.displacement)

        theta, root = update_root(
            state.theta, state.root, row, measured, self.forgetting
        )
        root = root / jnp.sqrt(self.forgetting)

        outputs = jnp.concatenate([measured[None], state.outputs[:-1]])
        state = RecursiveState(theta, root, hysteresis, outputs, operated)
        return state, self._structure().model(self.c, theta)

    def _structure(self) -> Orders:
        return Orders(self.autoregressive, self.moving, self.rest_input, self.scheme)

    def _operators(self):
        return operators(self.c, self.rest_input, self.scheme)

    def _operate(self, states, voltage):
        """Advance both operators, from rest under ``voltage`` if they have no state."""
        both = self._operators()
        states = states or [operator.init(voltage) for operator in both]
        stepped = [o.step(s, voltage) for o, s in zip(both, states, strict=True)]
        return tuple(s for s, _ in stepped), jnp.stack([y for _, y in stepped])


def recursive_least_squares(
    record: Record, estimator: RecursiveLeastSquares
) -> HystereticARMA:
    """Run ``estimator`` over ``record``; the plant must begin at rest.

    Returns the models of all samples as a ``HystereticARMA`` whose numbers have a
    leading axis [samples - 1]. The first model is that after the second sample.
    """
    seen = Measured(jnp.asarray(record.input[:-1]), jnp.asarray(record.output[1:]))
    first = Measured(record.input[0], record.output[0])
    return _run(estimator, seen, jax.tree.map(as_array, first))


@eqx.filter_jit
def _run(estimator, seen, first):
    return simulate(estimator, seen, estimator.init(first))[1]
