"""A constant matrix: what several actuators make of a stage, or sensors of its pose."""

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ..core.arrays import Matrix, State, as_array, as_matrix, check
from ..core.system import System


class LinearMap(System):
    """``output = matrix @ input``: a geometry, a decoupling matrix.

    ``matrix`` [outputs, inputs], in the units of its neighbours in the chain; input and
    output are vectors. Raises ValueError for numbers that are not finite or no matrix.
    """

    matrix: Matrix = eqx.field(converter=as_matrix)

    def __check_init__(self):
        check("matrix", self.matrix)

    def init(self, input: ArrayLike = 0.0) -> State:
        return ()

    def step(
        self, state: State, input: Float[ArrayLike, " inputs"]
    ) -> tuple[State, Float[Array, " outputs"]]:
        return state, self.matrix @ as_array(input)
