"""Normalised Bouc-Wen model: a straight line and a bounded hysteretic part."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check
from ..core.parameter import parameter
from ..core.recipe import (
    Extent,
    Fittable,
    Part,
    Recipe,
    rest_bounds,
    rest_starts,
    scaled_range,
)
from ..core.runge_kutta import parts_of_a_step
from ..core.space import Range
from .bouc_wen import BoucWen, BoucWenState
from .inverse import Inverse, InverseHysteresis
from .loading import load_to
from .model import Hysteresis, Laws, differential_laws

SCHEMES = ("runge_kutta", "exact")


class NormalisedBoucWenState(NamedTuple):
    """Last input x (V) and internal state w, from -1 to 1."""

    input: Scalar
    memory: Scalar


class NormalisedBoucWen(Hysteresis, Fittable):
    """``y = k_x x + k_w w``: a straight line and a bounded part with hysteresis.

    ``w' = rho (x' - sigma |x'| |w|^(n-1) w + (sigma - 1) x' |w|^n)``, (2.5) with
    corrected symbols: the print calls w the input and begins the second line with x'.
    Here x is the input in V, w the internal state without unit, between -1 and 1, and y
    the output Phi in um; n need not be whole. w is the force of the classical Bouc-Wen
    model ``classical()``. Source: Ikhouane and Rodellar, Systems with Hysteresis, 2007.

    With ``k_w > 0``, as (2.5) requires, loops run clockwise, as for a dissipating force
    over a displacement. The displacement of a piezo lags its voltage, so that its loops
    run counter-clockwise; this needs ``k_w < 0`` (Low and Guo 1995). The material
    starts on its virgin curve from ``rest_input`` (V), where w = 0.

    ``scheme`` is ``"runge_kutta"``, with ``substeps`` parts per step, of fourth order
    except where w changes sign; or ``"exact"``, the closed form on every monotone
    branch, for n = 1. Loops close only in the limit of many cycles: there is no
    return-point memory, no wiping-out and no congruency, and w drifts under repeated
    partial unloading.

    The inverse is InverseHysteresis. It exists if and only if y rises with x on every
    branch: ``k_x > 0`` and ``k_x + 2 sigma rho k_w > 0``, the slope just after a turn
    at w = 1 or -1.

    Raises ValueError for parameters outside their limits, an unknown scheme, or "exact"
    with n other than 1.
    """

    laws: ClassVar[Laws] = differential_laws()
    part: ClassVar[Part] = Part(
        "normalised_bouc_wen",
        "hysteresis",
        "Normalised Bouc-Wen: a line and a bounded part, y = k_x x + k_w w",
    )

    k_x: Scalar = parameter("um/V", "slope of the line")
    k_w: Scalar = parameter("um", "height of the hysteretic part")
    rho: Scalar = parameter("1/V", "slope of w from w = 0", above=0.0)
    sigma: Scalar = parameter("1", "share of the |x'| term in the bend", above=0.5)
    n: Scalar = parameter("1", "sharpness of the bend", least=1.0, default=1.0)
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)
    scheme: str = eqx.field(static=True, default="runge_kutta")
    substeps: int = parts_of_a_step()

    def __check_init__(self):
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
        return load_to(self, virgin, as_array(input))

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

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        width, slope = extent.width, extent.slope
        return Recipe(
            # The displacement lags the voltage if k_w and k_x have opposite signs.
            cls(
                k_x=1.1 * slope,
                k_w=-0.1 * slope * width,
                rho=5.0 / width,
                sigma=1.0,
                n=1.5,
                rest_input=extent.first[0],
            ),
            {
                "k_x": scaled_range(slope, 0.0, 3.0),
                "k_w": scaled_range(slope * width, -1.0, 1.0),
                "rho": Range(0.3 / width, 100.0 / width, "log"),
                "sigma": Range(0.51, 20.0, "log"),
                "n": Range(1.0, 5.0),
                **rest_bounds(extent),
            },
            [
                {"rho": steep / width, "n": bend, **before}
                for steep in (2.0, 8.0)
                for bend in (1.2, 2.0)
                for before in rest_starts(extent)
            ],
            gain="k_x",
            own=("rest_input",),
        )

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
