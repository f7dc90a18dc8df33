"""Sliding mode control of square multi-axis stages (chapter 7)."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import State, as_scalars
from ..core.axes import (
    Axes,
    Matrix,
    Rows,
    as_full,
    as_matrices,
    as_matrix,
    as_rows,
    check_square,
    minus,
    packed_matrices,
    packed_matrix,
    plus,
    product,
)
from ..core.feedback import Observation
from ..core.parameter import PartUnits, parameter
from ..core.system import Designed, System
from ..dynamics.matrix_arma import MatrixARMA
from .switching import SwitchingLaw, check_gains


class MultiAxisState(NamedTuple):
    """States of the parts and histories, newest first, in the units of the axes.

    ``desired`` holds y_d(k+1), y_d(k), ...; ``forward`` past u1, the last at least;
    ``feedback`` the last u2; ``predicted`` the state X2 of (7.27); ``law`` the state of
    the switching law.
    """

    reference_model: State
    desired: tuple[Axes, ...]
    forward: tuple[Axes, ...]
    feedback: Axes
    predicted: tuple[Axes, ...]
    law: State


class MultiAxisSlidingMode(Designed):
    """Output-tracking sliding mode control with static decoupling, (7.16)-(7.40).

    ``model`` has q axes and any number p of lags. The command is u1 + u2. u1 moves the
    model along the output y_d of ``reference_model``, which maps r(k) to y_d(k+1):
    ``u1(k) = F1 R1 - K_s (u1(k-1) + ... + u1(k-p+1))`` with
    ``R1 = y_d(k+1) - A_(p-1) y_d(k) - ... - A_0 y_d(k-p+1)``, ``decoupling`` K_s
    [q, q], lower triangular in the thesis, and F1 = (I + (p-1) K_s)(sum B)^-1, so that
    the axes are decoupled at rest. u2 acts on e = y - y_d. The state
    X2 = [e(k); e(k+1); ...; e(k+p-1)] holds e(k) and the part of later errors that
    follows from e up to e(k) and past u2 alone. The sliding variable is
    ``s = surface[0] e(k) + surface[1] e(k+1) + ...`` (7.28), each matrix [q, q];
    ``u2 = (S B)^-1 (reaching s - S A X2) + law(s)`` with ``reaching`` PHI [q, q]. In
    the thesis the law is a ``SwitchingPID`` with one gain for each axis; its output
    is in the unit of the commands. PHI enters with the sign of (7.29), (7.31) and
    (7.40); with that of (7.30) and (7.34) the loop is unstable.

    Input an Observation of q axes, output a tuple of q commands. The thesis filters the
    measurements (see ``Filtered``). No parameter is limited in sign, so a loop may be
    unstable.

    At rest without disturbance the state is constant. If the DC gain of the model
    differs from that of the stage, a small error remains at s = 0, because the
    prediction contains no disturbance. From the start the loop drifts slowly to this
    error.

    A diagonal matrix may be given by the q numbers of its diagonal, which takes fewer
    products in each step. Raises ValueError for a matrix or diagonal of another size,
    or a surface that does not hold p matrices.
    """

    part_units: ClassVar[PartUnits] = {"law": {"s": "um", "v": "[u]"}}

    law: SwitchingLaw
    model: MatrixARMA
    reference_model: System
    reaching: Matrix = parameter(
        "1", "reaching gain PHI", typical=(0.0, 0.99), converter=as_matrix
    )
    decoupling: Matrix = parameter(
        "1", "static decoupling K_s", typical=(-0.45, 0.45), converter=as_matrix
    )
    surface: tuple[Matrix, ...] = parameter(
        "1",
        "weights of the errors in s",
        typical=(-1.98, 1.98),
        converter=lambda matrices: tuple(map(as_matrix, matrices)),
    )

    def __check_init__(self):
        q, p = self.model.axes, len(self.model.moving)
        check_gains(self.law, q)
        check_square("reaching", self.reaching, q)
        check_square("decoupling", self.decoupling, q)
        if len(self.surface) != p:
            raise ValueError(
                f"surface holds {len(self.surface)} matrices; it must hold {p}, one "
                "for each lag of the model"
            )
        for index, matrix in enumerate(self.surface):
            check_square(f"surface[{index}]", matrix, q)

    @property
    def dt(self) -> float:
        """Sample time, s."""
        return self.model.dt

    def resolved(self) -> "ResolvedMultiAxis":
        """Return the controller with its gain matrices computed."""
        # Packed into arrays: XLA would copy scalar terms into every result that has
        # them, and take several times as long to compile.
        A, B = self.model.packed()
        S = packed_matrices(map(as_full, self.surface))
        PHI = packed_matrix(as_full(self.reaching))
        lags, q = len(B) - 1, self.model.axes
        shared = jnp.eye(q) + lags * packed_matrix(as_full(self.decoupling))
        forward = shared @ jnp.linalg.inv(B.sum(0))
        driven = (S @ self.model.responses()).sum(0)
        # X2 moves up by one block; the A of the model give the last block.
        moved = (S[-1] @ A[::-1]).at[1:].add(S[:-1])
        return ResolvedMultiAxis(
            self.law,
            self.decoupling,
            self.surface,
            self.model,
            forward=as_rows(forward),
            past_desired=as_matrices(forward @ A),
            rest=as_rows(jnp.linalg.inv(shared)),
            equivalent=as_matrices(jnp.linalg.inv(driven) @ (PHI @ S - moved)),
            reference_model=self.reference_model,
        )


class ResolvedMultiAxis(System):
    """MultiAxisSlidingMode with its gain matrices computed.

    ``forward`` F1, ``past_desired`` F1 A_i, ``rest`` (I + (p-1) K_s)^-1 and
    ``equivalent`` (S B)^-1 (PHI S - S A), with one matrix for each block of X2.
    """

    law: SwitchingLaw
    decoupling: Matrix
    surface: tuple[Matrix, ...]
    model: MatrixARMA
    forward: Rows
    past_desired: tuple[Rows, ...]
    rest: Rows
    equivalent: tuple[Rows, ...]
    reference_model: System

    def _forward(self, desired: tuple[Axes, ...], past: tuple[Axes, ...]) -> Axes:
        """Return u1 for y_d(k+1), ..., y_d(k-p+1) and the last p-1 values of u1."""
        newest, *older = desired
        wanted = product(self.forward, newest)
        for matrix, value in zip(self.past_desired, older, strict=True):
            wanted = minus(wanted, product(matrix, value))
        if past:
            wanted = minus(wanted, product(self.decoupling, plus(*past)))
        return wanted

    def _predicted(
        self, error: Axes, last: tuple[Axes, ...], feedback: Axes
    ) -> tuple[Axes, ...]:
        """Return X2(k) from e(k), X2(k-1) and u2(k-1).

        Each block is computed from the blocks before it in X2(k) and X2(k-1), so that
        no product is computed twice.
        """
        blocks = [error]
        model = self.model
        A, B = model.autoregressive, model.moving
        p = len(B)
        for j in range(1, p):
            block = product(B[j], feedback)
            # The last block has no successor in X2(k-1); A_0 e(k-1) is in its place.
            inner = j + 1 < p
            older = last[j + 1] if inner else product(A[j], last[0])
            block = plus(block, older)
            for i in range(j):
                known = blocks[j - 1 - i]
                known = minus(known, last[j - i]) if inner else known
                block = plus(block, product(A[i], known))
            blocks.append(block)
        return tuple(blocks)

    def _sliding(self, predicted: tuple[Axes, ...]) -> Axes:
        return _summed(self.surface, predicted)

    def init(self, input: Observation) -> MultiAxisState:
        desired = as_scalars(input.reference)
        measured, applied = map(as_scalars, (input.measured, input.applied))
        p = len(self.surface)
        # Packed, as in ``MultiAxisSlidingMode.resolved``.
        A, B = self.model.packed()
        r = jnp.stack(desired)
        # At rest u1 equals its past: (I + (p-1) K_s) u1 = F1 R1.
        wanted = packed_matrix(self.forward) @ (r - A.sum(0) @ r)
        forward = packed_matrix(self.rest) @ wanted
        feedback, error = jnp.stack(applied) - forward, jnp.stack(measured) - r
        blocks = [error]
        for j in range(1, p):
            known = (A[:j] @ jnp.stack(blocks[::-1])[:, :, None])[:, :, 0].sum(0)
            blocks.append(known + A[j:].sum(0) @ error + B[j:].sum(0) @ feedback)
        predicted = tuple(as_scalars(block) for block in blocks)
        feedback, forward = as_scalars(feedback), as_scalars(forward)
        equivalent = _summed(self.equivalent, predicted)
        return MultiAxisState(
            reference_model=self.reference_model.init(desired),
            desired=(desired,) * p,
            forward=(forward,) * max(p - 1, 1),
            feedback=feedback,
            predicted=predicted,
            law=self.law.start(self._sliding(predicted), minus(feedback, equivalent)),
        )

    def step(
        self, state: MultiAxisState, input: Observation
    ) -> tuple[MultiAxisState, Axes]:
        error = minus(input.measured, state.desired[0])
        reference_model, following = self.reference_model.step(
            state.reference_model, input.reference
        )
        desired = (following, *state.desired)
        forward = self._forward(desired, state.forward[: len(self.surface) - 1])

        predicted = self._predicted(error, state.predicted, state.feedback)
        sliding = self._sliding(predicted)
        shortfall = minus(input.applied, plus(state.forward[0], state.feedback))
        driven = self.law.driven(state.law, shortfall)
        law, switching = self.law.step(driven, sliding)
        feedback = plus(_summed(self.equivalent, predicted), switching)
        state = MultiAxisState(
            reference_model=reference_model,
            desired=desired[:-1],
            forward=(forward, *state.forward)[: len(state.forward)],
            feedback=feedback,
            predicted=predicted,
            law=law,
        )
        return state, plus(forward, feedback)


def _summed(matrices: tuple[Matrix, ...], blocks: tuple[Axes, ...]) -> Axes:
    pairs = zip(matrices, blocks, strict=True)
    return plus(*(product(matrix, block) for matrix, block in pairs))
