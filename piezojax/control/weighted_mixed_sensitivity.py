"""H-infinity control whose weights are parameters, so that they can be tuned."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.arrays import Scalar
from ..core.parameter import parameter, sample_time
from ..core.system import Designed
from ..dynamics.arma import ARMA
from ..dynamics.state_space import StateSpace
from .riccati import riccati
from .state_space_controller import StateSpaceController


class WeightedMixedSensitivity(Designed):
    """Central H-infinity controller, with its weights and its bound as parameters.

    ``model`` G maps u(k) to y(k+1) in um. At all frequencies |W1 S|^2 + |W2 K S|^2 <
    bound^2, with S = 1/(1 + G K). W1 has the gain ``low`` at 0, 1 at ``crossover`` and
    ``high`` above it; W2 = ``effort_weight``. For the smallest bound that a controller
    meets this is the design of ``mixed_sensitivity``; a larger bound approaches the H2
    design. If no controller meets the bound, the matrices are NaN and the loop
    diverges.

    The Riccati equation is solved by the doubling algorithm (Chu, Fan and Lin, 2005),
    which can be differentiated. Input an Observation, output in the unit of u. Raises
    ValueError for parameters outside their limits.
    """

    model: ARMA
    low: Scalar = parameter(
        "1", "gain of W1 at 0", above=1.0, scale="log", typical=(1e1, 1e5)
    )
    crossover: Scalar = parameter(
        "rad/s",
        "frequency at which the gain of W1 is 1",
        above=0.0,
        below_nyquist=True,
        scale="log",
        typical=(1e1, 1e4),
    )
    high: Scalar = parameter(
        "1",
        "gain of W1 at high frequencies",
        above=0.0,
        below=1.0,
        scale="log",
        typical=(1e-2, 0.95),
    )
    effort_weight: Scalar = parameter(
        "um/[u]",
        "weight W2 of the command",
        above=0.0,
        scale="log",
        typical=(1e-4, 1e1),
    )
    bound: Scalar = parameter(
        "1",
        "bound of the weighted responses",
        above=0.0,
        scale="log",
        typical=(0.1, 1e3),
    )
    dt: float = sample_time()

    def resolved(self) -> StateSpaceController:
        """Return the central controller with its matrices."""
        plant = _augmented(self)
        A, B, C, D, measured = plant
        R = D.T @ D - jnp.diag(jnp.stack([self.bound**2, jnp.zeros(())]))
        X, left = _riccati(plant, R)
        S = R + B.T @ X @ B
        # Saddle-point conditions: a minimum over u and a maximum over w.
        keeps = (
            (S[1, 1] > 0.0)
            & (S[0, 0] - S[0, 1] ** 2 / S[1, 1] < 0.0)
            & (left < 1e-6)
            & (jnp.linalg.eigvalsh(jax.lax.stop_gradient(X))[0] > -1e-8 * jnp.max(X))
        )
        cross = B.T @ X @ A + D.T @ C
        # u = F x + f w, where w = y + measured x and the controller simulates x.
        F, f = -cross[1:] / S[1, 1], -S[1, 0] / S[1, 1]
        F = jnp.where(keeps, F + f * measured, jnp.nan)
        inner = A + B[:, :1] @ measured + B[:, 1:] @ F
        law = StateSpace(inner, B[:, :1] + f * B[:, 1:], F, f[None, None], self.dt)
        return StateSpaceController(law)


class _Plant(NamedTuple):
    """Generalised plant x' = A x + B [w, u], z = C x + D [w, u], y = w - measured x."""

    A: Float[Array, "n n"]
    B: Float[Array, "n 2"]
    C: Float[Array, "2 n"]
    D: Float[Array, "2 2"]
    measured: Float[Array, "1 n"]


def _augmented(control: WeightedMixedSensitivity) -> _Plant:
    """Return the generalised plant with the states of the model and of W1."""
    a, b = control.model.autoregressive, control.model.moving
    n = max(len(a), len(b))
    # W1 = (high s + low p) / (s + p), s = (z - 1) / (z + 1) warped at the crossover.
    warped = jnp.tan(0.5 * control.crossover * control.dt)
    p = warped * jnp.sqrt((1.0 - control.high**2) / (control.low**2 - 1.0))
    pole = (1.0 - p) / (1.0 + p)
    direct = (control.high + control.low * p) / (1.0 + p)
    through = control.low * (1.0 - pole) - direct * (1.0 - pole)
    y = jnp.eye(1, n + 1)
    A = jnp.zeros((n + 1, n + 1)).at[:n, :n].set(jnp.eye(n, k=1))
    A = A.at[: len(a), 0].add(jnp.stack(a)).at[n].set(-y[0]).at[n, n].set(pole)
    B = jnp.zeros((n + 1, 2)).at[: len(b), 1].set(jnp.stack(b)).at[n, 0].set(1.0)
    C = jnp.zeros((2, n + 1)).at[0].set(-direct * y[0]).at[0, n].set(through)
    return _Plant(A, B, C, jnp.diag(jnp.stack([direct, control.effort_weight])), y)


def _riccati(
    plant: _Plant, R: Float[Array, "2 2"]
) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """Return the stabilising solution X, and a residual near 0 if X exists."""
    A, B, C, D, _ = plant
    cross = C.T @ D
    part = jnp.linalg.solve(R, cross.T)
    return riccati(A - B @ part, B @ jnp.linalg.solve(R, B.T), C.T @ C - cross @ part)
