"""Inputs that make a model follow a reference that is known ahead of time.

A zero outside the unit circle makes the exact inverse unstable, but only forwards in
time: who knows the reference ahead can do better. These work on a whole reference
before the loop runs, as an input of their own or in front of a closed loop.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import as_array, check
from ..core.rollout import simulate
from ..dynamics.arma import ARMA


class PreviewInverse(eqx.Module):
    """u = ``causal`` applied to the weighted references ahead: arrays to arrays.

    The model (a_1, ... | b_0, ...) answers u(k) with y(k+1), as in a loop;
    ``w(k) = sum_j weights[j] r(k + 1 + delay + j)`` and ``causal`` turns w into u. Out
    comes one input for each sample of the reference, in the unit of the model's input.
    The reference rests before its first and after its last sample, and so does the
    input before the first: a bumpless start. Compile it with ``eqx.filter_jit``.
    """

    causal: ARMA
    weights: Float[Array, " taps"] = eqx.field(converter=as_array)
    delay: int = eqx.field(static=True)

    @property
    def preview(self) -> int:
        """How many samples ahead of k the reference is used."""
        return self.delay + self.weights.size

    def __call__(self, reference: Float[Array, " samples"]) -> Float[Array, " samples"]:
        """Return u(k) for a ``reference`` r(k) in um."""
        reference = as_array(reference)
        held = jnp.broadcast_to(reference[-1:], (self.preview,))
        ahead = jnp.concatenate([reference, held])[1 + self.delay :]
        weighted = jnp.convolve(ahead, self.weights[::-1], mode="valid")
        start = self.causal.init(jnp.sum(self.weights) * reference[0])
        return simulate(self.causal, weighted, start)[1]


def direct_inverse(model: ARMA) -> PreviewInverse:
    """Return the exact inverse: unstable if a zero of ``model`` is.

    Raises ValueError if all b are zero.
    """
    scale, b, delay = _numerator(model)
    return _over(model, scale, b, np.ones(1), delay)


def zero_phase_inverse(model: ARMA, margin: float = 1.0) -> PreviewInverse:
    """Return the zero-phase-error tracking controller (ZPETC; Tomizuka, 1987).

    Zeros inside the circle of radius ``margin`` are cancelled; of the others, B_u, the
    phase is: with this input y follows r through B_u(z) B_u(1/z) / B_u(1)^2, which has
    no phase at any frequency and is 1 at rest. The gain elsewhere is not 1. Uses one
    sample of preview for each such zero beyond the model's own delay. Raises ValueError
    for a margin outside (0, 1], a zero at z = 1 or b that are all zero.
    """
    scale, stable, unstable, delay = _split(model, margin)
    at_rest = unstable.sum()
    if abs(at_rest) < 1e-9 * np.abs(unstable).sum():
        raise ValueError("the model has a zero at z = 1; it must pass a reference")
    return _over(model, scale, stable, unstable / at_rest**2, delay)


def stable_inverse(model: ARMA, preview: int) -> PreviewInverse:
    """Return the inverse whose unstable part runs backwards, cut off after ``preview``.

    1 / (1 - z_i/z) for a zero |z_i| > 1 is bounded as a series in z: the sum over j of
    -(z/z_i)^(j+1), which takes the reference ahead of time. What is cut off falls as
    |z_i|^-preview, of the zero nearest to the circle (preview-based stable inversion;
    Zou and Devasia, 1999). ``preview`` counts the samples beyond the model's own
    delay. Raises ValueError unless there are more of them than zeros outside the unit
    circle, for a zero on it, or b that are all zero.
    """
    scale, stable, unstable, delay = _split(model, 1.0)
    zeros = np.roots(unstable)
    if np.any(np.abs(zeros) < 1.0 + 1e-9):
        raise ValueError(
            "the model has a zero on the unit circle; no inverse of it is bounded"
        )
    order = len(zeros)
    check("preview in samples", preview, least=order + 1.0)
    # 1 / B_u(1/z) = z^m / (u_0 z^m + ... + u_m): a division of power series in z.
    ahead = unstable[::-1]
    weights = np.zeros(preview)
    weights[order] = 1.0 / ahead[0]
    for j in range(order + 1, preview):
        past = weights[j - order : j][::-1]
        weights[j] = -(ahead[1:] @ past) / ahead[0]
    return _over(model, scale, stable, weights, delay)


INVERSES: dict[str, Callable[..., PreviewInverse]] = {
    "direct": direct_inverse,
    "zero_phase": zero_phase_inverse,
    "stable": stable_inverse,
}
"""Inverses of a model by name."""


def _numerator(model: ARMA) -> tuple[float, np.ndarray, int]:
    """Return the first b that is not zero, b over it, and how many went before."""
    b = np.trim_zeros(np.array([float(x) for x in model.moving]), "b")
    if b.size == 0:
        raise ValueError("all b of the model are 0; one must be another number")
    delay = int(np.flatnonzero(b)[0])
    return float(b[delay]), b[delay:] / b[delay], delay


def _split(model: ARMA, margin: float) -> tuple[float, np.ndarray, np.ndarray, int]:
    """Return scale, the factor of zeros inside ``margin``, of the others, and delay."""
    check("margin", margin, above=0.0, most=1.0)
    scale, b, delay = _numerator(model)
    zeros = np.roots(b)
    inside = np.abs(zeros) < margin
    stable, unstable = (
        np.real(np.poly(part)) for part in (zeros[inside], zeros[~inside])
    )
    return scale, np.atleast_1d(stable), np.atleast_1d(unstable), delay


def _over(
    model: ARMA, scale: float, stable: np.ndarray, weights: np.ndarray, delay: int
) -> PreviewInverse:
    """Return A / (scale B_s), behind ``weights`` on the reference ahead."""
    a = [1.0, *(-float(x) for x in model.autoregressive)]
    causal = ARMA([-x for x in stable[1:]], [x / scale for x in a])
    return PreviewInverse(causal, weights, delay)
