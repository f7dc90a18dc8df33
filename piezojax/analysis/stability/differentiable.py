"""The same figures as functions that JAX can differentiate and compile."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ...core.arrays import as_signal
from ...core.system import Feedback, LoopState
from .broken_loop import open_loop


def loop_response(
    loop: Feedback,
    frequency: Float[Array, " lines"],
    reference: Any = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
) -> Complex[Array, " lines *axes"]:
    """Return L at ``frequency`` (Hz, above 0 and up to the Nyquist frequency).

    With several axes L is a matrix at each.

    Other arguments and errors as for ``open_loop``.
    """
    model = open_loop(loop, reference, branch, state, dt)
    response = model.frequency_response(frequency)
    return response if isinstance(as_signal(reference), tuple) else response[:, 0, 0]


def sensitivity_peak(
    loop: Feedback,
    frequency: Float[Array, " lines"],
    reference: Any = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
) -> Float[Array, ""]:
    """Return the largest |1/(1+L)| at the given frequencies (Hz).

    With several axes the largest singular value, in the units of the commands.

    A lower bound of Ms that closes as the grid gets denser, and a bound on it for a
    stable loop only: have an eye on ``closed_loop_poles`` too. Other arguments and
    errors as for ``open_loop``.
    """
    response = open_loop(loop, reference, branch, state, dt).frequency_response(
        frequency
    )
    returned = jnp.eye(response.shape[-1]) + response
    smallest = jnp.linalg.svd(returned, compute_uv=False)[:, -1]
    return jnp.max(1.0 / smallest)


def closed_loop_poles(
    loop: Feedback,
    reference: Any = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
) -> Complex[Array, " order"]:
    """Return the eigenvalues of the closed loop in the z plane, in no order.

    Those at z = 1 of what hysteresis remembers are among them (``StabilityReport``
    leaves them out): one for each hysteresis, in the plant or in the controller.
    Differentiable where eigenvalues are simple, on the CPU. Other arguments and errors
    as for ``open_loop``.
    """
    model = open_loop(loop, reference, branch, state, dt)
    return jnp.linalg.eigvals(model.A - model.B @ model.C)
