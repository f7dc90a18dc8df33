"""Constant matrix between signals: the geometry of actuators or of sensors."""

from jaxtyping import Array, ArrayLike, Float

from ..core.arrays import Matrix, State, as_array, as_matrix
from ..core.parameter import parameter
from ..core.system import System


class LinearMap(System):
    """``output = matrix @ input``: a geometry, a decoupling matrix.

    ``matrix`` [outputs, inputs], in the units of its neighbours in the chain; input and
    output are vectors. Raises ValueError unless ``matrix`` is a matrix of finite
    numbers.
    """

    matrix: Matrix = parameter(
        "1", "output by input, in the units of the neighbours", converter=as_matrix
    )

    def init(self, input: ArrayLike = 0.0) -> State:
        return ()

    def step(
        self, state: State, input: Float[ArrayLike, " inputs"]
    ) -> tuple[State, Float[Array, " outputs"]]:
        return state, self.matrix @ as_array(input)
