"""Linear dynamics with several inputs, identified input by input."""

from collections.abc import Sequence
from functools import reduce

import jax.numpy as jnp
import numpy as np

from ..core.arrays import Scalar, ScalarLike, as_scalars
from ..core.axes import Axes, Rows, as_rows, check_square, packed_matrix, plus, product
from ..core.parameter import parameter, sample_time
from ..core.system import System
from .state_space import StateSpace


class Channel(System):
    """Response of all outputs to one input: ``x(k+1) = A x + B u``, ``y(k) = C x(k)``.

    ``A`` [n, n], ``B`` [n], ``C`` [outputs, n] in the units of the input and outputs.
    The input is the scalar u(k), the output y(k+1) a tuple with one scalar per output.
    Raises ValueError for sizes that do not match or numbers that are not finite.
    """

    A: Rows = parameter("1", "state matrix", converter=as_rows)
    B: Axes = parameter("1", "input matrix", converter=as_scalars)
    C: Rows = parameter("1", "output matrix", converter=as_rows)
    dt: float = sample_time()

    def __check_init__(self):
        check_square("A", self.A, len(self.B))
        if len(self.C[0]) != len(self.B):
            raise ValueError(
                f"C has {len(self.C[0])} columns; it must have one for each of "
                f"{len(self.B)} states"
            )

    def init(self, input: ScalarLike = 0.0) -> Axes:
        A = packed_matrix(self.A)
        gain = jnp.linalg.solve(jnp.eye(len(A)) - A, jnp.stack(self.B))
        return tuple(gain[i] * input for i in range(len(self.B)))

    def step(self, state: Axes, input: Scalar) -> tuple[Axes, Axes]:
        driven = tuple(b * input for b in self.B)
        state = plus(product(self.A, state), driven)
        return state, product(self.C, state)


class Channels(System):
    """Sum of the responses to several inputs, one Channel per input, (6.19)-(6.22).

    A step maps u(k) to y(k+1), as a loop expects of its plant. Inputs and outputs are
    tuples of scalars. Raises ValueError if there are no parts, or if they differ in the
    number of outputs or the sample time.
    """

    parts: tuple[Channel, ...]

    def __check_init__(self):
        kinds = {(len(part.C), part.dt) for part in self.parts}
        if len(kinds) != 1:
            raise ValueError(
                f"channels differ in (outputs, sample time): {sorted(kinds)}; "
                "there must be at least one, and all must be the same"
            )

    def init(self, input: Axes) -> tuple[Axes, ...]:
        return tuple(p.init(u) for p, u in zip(self.parts, input, strict=True))

    def step(
        self, state: tuple[Axes, ...], input: Axes
    ) -> tuple[tuple[Axes, ...], Axes]:
        stepped = [
            part.step(x, u) for part, x, u in zip(self.parts, state, input, strict=True)
        ]
        outputs = reduce(plus, (y for _, y in stepped))
        return tuple(x for x, _ in stepped), outputs


def channels_of(models: Sequence[StateSpace]) -> Channels:
    """Return the plant of a loop from ``models`` with one input each.

    Raises ValueError for a model with more inputs, or with D other than zero, because
    the output must not depend on the input of the same sample.
    """
    for model in models:
        if model.B.shape[1] != 1:
            raise ValueError(f"a channel has {model.B.shape[1]} inputs; it must have 1")
        if np.any(np.asarray(model.D)):
            raise ValueError("D is not zero; y(k) must not depend on u(k)")
    return Channels(tuple(Channel(m.A, m.B[:, 0], m.C, m.dt) for m in models))
