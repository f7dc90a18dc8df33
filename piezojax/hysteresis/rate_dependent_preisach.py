"""Preisach hysteresis whose density depends on the rate of the input."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.arrays import Matrix, Scalar, ScalarLike, as_matrix
from ..core.parameter import parameter, sample_time
from ..core.system import Designed, System
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis
from .play_lines import Levels, PlayLines, Rows, outputs, rows_of
from .preisach import Preisach, check_weights


class RateDependentPreisach(Hysteresis, Designed):
    """Preisach model ``y = integral of mu(alpha, beta, du/dt) relay(u)``, (2.10).

    In each cell mu changes from the density of ``slow`` to that of ``fast_weights``
    (um, n x n as in Preisach) with the share r^2 / (1 + r^2), r = (du/dt) / ``rate``.
    The share is 1/2 at ``rate`` and smooth where the input turns. du/dt is the rate
    over the last sample. The relays and their memory are those of ``slow``. Input in V,
    output in um. The thesis represents mu by a neural network instead.

    Raises ValueError for parameters outside their limits, weights that Preisach rejects
    or a number of cells other than that of ``slow``.
    """

    slow: Preisach
    fast_weights: Matrix = parameter(
        "um", "weights of fast inputs", least=0.0, converter=as_matrix
    )
    rate: Scalar = parameter("V/s", "rate at which the shares are equal", above=0.0)
    dt: float = sample_time()

    def __check_init__(self):
        check_weights("fast_weights", self.fast_weights)
        if self.fast_weights.shape[0] != self.slow.cells:
            raise ValueError(
                f"fast_weights have {self.fast_weights.shape[0]} cells per side; "
                f"they must have {self.slow.cells}, as the weights of slow"
            )

    def resolved(self) -> System:
        slow = self.slow.resolved()
        half_way = self.rate * self.dt / slow.size
        return _Blend(slow, rows_of(self.fast_weights), half_way)

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        # Beyond the triangle the output is flat.
        within = jnp.maximum(lower, self.slow.low), jnp.minimum(upper, self.slow.high)
        return InverseHysteresis(self, *within)


class _Blend(System):
    slow: PlayLines
    fast: Rows
    half_way: Scalar  # cells per sample at which the shares are equal

    def init(self, input: ScalarLike = 0.0) -> Levels:
        return self.slow.init(input)

    def step(self, state: Levels, input: ScalarLike) -> tuple[Levels, Scalar]:
        levels = self.slow.advance(state, input)
        slow, fast = outputs(levels, self.slow.rows, self.fast)
        # Element 0 of both is the input, in cells.
        share = fast_share((levels[0] - state[0]) / self.half_way)
        return levels, self.slow.lowest + jnp.sum(slow + share * (fast - slow))


def fast_share(rate: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the share of the fast density; it is 1/2 at a relative ``rate`` of 1."""
    square = rate**2
    return square / (1.0 + square)
