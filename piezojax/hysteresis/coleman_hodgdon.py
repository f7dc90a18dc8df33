"""Coleman-Hodgdon (ferromagnetic) hysteresis in four discretisations, and its
inverse."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.feedback import holding_input
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
from ..core.space import Range
from .inverse import Inverse, InverseHysteresis, check_rising
from .model import Hysteresis, Laws, differential_laws


class HysteresisState(NamedTuple):
    """Last input (V) and output (um); ``older`` is the previous pair, if needed."""

    input: Scalar
    output: Scalar
    older: tuple[Scalar, Scalar] | None = None


class ColemanHodgdon(Hysteresis, Fittable):
    """Rate-independent hysteresis ``y' = |x'| (a x + c y) + b x'``.

    Input x in V, output y in um; c is negative for a loop that closes. The material
    starts on its virgin loading curve from ``rest_input`` (V) and ``rest_output`` (um).

    ``scheme`` is one of

    - ``"trapezoid"`` (3.10)-(3.16), second order in the input step, the default;
    - ``"quadratic"`` (3.17)-(3.29), third order where turning points fall on samples;
      the trapezoid step is taken right after a turning point or a pause;
    - ``"voros"`` (2.11), explicit, first order: the earlier model of the thesis;
    - ``"exact"``, the closed form on each monotone branch.

    The memory fades along the path of the input and is not wiped out: there is no
    return-point memory, no wiping-out and no congruency, and a loop closes only after
    many cycles. Loops run counter-clockwise, as for a piezo, if a > |c| b. Rate
    independence holds exactly for the scheme "exact", otherwise to the order of the
    scheme.

    Raises ValueError for parameters outside their limits or an unknown scheme.
    """

    laws: ClassVar[Laws] = differential_laws()
    part: ClassVar[Part] = Part(
        "coleman_hodgdon",
        "hysteresis",
        "Coleman-Hodgdon: y' = |x'| (a x + c y) + b x'",
    )

    a: Scalar = parameter("um/V^2", "coefficient of |x'| x")
    b: Scalar = parameter("um/V", "slope at the origin, x = y = 0")
    c: Scalar = parameter("1/V", "decay along the path of the input", below=0.0)
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)
    rest_output: Scalar = parameter("um", "output of the virgin state", default=0.0)
    scheme: str = eqx.field(static=True, default="trapezoid")

    def __check_init__(self):
        if self.scheme not in SCHEMES:
            raise ValueError(
                f"scheme {self.scheme!r}; it must be one of {list(SCHEMES)}"
            )

    def init(self, input: ScalarLike = 0.0) -> HysteresisState:
        input = as_array(input)
        virgin = HysteresisState(self.rest_input, self.rest_output)
        output = _exact(self, virgin, input)
        # Equal pairs mark a pause, so the first quadratic step is a trapezoid (3.25).
        older = (input, output) if self.scheme == "quadratic" else None
        return HysteresisState(input, output, older)

    def step(
        self, state: HysteresisState, input: ScalarLike
    ) -> tuple[HysteresisState, Scalar]:
        input = as_array(input)
        output = SCHEMES[self.scheme](self, state, input)
        older = None if state.older is None else (state.input, state.output)
        return HysteresisState(input, output, older), output

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        width, slope = extent.width, extent.slope
        rest = extent.first[1] - extent.centre
        reach = 2.0 * extent.span
        return Recipe(
            cls(
                a=slope / width,
                b=0.7 * slope,
                c=-1.0 / width,
                rest_input=extent.first[0],
                rest_output=rest,
            ),
            {
                "a": scaled_range(slope / width, 0.0, 20.0),
                "b": scaled_range(slope, 0.0, 3.0),
                "c": Range(-20.0 / width, -0.01 / width),
                **rest_bounds(extent),
                "rest_output": Range(rest - reach, rest + reach),
            },
            # Keep the slope -a/c of the loop's axis while its decay c changes.
            [
                {"c": -steep / width, "a": steep * slope / width, **before}
                for steep in (0.3, 1.0, 3.0, 8.0)
                for before in rest_starts(extent)
            ],
            gain="b",
            own=("rest_input", "rest_output"),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        if self.scheme != "trapezoid":
            return InverseHysteresis(self, lower, upper)
        check_rising(self, lower, upper)
        return InverseColemanHodgdon(self)


def _direction(dx: Scalar) -> Scalar:
    # +1 at rest, as in (3.26): the derivative of |dx| is then +1 there, not NaN.
    return jnp.where(dx >= 0.0, 1.0, -1.0)


def _trapezoid(model: ColemanHodgdon, state: HysteresisState, x: Scalar) -> Scalar:
    """Return the output by (3.26)-(3.29), implicit and solved in closed form."""
    dx = x - state.input
    sign = _direction(dx)
    half = 0.5 * sign * model.c * dx
    force = 0.5 * sign * model.a * (x + state.input) * dx + model.b * dx
    return (force + (1.0 + half) * state.output) / (1.0 - half)


def _quadratic(model: ColemanHodgdon, state: HysteresisState, x: Scalar) -> Scalar:
    """Return the output by (3.21)-(3.24), with q1, q2, q3 in closed form."""
    assert state.older is not None
    older_input, older_output = state.older
    d0, d1 = state.input - older_input, x - state.input
    smooth = d0 * d1 > 0.0
    d0_safe = jnp.where(smooth, d0, 1.0)
    d1_safe = jnp.where(smooth, d1, 1.0)
    sign = _direction(d1_safe)
    c = model.c
    q1 = -c * d1_safe**3 / (6.0 * d0_safe * (d0_safe + d1_safe))
    q2 = c * d1_safe * (d1_safe + 3.0 * d0_safe) / (6.0 * d0_safe)
    q3 = c * d1_safe * (2.0 * d1_safe + 3.0 * d0_safe) / (6.0 * (d0_safe + d1_safe))
    force = 0.5 * sign * model.a * (x + state.input) * d1 + model.b * d1
    memory = sign * q1 * older_output + (1.0 + sign * q2) * state.output
    curved = (force + memory) / (1.0 - sign * q3)
    return jnp.where(smooth, curved, _trapezoid(model, state, x))


def _voros(model: ColemanHodgdon, state: HysteresisState, x: Scalar) -> Scalar:
    """Return the output by (2.11), explicit, with alpha (f - y) = a x + c y."""
    dx = x - state.input
    pull = model.a * state.input + model.c * state.output
    return state.output + pull * _direction(dx) * dx + model.b * dx


def _exact(model: ColemanHodgdon, state: HysteresisState, x: Scalar) -> Scalar:
    """Return the output on the branch y = p x + q + K exp(s c x)."""
    dx = x - state.input
    sign = _direction(dx)
    p = -model.a / model.c
    q = sign * (p - model.b) / model.c
    decay = jnp.exp(sign * model.c * dx)
    return p * x + q + (state.output - p * state.input - q) * decay


SCHEMES: dict[str, Callable[[ColemanHodgdon, HysteresisState, Scalar], Scalar]] = {
    "trapezoid": _trapezoid,
    "quadratic": _quadratic,
    "voros": _voros,
    "exact": _exact,
}


class InverseColemanHodgdon(Inverse):
    """Voltage that moves a trapezoid Coleman-Hodgdon model to a wanted output.

    Input f(k) in um, output u(k) in V. Source: (5.24)-(5.25) with ``2 [f(k+1) - f(k)]``
    in zeta (printed as a sum), in a form that also holds for ``a = 0``. The state is
    that of the model, so that a controller can advance it with the voltage applied
    after clipping.

    Raises ValueError unless the model uses the trapezoid scheme.
    """

    model: ColemanHodgdon

    def __check_init__(self):
        if self.model.scheme != "trapezoid":
            raise ValueError(
                f"the inverse of scheme {self.model.scheme!r} is not available; "
                "it must be 'trapezoid'"
            )

    def init(self, input: ScalarLike = 0.0) -> HysteresisState:
        return self.model.init(holding_input(self.model, input))

    def solve(self, state: Any, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""
        model, wanted = self.model, as_array(wanted)
        rise = wanted - state.output
        sign = _direction(rise)
        eta = sign * model.c * (wanted + state.output) + 2.0 * model.b
        # With v = u(k+1) - u(k):  s a v^2 + (eta + 2 s a u) v = 2 rise.
        slope = eta + 2.0 * sign * model.a * state.input
        discriminant = slope**2 + 8.0 * sign * model.a * rise
        root = jnp.sqrt(jnp.maximum(discriminant, _TINY))
        return state.input + 4.0 * rise / (slope + root)


_TINY = 1e-24  # keeps the gradient of the root finite where no voltage is a solution
