"""Linear state-space models with any number of inputs and outputs."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float
from scipy import linalg

from ..core.arrays import Matrix, as_array, as_matrix
from ..core.parameter import parameter, sample_time
from ..core.system import System
from .arma import ARMA

STABILISED_MODULUS = 1.0 - 1e-6
"""Largest modulus of a pole after ``stabilised`` has moved it."""


class StateSpace(System):
    """``x(k+1) = A x(k) + B u(k)``, ``y(k) = C x(k) + D u(k)``, (6.1).

    ``A`` [n, n], ``B`` [n, m], ``C`` [p, n], ``D`` [p, m] for n states, m inputs and p
    outputs in the units of the neighbours in the chain. Inputs and outputs are vectors,
    even with a single element.

    A loop and ``free_run`` expect a plant that maps u(k) to y(k+1), which
    ``one_step_ahead`` returns. Raises ValueError for matrices whose shapes do not match
    or numbers that are not finite.
    """

    A: Matrix = parameter("1", "state matrix", converter=as_matrix)
    B: Matrix = parameter("1", "input matrix", converter=as_matrix)
    C: Matrix = parameter("1", "output matrix", converter=as_matrix)
    D: Matrix = parameter("1", "direct transmission", converter=as_matrix)
    dt: float = sample_time()

    def __check_init__(self):
        (n, m), p = self.B.shape, len(self.C)
        for name, shape in (("A", (n, n)), ("C", (p, n)), ("D", (p, m))):
            matrix = getattr(self, name)
            if matrix.shape != shape:
                raise ValueError(
                    f"{name} has shape {matrix.shape}; with B of shape {self.B.shape} "
                    f"and {p} outputs it must be {shape}"
                )

    @property
    def order(self) -> int:
        """Number of states n."""
        return len(self.A)

    def poles(self) -> np.ndarray:
        """Return the poles in the z plane (concrete parameters only)."""
        return np.linalg.eigvals(np.asarray(self.A))

    def dc_gain(self) -> Float[Array, "p m"]:
        """Return outputs over inputs at rest."""
        return self.C @ _at_rest(self.A, self.B) + self.D

    def markov(self, count: int) -> Float[Array, "count p m"]:
        """Return ``C A^s B`` for s = 0 .. count-1: the impulse response after D."""
        _, powers = jax.lax.scan(
            lambda power, _: (self.A @ power, self.C @ power), self.B, length=count
        )
        return powers

    @jax.jit
    def frequency_response(
        self, frequency: Float[ArrayLike, " lines"]
    ) -> Complex[Array, "lines p m"]:
        """Return ``C (z I - A)^-1 B + D`` at ``frequency`` in Hz."""
        z = jnp.exp(2j * jnp.pi * self.dt * as_array(frequency))
        resolvent = z[:, None, None] * jnp.eye(self.order) - self.A
        return self.C @ jnp.linalg.solve(resolvent, self.B + 0j) + self.D

    def one_step_ahead(self) -> "StateSpace":
        """Return the model that maps u(k) to y(k+1), as a loop expects of its plant.

        Raises ValueError if D is not zero, because the loop would be algebraic.
        """
        if np.any(np.asarray(self.D)):
            raise ValueError("D is not zero; y(k) must not depend on u(k)")
        return StateSpace(self.A, self.B, self.C @ self.A, self.C @ self.B, self.dt)

    def as_arma(self) -> ARMA:
        """Return the difference equation of a model with one input and one output.

        The order is unchanged. Raises ValueError for several inputs or outputs.
        """
        outputs, inputs = self.D.shape
        if (outputs, inputs) != (1, 1):
            raise ValueError(
                f"the model has {inputs} inputs and {outputs} outputs; "
                "a difference equation needs one of each"
            )
        A, B, C, D = (np.asarray(m) for m in (self.A, self.B, self.C, self.D))
        if self.order == 0:
            return ARMA((), (D[0, 0],))
        denominator = np.poly(A)
        numerator = np.poly(A - B @ C) + (float(D[0, 0]) - 1.0) * denominator
        return ARMA(-denominator[1:], numerator)

    def delayed(self) -> "StateSpace":
        """Return the model with its input delayed by a sample: D = 0, m more states.

        A controller that needs one sample to compute its command acts on this model.
        """
        n, m = self.B.shape
        return StateSpace(
            jnp.block([[self.A, self.B], [jnp.zeros((m, n + m))]]),
            jnp.concatenate([jnp.zeros((n, m)), jnp.eye(m)]),
            jnp.hstack([self.C, self.D]),
            jnp.zeros_like(self.D),
            self.dt,
        )

    def init(self, input: ArrayLike = 0.0) -> Float[Array, " n"]:
        inputs = jnp.broadcast_to(as_array(input), self.B.shape[1:])
        return _at_rest(self.A, self.B @ inputs)

    def step(
        self, state: Float[Array, " n"], input: Float[Array, " m"]
    ) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
        input = as_array(input)
        return self.A @ state + self.B @ input, self.C @ state + self.D @ input


@jax.jit
def _at_rest(A: Array, forcing: Array) -> Array:
    return jnp.linalg.solve(jnp.eye(len(A)) - A, forcing)


def stacked(channels: Sequence[StateSpace]) -> StateSpace:
    """Return one model of several inputs from models of the channels, (6.19)-(6.22).

    Each channel has its own states; their outputs are summed. Raises ValueError if
    there are no channels, or if they differ in the number of outputs or the sample
    time.
    """
    if not channels:
        raise ValueError("there are no channels to stack")
    kinds = {(len(channel.C), channel.dt) for channel in channels}
    if len(kinds) > 1:
        raise ValueError(
            f"channels differ in (outputs, sample time): {sorted(kinds)}; "
            "they must be the same"
        )
    return StateSpace(
        jax.scipy.linalg.block_diag(*(channel.A for channel in channels)),
        jax.scipy.linalg.block_diag(*(channel.B for channel in channels)),
        jnp.hstack([channel.C for channel in channels]),
        jnp.hstack([channel.D for channel in channels]),
        channels[0].dt,
    )


def stabilised(model: StateSpace) -> tuple[StateSpace, int]:
    """Return ``model`` with every pole inside the unit circle, and the number moved."""
    A, moved = reflected(np.asarray(model.A))
    return StateSpace(A, model.B, model.C, model.D, model.dt), moved


def reflected(
    A: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, "n n"], int]:
    """Return ``A`` with every eigenvalue inside the unit circle, and the number moved.

    An eigenvalue z on or outside the circle is scaled to 1/conj(z), which preserves the
    shape of its resonance, or to the modulus STABILISED_MODULUS if that is smaller. The
    diagonal block of the real Schur form that contains it is scaled.
    """
    schur, basis = linalg.schur(A, output="real")[:2]
    moved, first = 0, 0
    while first < len(schur):
        pair = bool(np.any(schur[first + 1 : first + 2, first]))
        block = slice(first, first + 1 + pair)
        modulus = np.abs(linalg.eigvals(schur[block, block])).max()
        if modulus >= 1.0:
            schur[block, block] *= min(modulus**-2, STABILISED_MODULUS / modulus)
            moved += 1 + pair
        first = block.stop
    return (basis @ schur @ basis.T, moved) if moved else (A, 0)
