"""The linear plant of a limit: the stage linearised, with the gain that it shows."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import Scalar, ScalarLike, as_array
from ...core.rollout import simulate
from ...core.system import Feedback, System
from ...dynamics import StateSpace
from ...dynamics.linearise import linearise
from ..stability.conserved import LinearLoop, without_conserved

_CHUNK = 2048  # points of the circle at a time: few states, little memory
_ROUNDS = 8
_NOTHING = 1e-12
_ON_CIRCLE = 1e-6


class LinearPlant(System):
    """``y = output + C x + D (u - input)``, ``x`` at rest under the voltage ``input``.

    A [n, n], B [n], C [n], D in um/V; ``input`` in V, ``output`` in um. A step returns
    y(k+1) for u(k), as a plant in a loop does.
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
        """Return y over u [points] around the unit circle, the loop's sample too."""
        A, B, C, D = (np.asarray(x) for x in (self.A, self.B, self.C, self.D))
        z = np.exp(2j * np.pi * np.arange(points) / points)
        eye = np.eye(len(A))
        states = [
            np.linalg.solve(part[:, None, None] * eye - A, B[:, None] + 0j)[..., 0] @ C
            for part in np.array_split(z, -(-points // _CHUNK))
        ]
        return (np.concatenate(states) + D) / z

    def obstacles(self) -> tuple[int, np.ndarray]:
        """Return what no controller gets around: the delay, and the zeros outside.

        The delay is in samples, with the loop's own; the zeros are those in the z plane
        outside the unit circle. One on the circle costs nothing.
        """
        A, B, C, D = (np.asarray(x) for x in (self.A, self.B, self.C, self.D))
        delay, first = 1, float(D)
        size = abs(first) + np.linalg.norm(C) * np.linalg.norm(B)
        # Look ahead until the input shows: the zeros are then those of C, D.
        while abs(first) <= _NOTHING * size and delay <= len(A):
            delay, first, C = delay + 1, float(C @ B), C @ A
        if abs(first) <= _NOTHING * size:
            raise ValueError("the voltage does not move the linearised plant")
        zeros = np.linalg.eigvals(A - np.outer(B, C) / first)
        return delay, zeros[np.abs(zeros) > 1.0 + _ON_CIRCLE]


def linear_plant(loop: Feedback, reference: ScalarLike, dt: float) -> LinearPlant:
    """Return the plant of ``loop`` linearised at rest at ``reference`` (um).

    What it only remembers, such as where on its branch a hysteresis is, is taken out;
    ``dt`` in s. Raises ValueError for several axes and for a plant that is not stable.
    """

    model = _derivatives(loop, as_array(reference), dt)
    A, B, C, D = (np.asarray(matrix) for matrix in (model.A, model.B, model.C, model.D))
    if D.shape != (1, 1):
        raise ValueError("the limit is known for one axis only")
    if not all(np.all(np.isfinite(matrix)) for matrix in (A, B, C, D)):
        raise ValueError("the plant's derivatives are not finite")
    found = LinearLoop(A, B[:, 0], C[0], dt)
    # Of a chain of integrators nothing moves, one is seen at a time.
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


def answers(plant: LinearPlant, voltage: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return what ``plant`` does [runs, samples] under ``voltage``, from 0 um.

    It rests under the voltages ``rest`` [runs] before; sample k + 1 answers voltage k.
    """

    moved = np.asarray(_answers(plant, voltage, rest))
    return np.concatenate([np.zeros((len(moved), 1)), moved[:, :-1]], axis=1)


@jax.jit
def _answers(plant: LinearPlant, voltage: jax.Array, rest: jax.Array) -> jax.Array:
    def one(voltage, rest):
        resting = plant.at(rest, 0.0)
        return simulate(resting, voltage, resting.init(rest))[1]

    return jax.vmap(one)(voltage, rest)


def felt_gain(answer: np.ndarray, displacement: np.ndarray, noise: np.ndarray) -> float:
    """Return the gain with which the stage answers what noise makes of the voltage.

    All are transforms [..., lines]: of what a plant of gain 1 does under the voltage,
    of the stage's displacement and of the sensor's noise, the first two without what
    the reference foretells. The noise is the instrument: what is left of the
    displacement then has nothing to do with it, as a disturbance must not. Lines count
    by how quiet it is there, in rounds. A hysteresis answers small fast motions less
    than large slow ones; the large are foretold, feedback is about the small. Raises
    ValueError if there is no positive gain.
    """
    runs = tuple(range(answer.ndim - 1))
    driven = np.mean(answer * np.conj(noise), axis=runs)
    moved = np.mean(displacement * np.conj(noise), axis=runs)
    # The spectrum of what is left is a parabola in the gain, line by line.
    own = np.mean(np.abs(displacement) ** 2, axis=runs)
    both = np.mean(np.real(displacement * np.conj(answer)), axis=runs)
    other = np.mean(np.abs(answer) ** 2, axis=runs)
    gain = 0.0
    for _ in range(_ROUNDS):
        left = own - 2.0 * gain * both + gain**2 * other
        weight = 1.0 / np.maximum(left, np.finfo(float).tiny)
        power = np.sum(weight * np.abs(driven) ** 2)
        if power == 0.0:
            break
        gain = np.sum(weight * np.real(np.conj(driven) * moved)) / power
    if not (np.isfinite(gain) and gain > 0.0):
        raise ValueError("the stage does not move as its linear model does")
    return float(gain)
