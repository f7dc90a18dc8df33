"""State-tracking sliding mode control of several axes with state estimation."""

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import Scalar, State, as_array
from ..core.axes import (
    Axes,
    Matrix,
    as_full,
    as_matrix,
    check_square,
    minus,
    packed_matrix,
)
from ..core.feedback import Observation
from ..core.parameter import PartUnits, parameter
from ..core.system import Designed, System
from ..dynamics.state_space import StateSpace
from .riccati import riccati
from .switching import SwitchingLaw, check_gains

Vector = Float[Array, " n"]


class StateSlidingModeState(NamedTuple):
    """States of the reference model and the law, the estimate, and the last signals.

    ``estimate`` holds x(k|k) of the model and the input disturbance d, ``desired``
    y_d(k+1), ``command`` the last command.
    """

    reference_model: State
    law: State
    estimate: Vector
    desired: Axes
    command: Axes


class StateSlidingMode(Designed):
    """Sliding mode control of q axes on the estimated state of ``model``.

    The controller tracks estimated states, as the thesis proposes (first approach under
    the third item of future work); ``MultiAxisSlidingMode`` tracks outputs. ``model``
    has q inputs, q outputs and any number of states; u(k) moves it to
    y(k+1) = C x(k+1). A steady-state Kalman filter estimates x and a disturbance d of
    the inputs,

    ``x(k+1) = A x(k) + B (u(k) + d(k) + w)``, ``d(k+1) = d(k) + n``, ``z = C x + v``,

    where w has the rms value ``process`` and n has ``drift``, both relative to that of
    v, the sensor noise of all axes. ``reference_model`` maps r(k) to y_d(k+1), and the
    model rests at y_d in the state N y_d. The sliding variable is s = S (x - N y_d)
    with S = B' P. P solves the Riccati equation with the weights C' C and
    ``effort_weight``^2, and the motion on s = 0 is stable for every weight. With the
    equivalent control, s(k+1) = ``reaching`` s(k) + S B law(s). The estimate of d
    removes offsets, so the law may be zero.

    Input an Observation of q axes, output a tuple of q commands. Raises ValueError for
    a model with a direct transmission or with different numbers of inputs and outputs,
    and for ``reaching`` or a gain of the law that is a matrix or diagonal of another
    size than q.
    """

    part_units: ClassVar[PartUnits] = {"law": {"s": "um", "v": "[u]"}}

    law: SwitchingLaw
    model: StateSpace
    reference_model: System
    reaching: Matrix = parameter(
        "1", "reaching gain PHI", typical=(0.0, 0.99), converter=as_matrix
    )
    effort_weight: Scalar = parameter(
        "um/[u]", "weight of the command", above=0.0, scale="log", typical=(1e-3, 1e2)
    )
    process: Scalar = parameter(
        "[u]/um",
        "rms noise of the input, relative to that of the sensor",
        above=0.0,
        scale="log",
        typical=(1e-3, 1e2),
    )
    drift: Scalar = parameter(
        "[u]/um",
        "rms change of the disturbance per sample, relative to the sensor noise",
        above=0.0,
        scale="log",
        typical=(1e-5, 1e1),
    )

    def __check_init__(self):
        outputs, inputs = self.model.D.shape
        if inputs != outputs:
            raise ValueError(
                f"the model has {inputs} inputs and {outputs} outputs; the numbers "
                "must be equal"
            )
        if np.any(np.asarray(self.model.D)):
            raise ValueError("D of the model is not zero; y(k) must not depend on u(k)")
        check_gains(self.law, outputs)
        check_square("reaching", self.reaching, outputs)

    @property
    def dt(self) -> float:
        """Sample time, s."""
        return self.model.dt

    def resolved(self) -> "ResolvedStateSlidingMode":
        """Return the controller with its matrices computed."""
        A, B, C = self.model.A, self.model.B, self.model.C
        n, q = B.shape
        P, _ = riccati(A, B @ B.T / self.effort_weight**2, C.T @ C)
        S = B.T @ P
        reach, PHI = jnp.linalg.inv(S @ B), packed_matrix(as_full(self.reaching))
        # At rest at y the state is N y.
        gain = jnp.linalg.solve(jnp.eye(n) - A, B)
        N = gain @ jnp.linalg.inv(C @ gain)

        whole = jnp.block([[A, B], [jnp.zeros((q, n)), jnp.eye(q)]])
        seen = jnp.hstack([C, jnp.zeros((q, q))])
        noise = jax.scipy.linalg.block_diag(
            self.process**2 * B @ B.T, self.drift**2 * jnp.eye(q)
        )
        X, _ = riccati(whole.T, seen.T @ seen, noise)
        return ResolvedStateSlidingMode(
            self.law,
            self.reference_model,
            whole,
            jnp.vstack([B, jnp.zeros((q, q))]),
            seen,
            X @ seen.T @ jnp.linalg.inv(seen @ X @ seen.T + jnp.eye(q)),
            S,
            N,
            jnp.hstack([reach @ (PHI @ S - S @ A), -jnp.eye(q)]),
            reach @ S @ N,
            reach @ PHI @ S @ N,
        )


class ResolvedStateSlidingMode(System):
    """StateSlidingMode with its matrices computed.

    ``A``, ``B`` and ``C`` of model and disturbance, ``gain`` of the filter, ``surface``
    S and ``rest`` N; the command is ``equivalent`` [x; d] + ``forward`` y_d(k+1) -
    ``hold`` y_d(k) + law(s).
    """

    law: SwitchingLaw
    reference_model: System
    A: Float[Array, "whole whole"]
    B: Float[Array, "whole axes"]
    C: Float[Array, "axes whole"]
    gain: Float[Array, "whole axes"]
    surface: Float[Array, "axes states"]
    rest: Float[Array, "states axes"]
    equivalent: Float[Array, "axes whole"]
    forward: Float[Array, "axes axes"]
    hold: Float[Array, "axes axes"]

    def _advance(
        self, estimate: Vector, desired: Axes, following: Axes
    ) -> tuple[Axes, Axes]:
        """Return s and the command without the law's part."""
        now, then = jnp.stack(desired), jnp.stack(following)
        n = self.rest.shape[0]
        sliding = self.surface @ (estimate[:n] - self.rest @ now)
        command = self.equivalent @ estimate + self.forward @ then - self.hold @ now
        return tuple(sliding), tuple(command)

    def init(self, input: Observation) -> StateSlidingModeState:
        desired = tuple(as_array(r) for r in input.reference)
        applied = tuple(as_array(u) for u in input.applied)
        measured = tuple(as_array(z) for z in input.measured)
        state = self.rest @ jnp.stack(measured)
        # The disturbance is the input that holds the model here, less the applied one.
        calm = jnp.concatenate([state, jnp.zeros(len(measured))])
        _, needed = self._advance(calm, measured, measured)
        held = jnp.stack(minus(needed, applied))
        estimate = jnp.concatenate([state, held])
        sliding, command = self._advance(estimate, desired, desired)
        return StateSlidingModeState(
            reference_model=self.reference_model.init(desired),
            law=self.law.start(sliding, minus(applied, command)),
            estimate=estimate,
            desired=desired,
            command=applied,
        )

    def step(
        self, state: StateSlidingModeState, input: Observation
    ) -> tuple[StateSlidingModeState, Axes]:
        applied, measured = jnp.stack(input.applied), jnp.stack(input.measured)
        predicted = self.A @ state.estimate + self.B @ applied
        estimate = predicted + self.gain @ (measured - self.C @ predicted)
        reference_model, following = self.reference_model.step(
            state.reference_model, input.reference
        )
        sliding, command = self._advance(estimate, state.desired, following)
        driven = self.law.driven(state.law, minus(input.applied, state.command))
        law, switching = self.law.step(driven, sliding)
        command = jax.tree.map(jnp.add, command, tuple(switching))
        state = StateSlidingModeState(
            reference_model, law, estimate, following, command
        )
        return state, command
