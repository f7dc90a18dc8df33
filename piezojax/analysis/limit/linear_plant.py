"""Linear plant of a limit: the linearised stage with the gain fitted to its runs."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import Scalar, ScalarLike, as_array
from ...core.feedback import Feedback
from ...core.rollout import simulate
from ...core.system import System
from ...dynamics import StateSpace
from ...dynamics.linearise import linearise
from ..stability.conserved import LinearLoop, without_conserved

_CHUNK = 2048  # points of the circle at a time, to bound the memory
_ROUNDS = 8
_NOTHING = 1e-12
_ON_CIRCLE = 1e-6


class LinearPlant(System):
    """Linear plant ``x+ = A x + B (u - input)``, ``y = output + C x + D (u - input)``.

    The plant rests at ``output`` (um) under the voltage ``input`` (V). A [n, n], B [n],
    C [n], D in um/V. A step returns y(k+1) for u(k), as every plant in a loop does.
    """

    A: Float[Array, "n n"] = eqx.field(converter=as_array)
    B: Float[Array, " n"] = eqx.field(converter=as_array)
    C: Float[Array, " n"] = eqx.field(converter=as_array)
    D: Scalar = eqx.field(converter=as_array)
    input: Scalar = eqx.field(converter=as_array, default=0.0)
    output: Scalar = eqx.field(converter=as_array, default=0.0)

    def init(self, input: ScalarLike = 0.0) -> Float[Array, " n"]:
        forcing = self.B * (as_array(input) - self.input)
        return jnp.linalg.solve(jnp.eye(len(self.A)) - self.A, forcing)

    def step(
        self, state: Float[Array, " n"], input: ScalarLike
    ) -> tuple[Float[Array, " n"], Scalar]:
        moved = as_array(input) - self.input
        displacement = self.output + self.C @ state + self.D * moved
        return self.A @ state + self.B * moved, displacement

    def at(self, input: ScalarLike, output: ScalarLike) -> "LinearPlant":
        """Return the plant that rests at ``output`` (um) under ``input`` (V)."""
        return LinearPlant(self.A, self.B, self.C, self.D, input, output)

    def scaled(self, gain: ScalarLike) -> "LinearPlant":
        """Return the plant with ``gain`` times the response."""
        C, D = gain * self.C, gain * self.D
        return LinearPlant(self.A, self.B, C, D, self.input, self.output)

    def response(self, points: int) -> np.ndarray:
        """Return y/u [points] on the unit circle, with the loop's unit delay."""
        A, B, C, D = (np.asarray(x) for x in (self.A, self.B, self.C, self.D))
        z = np.exp(2j * np.pi * np.arange(points) / points)
        eye = np.eye(len(A))
        states = [
            np.linalg.solve(part[:, None, None] * eye - A, B[:, None] + 0j)[..., 0] @ C
            for part in np.array_split(z, -(-points // _CHUNK))
        ]
        return (np.concatenate(states) + D) / z

    def delay_and_zeros(self) -> tuple[int, np.ndarray]:
        """Return the delay (samples) and the zeros outside the unit circle.

        Both limit every controller. The delay includes the loop's own sample. The zeros
        are in the z plane; zeros on the circle cost nothing and are left out. Raises
        ValueError if the voltage does not move the plant.
        """
        A, B, C, D = (np.asarray(x) for x in (self.A, self.B, self.C, self.D))
        delay, first = 1, float(D)
        size = abs(first) + np.linalg.norm(C) * np.linalg.norm(B)
        # Advance y until u acts on it directly: the zeros are those of this C and D.
        while abs(first) <= _NOTHING * size and delay <= len(A):
            delay, first, C = delay + 1, float(C @ B), C @ A
        if abs(first) <= _NOTHING * size:
            raise ValueError("the voltage does not move the linearised plant")
        zeros = np.linalg.eigvals(A - np.outer(B, C) / first)
        return delay, zeros[np.abs(zeros) > 1.0 + _ON_CIRCLE]


def linear_plant(loop: Feedback, reference: ScalarLike, dt: float) -> LinearPlant:
    """Return the plant of ``loop`` linearised at rest at ``reference`` (um).

    Conserved modes, such as the position of a hysteresis on its branch, are removed.
    ``dt`` in s. Raises ValueError for several axes, derivatives that are not finite,
    and a plant that is not stable.
    """

    model = _derivatives(loop, as_array(reference), dt)
    A, B, C, D = (np.asarray(matrix) for matrix in (model.A, model.B, model.C, model.D))
    if D.shape != (1, 1):
        raise ValueError("the limit is known for one axis only")
    if not all(np.all(np.isfinite(matrix)) for matrix in (A, B, C, D)):
        raise ValueError("the plant's derivatives are not finite")
    found = LinearLoop(A, B[:, 0], C[0], dt)
    # A chain of integrators that no input moves shows one conserved mode at a time.
    while len(found.A):
        fewer = without_conserved(found)
        if len(fewer.A) == len(found.A):
            break
        found = fewer
    poles = np.linalg.eigvals(found.A) if len(found.A) else np.zeros(0)
    if np.any(np.abs(poles) >= 1.0):
        raise ValueError(
            f"the linearised plant has a pole of modulus {np.abs(poles).max():.6g}; "
            "the limit is known for stable plants"
        )
    return LinearPlant(found.A, found.B, found.C, D[0, 0])


@partial(jax.jit, static_argnums=2)
def _derivatives(loop: Feedback, reference: jax.Array, dt: float) -> StateSpace:
    start = loop.init(reference)
    return linearise(loop.plant, start.voltage, start.plant, dt)


def plant_response(
    plant: LinearPlant, voltage: np.ndarray, rest: np.ndarray
) -> np.ndarray:
    """Return the response (um) of ``plant`` to ``voltage`` (V), both [runs, samples].

    The plant starts at rest at 0 um under the voltages ``rest`` [runs]; sample k + 1 is
    the response to voltage k.
    """

    moved = np.asarray(_responses(plant, voltage, rest))
    return np.concatenate([np.zeros((len(moved), 1)), moved[:, :-1]], axis=1)


@jax.jit
def _responses(plant: LinearPlant, voltage: jax.Array, rest: jax.Array) -> jax.Array:
    def one(voltage, rest):
        resting = plant.at(rest, 0.0)
        return simulate(resting, voltage, resting.init(rest))[1]

    return jax.vmap(one)(voltage, rest)


def gain_from_noise(
    response: np.ndarray, displacement: np.ndarray, noise: np.ndarray
) -> float:
    """Return the gain of the stage relative to a linear plant.

    The gain is that for voltage caused by sensor noise. All arguments are transforms
    [..., lines]. ``response`` is that of the linear plant to the voltage and
    ``displacement`` that of the stage, both without the part that the reference
    predicts; ``noise`` is the sensor's.

    The gain is an instrumental-variable estimate with the noise as instrument: the
    residual displacement is then uncorrelated with the noise, as a disturbance must be.
    Lines are weighted by 1 / (power of the residual), updated in each iteration. A
    hysteresis responds less to small fast motions than to large slow ones. The
    reference predicts the large ones; feedback acts on the small ones, so the gain is
    estimated from these. Raises ValueError if the estimate is not positive.
    """
    runs = tuple(range(response.ndim - 1))
    driven = np.mean(response * np.conj(noise), axis=runs)
    moved = np.mean(displacement * np.conj(noise), axis=runs)
    # The spectrum of the residual is a quadratic function of the gain on each line.
    own = np.mean(np.abs(displacement) ** 2, axis=runs)
    both = np.mean(np.real(displacement * np.conj(response)), axis=runs)
    other = np.mean(np.abs(response) ** 2, axis=runs)
    gain = 0.0
    for _ in range(_ROUNDS):
        left = own - 2.0 * gain * both + gain**2 * other
        weight = 1.0 / np.maximum(left, np.finfo(float).tiny)
        # Signals of an unstable loop may overflow: the gain is then not a number.
        with np.errstate(over="ignore", invalid="ignore"):
            power = np.sum(weight * np.abs(driven) ** 2)
            if power == 0.0:
                break
            gain = np.sum(weight * np.real(np.conj(driven) * moved)) / power
    if not (np.isfinite(gain) and gain > 0.0):
        raise ValueError("the stage does not move as its linear model does")
    return float(gain)
