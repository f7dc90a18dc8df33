"""The normalised Bouc-Wen model: an actuator's line and a bounded hysteretic part."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check
from .bouc_wen import BoucWen, BoucWenState
from .inverse import Inverse, InverseHysteresis
from .loading import loaded
from .model import Hysteresis

SCHEMES = ("runge_kutta", "exact")


class NormalisedBoucWenState(NamedTuple):
    """Last input x (V) and internal state w, from -1 to 1."""

    input: Scalar
    memory: Scalar


class NormalisedBoucWen(Hysteresis):
    """``y = k_x x + k_w w``: a straight line and a bounded part with hysteresis.

    ``w' = rho (x' - sigma |x'| |w|^(n-1) w + (sigma - 1) x' |w|^n)``, (2.5) with its
    symbols set right: as printed w is called the input and the second line is headed by
    x'. Here x is the input in V, w the internal state without unit, which stays within
    -1 and 1, and y the output Phi in um. ``k_x`` in um/V, ``k_w`` in um, ``rho`` in
    1/V, above 0; ``sigma`` above 0.5; ``n``, at least 1 and not only whole, is how
    sharply the loop bends. w is the force of a classical Bouc-Wen model,
    ``classical()``. Source: Ikhouane and Rodellar, Systems with Hysteresis, 2007.

    With ``k_w > 0``, which (2.5) asks for, loops run clockwise, as a force over a
    displacement does: the sign of a spring that dissipates. A piezo's displacement lags
    behind its voltage, counter-clockwise: ``k_w < 0`` (Low and Guo 1995). The material
    starts on its virgin curve from ``rest_input`` (V), where w = 0.

    ``scheme`` is ``"runge_kutta"``, fourth order in the input step except where w
    changes its sign, parted by ``substeps``; or ``"exact"``, the closed form on every
    monotone branch, for n = 1. Loops close in the limit of many cycles only: there is
    no return-point memory, no wiping-out and no congruency, and w drifts when a partial
    unloading is repeated.

    Inverse: InverseHysteresis. y rises with x on every branch, so that one exists, if
    and only if ``k_x > 0`` and ``k_x + 2 sigma rho k_w > 0``, the slope that is left
    just after a turn at w = 1 or -1.

    Raises ValueError for numbers outside these bounds, an unknown scheme, or "exact"
    with another n.
    """

    before: ClassVar[str | None] = "rest_input"

    k_x: Scalar = eqx.field(converter=as_array)
    k_w: Scalar = eqx.field(converter=as_array)
    rho: Scalar = eqx.field(converter=as_array)
    sigma: Scalar = eqx.field(converter=as_array)
    n: Scalar = eqx.field(converter=as_array, default=1.0)
    rest_input: Scalar = eqx.field(converter=as_array, default=0.0)
    scheme: str = eqx.field(static=True, default="runge_kutta")
    substeps: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        check("k_x in um/V", self.k_x)
        check("k_w in um", self.k_w)
        check("rho in 1/V", self.rho, above=0.0)
        check("sigma", self.sigma, above=0.5)
        check("n", self.n, least=1.0)
        check("rest_input in V", self.rest_input)
        check("substeps", self.substeps, least=1.0)
        if self.scheme not in SCHEMES:
            raise ValueError(
                f"scheme {self.scheme!r}; it must be one of {list(SCHEMES)}"
            )
        if self.scheme == "exact":
            check("n of the scheme 'exact'", self.n, least=1.0, most=1.0)

    def classical(self) -> BoucWen:
        """Return the Bouc-Wen model whose displacement is x and whose force is w."""
        return BoucWen(
            alpha=self.rho,
            beta_gamma=self.rho * self.sigma,
            beta_delta=self.rho * (1.0 - self.sigma),
            nu=self.n,
            substeps=self.substeps,
        )

    def init(self, input: ScalarLike = 0.0) -> NormalisedBoucWenState:
        virgin = NormalisedBoucWenState(self.rest_input, jnp.zeros(()))
        return loaded(self, virgin, as_array(input))

    def step(
        self, state: NormalisedBoucWenState, input: ScalarLike
    ) -> tuple[NormalisedBoucWenState, Scalar]:
        input = as_array(input)
        if self.scheme == "exact":
            memory = self._branch(state.memory, input - state.input)
        else:
            before = BoucWenState(state.input, state.memory)
            memory = self.classical().step(before, input)[1]
        output = self.k_x * input + self.k_w * memory
        return NormalisedBoucWenState(input, memory), output

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)

    def _branch(self, memory: Scalar, change: Scalar) -> Scalar:
        """Return w after ``change`` (V), n = 1: unloading to w = 0, then loading.

        With v = w in the direction of x: v' = rho (1 - kappa v) below 0, where
        kappa = 2 sigma - 1, and rho (1 - v) above.
        """
        direction = jnp.where(change >= 0.0, 1.0, -1.0)
        distance, v = direction * change, direction * memory
        kappa = 2.0 * self.sigma - 1.0
        below, above = jnp.where(v < 0.0, v, 0.0), jnp.where(v < 0.0, 0.0, v)
        to_zero = jnp.log1p(-kappa * below) / (self.rho * kappa)
        unloads = distance < to_zero
        relaxed = -self.rho * kappa * distance
        unloaded = below * jnp.exp(relaxed) - jnp.expm1(relaxed) / kappa
        relaxed = -self.rho * jnp.where(unloads, 0.0, distance - to_zero)
        reloaded = above * jnp.exp(relaxed) - jnp.expm1(relaxed)
        return direction * jnp.where(unloads, unloaded, reloaded)
