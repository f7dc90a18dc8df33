"""Preview inverses: inputs that make a model follow a reference known in advance.

A zero outside the unit circle makes the exact causal inverse unstable. An inverse that
uses future values of the reference can be stable. These inverses act on a whole
reference before the loop runs; the result is an open-loop input or the reference of a
loop. Inside a loop the references beyond r(k+1) are extrapolated.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import Scalar, ScalarLike, State, as_array, as_scalars, check
from ..core.parameter import parameter
from ..core.rollout import simulate
from ..core.system import System
from ..dynamics.arma import ARMA


class PreviewInverse(eqx.Module):
    """Inverse of a model: a weighted sum of future references, then ``causal``.

    The model (a_1, ... | b_0, ...) maps u(k) to y(k+1), as in a loop.
    ``w(k) = sum_j weights[j] r(k + 1 + delay + j)``, and ``causal`` maps w to u. The
    output holds one input for each sample of the reference, in the unit of the model's
    input. The start is bumpless: before the first sample, reference and input are taken
    as constant. After its last sample the reference is taken as constant, too. Compile
    the inverse with ``eqx.filter_jit``.
    """

    causal: ARMA
    weights: Float[Array, " taps"] = eqx.field(converter=as_array)
    delay: int = eqx.field(static=True)

    @property
    def preview(self) -> int:
        """Number of samples of the reference used beyond sample k."""
        return self.delay + self.weights.size

    def extrapolated(self) -> "ExtrapolatedInverse":
        """Return the inverse for use inside a loop."""
        return ExtrapolatedInverse(self.causal, tuple(self.weights), self.delay)

    def __call__(self, reference: Float[Array, " samples"]) -> Float[Array, " samples"]:
        """Return u(k) for a ``reference`` r(k) in um."""
        reference = as_array(reference)
        held = jnp.broadcast_to(reference[-1:], (self.preview,))
        ahead = jnp.concatenate([reference, held])[1 + self.delay :]
        weighted = jnp.convolve(ahead, self.weights[::-1], mode="valid")
        start = self.causal.init(jnp.sum(self.weights) * reference[0])
        return simulate(self.causal, weighted, start)[1]


class ExtrapolatedState(NamedTuple):
    """The last reference in um and the state of the causal part."""

    reference: Scalar
    causal: State


class ExtrapolatedInverse(System):
    """PreviewInverse inside a loop, which knows the reference up to r(k+1) only.

    The references beyond r(k+1) are those of the line through r(k) and r(k+1), so that
    the few samples that the inverse looks ahead need not be known. At j samples beyond
    r(k+1) the error is a T^2 j (j + 1) / 2 for a reference with the constant
    acceleration a and the sample time T. The System serves as the ``inverse`` of an
    ``InverseFeedforward`` or a ``FeedforwardFeedback``, alone or in series with an
    inverse hysteresis. Input r(k+1) in um, output in the unit of the model's input.
    ``weights``, ``delay`` and ``causal`` as in ``PreviewInverse``.
    """

    causal: ARMA
    weights: tuple[Scalar, ...] = parameter(
        "1", "weights of the references ahead", converter=as_scalars
    )
    delay: int = parameter(
        "samples",
        "delay of the model",
        least=0.0,
        whole=True,
        static=True,
        default=0,
    )

    def init(self, input: ScalarLike = 0.0) -> ExtrapolatedState:
        reference = as_array(input)
        weighted = sum(self.weights) * reference
        return ExtrapolatedState(reference, self.causal.init(weighted))

    def step(
        self, state: ExtrapolatedState, input: ScalarLike
    ) -> tuple[ExtrapolatedState, Scalar]:
        reference = as_array(input)
        rise = reference - state.reference
        ahead = [
            weight * (reference + (self.delay + j) * rise)
            for j, weight in enumerate(self.weights)
        ]
        causal, output = self.causal.step(state.causal, sum(ahead[1:], ahead[0]))
        return ExtrapolatedState(reference, causal), output


def direct_inverse(model: ARMA) -> PreviewInverse:
    """Return the exact inverse, unstable for a zero outside the unit circle.

    Raises ValueError if all b are zero.
    """
    scale, b, delay = _numerator(model)
    return _inverse(model, scale, b, np.ones(1), delay)


def zero_phase_inverse(model: ARMA, margin: float = 1.0) -> PreviewInverse:
    """Return the zero-phase-error tracking controller (ZPETC; Tomizuka, 1987).

    It cancels the zeros inside the circle of radius ``margin``; of the other zeros,
    with the polynomial B_u, it cancels only the phase. The response from r to y is then
    B_u(z) B_u(1/z) / B_u(1)^2, which has zero phase at all frequencies and is 1 at
    rest, but not elsewhere. Beyond the model's delay, the inverse uses one sample of
    preview for each zero of B_u. Raises ValueError for a margin outside (0, 1], a zero
    at z = 1 or b that are all zero.
    """
    scale, stable, unstable, delay = _split(model, margin)
    at_rest = unstable.sum()
    if abs(at_rest) < 1e-9 * np.abs(unstable).sum():
        raise ValueError(
            "the model has a zero at z = 1; its gain at rest must not be 0"
        )
    return _inverse(model, scale, stable, unstable / at_rest**2, delay)


def stable_inverse(model: ARMA, preview: int) -> PreviewInverse:
    """Return the inverse whose unstable part runs backwards over ``preview`` samples.

    1 / (1 - z_i/z) for a zero |z_i| > 1 is bounded as a series in z: the sum over j of
    -(z/z_i)^(j+1), which uses future references. The series is truncated after
    ``preview`` samples beyond the model's delay; the truncated part falls as
    |z_i|^-preview of the zero nearest to the circle (preview-based stable inversion;
    Zou and Devasia, 1999). Raises ValueError unless ``preview`` exceeds the number of
    zeros outside the unit circle, for a zero on it, or b that are all zero.
    """
    scale, stable, unstable, delay = _split(model, 1.0)
    zeros = np.roots(unstable)
    if np.any(np.abs(zeros) < 1.0 + 1e-9):
        raise ValueError(
            "the model has a zero on the unit circle; it has no bounded inverse"
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
    return _inverse(model, scale, stable, weights, delay)


INVERSES: dict[str, Callable[..., PreviewInverse]] = {
    "direct": direct_inverse,
    "zero_phase": zero_phase_inverse,
    "stable": stable_inverse,
}
"""Inverses of a model by name."""


def _numerator(model: ARMA) -> tuple[float, np.ndarray, int]:
    """Return the first nonzero b, all b from there divided by it, and its index."""
    b = np.trim_zeros(np.array([float(x) for x in model.moving]), "b")
    if b.size == 0:
        raise ValueError("all b of the model are 0; at least one must not be 0")
    delay = int(np.flatnonzero(b)[0])
    return float(b[delay]), b[delay:] / b[delay], delay


def _split(model: ARMA, margin: float) -> tuple[float, np.ndarray, np.ndarray, int]:
    """Return scale, polynomials of zeros inside and outside ``margin``, and delay."""
    check("margin", margin, above=0.0, most=1.0)
    scale, b, delay = _numerator(model)
    zeros = np.roots(b)
    inside = np.abs(zeros) < margin
    stable, unstable = (
        np.real(np.poly(part)) for part in (zeros[inside], zeros[~inside])
    )
    return scale, np.atleast_1d(stable), np.atleast_1d(unstable), delay


def _inverse(
    model: ARMA, scale: float, stable: np.ndarray, weights: np.ndarray, delay: int
) -> PreviewInverse:
    """Return the inverse A / (scale B_s) of the references weighted by ``weights``."""
    a = [1.0, *(-float(x) for x in model.autoregressive)]
    causal = ARMA([-x for x in stable[1:]], [x / scale for x in a])
    return PreviewInverse(causal, weights, delay)
