"""Generalised Duhem model: hysteresis as a differential equation of the input."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, as_scalars
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
from ..core.runge_kutta import parts_of_a_step, runge_kutta
from ..core.space import Range
from .inverse import Inverse, InverseHysteresis
from .loading import load_to
from .model import Hysteresis, Laws, differential_laws

Surface: TypeAlias = tuple[tuple[Scalar, ...], ...]


def _as_surface(rows: Iterable[Iterable[Any]]) -> Surface:
    return tuple(as_scalars(row) for row in rows)


class DuhemState(NamedTuple):
    """Last input u (V) and internal state x."""

    input: Scalar
    memory: Scalar


class Duhem(Hysteresis, Fittable):
    """``x' = F(x, u) u' + G(x, u) |u'|``, ``y = h(x, u)``: rate-independent hysteresis.

    This is the generalised Duhem model (2.4) with g(u') = (u', |u'|) and f = (F, G).
    With g(u') = (max(u', 0), min(u', 0)), the choice of the thesis, f is (F + G, F -
    G): the slopes dx/du of the rising and of the falling branch. Input u in V, output y
    in um, x in any unit.

    F is ``reversible`` + |x| ``reversible_modulus``, G is ``irreversible`` + |x|
    ``irreversible_modulus`` and h is ``output`` (by default x). All are polynomials:
    the coefficient in row i, column j multiplies x^i u^j, and rows may differ in
    length. A ShapedColemanHodgdon is ``reversible`` = (slope,), ``irreversible`` =
    (pull, (c,)); a BoucWen of nu = 1 is ``reversible`` = ((alpha,),),
    ``reversible_modulus`` = ((-beta_delta,),), ``irreversible`` = ((), (-beta_gamma,)).
    The material starts on its virgin curve from ``rest_input`` (V) and ``rest_memory``.

    A step has ``substeps`` Runge-Kutta parts, of fourth order except where x changes
    sign and a term contains |x|. Rate independence holds to the same order; other laws
    depend on the shape functions. In general, as in the two special cases, extrema are
    not remembered: there is no return-point memory, no wiping-out and no congruency.
    Source: Oh and Bernstein 2005, IEEE Trans. Automat. Contr. 50(5).

    If y rises with u on every branch, the inverse is InverseHysteresis.

    Raises ValueError for parameters outside their limits or an empty ``output``.
    """

    laws: ClassVar[Laws] = differential_laws()
    part: ClassVar[Part] = Part(
        "duhem",
        "hysteresis",
        "Semilinear Duhem: a linear law for each branch, y' = (F + G sign x') x'",
    )

    reversible: Surface = parameter(
        "1/V^(j+1)", "coefficients of F, row i for x^i", converter=_as_surface
    )
    irreversible: Surface = parameter(
        "1/V^(j+1)", "coefficients of G, row i for x^i", converter=_as_surface
    )
    output: Surface = parameter(
        "um/V^j",
        "coefficients of h, row i for x^i",
        converter=_as_surface,
        default=((0.0,), (1.0,)),
    )
    reversible_modulus: Surface = parameter(
        "1/V^(j+1)", "coefficients of |x| in F", converter=_as_surface, default=()
    )
    irreversible_modulus: Surface = parameter(
        "1/V^(j+1)", "coefficients of |x| in G", converter=_as_surface, default=()
    )
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)
    rest_memory: Scalar = parameter("1", "x in the virgin state", default=0.0)
    substeps: int = parts_of_a_step()

    def __check_init__(self):
        if not any(self.output):
            raise ValueError("output is empty; it must hold a coefficient")

    def rate(self, memory: Scalar, input: Scalar, change: Scalar) -> Scalar:
        """Return dx along a ``change`` (V) of the input, at x and u."""
        # +1 at rest, as in ColemanHodgdon: |u'| then has the slope of the rising side.
        magnitude = jnp.where(change >= 0.0, change, -change)
        reversible = _value(self.reversible, memory, input)
        irreversible = _value(self.irreversible, memory, input)
        if any(self.reversible_modulus + self.irreversible_modulus):
            modulus = jnp.abs(memory)
            reversible += modulus * _value(self.reversible_modulus, memory, input)
            irreversible += modulus * _value(self.irreversible_modulus, memory, input)
        return reversible * change + irreversible * magnitude

    def init(self, input: ScalarLike = 0.0) -> DuhemState:
        virgin = DuhemState(self.rest_input, self.rest_memory)
        return load_to(self, virgin, as_array(input))

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        # Oh and Bernstein 2005, with one state; the rising and the falling branch each
        # have a slope, a pull and a decay. A constant pull whose sign changes with the
        # branch is equivalent to an offset of the output and is left out.
        width, slope = extent.width, extent.slope
        rest = extent.first[1] - extent.centre
        reach = 2.0 * extent.span
        pull, size = slope / width, abs(slope)
        return Recipe(
            cls(
                reversible=((0.7 * slope, 0.0), (0.0,)),
                irreversible=((0.0, pull), (-1.0 / width,)),
                rest_input=extent.first[0],
                rest_memory=rest,
            ),
            {
                "reversible.0.0": Range(-10.0 * size, 10.0 * size),
                "reversible.0.1": Range(-20.0 * size / width, 20.0 * size / width),
                "reversible.1.0": Range(-10.0 / width, 10.0 / width),
                "irreversible.0.1": scaled_range(pull, -1.0, 50.0),
                "irreversible.1.0": Range(-50.0 / width, -0.01 / width),
                **rest_bounds(extent),
                "rest_memory": Range(rest - reach, rest + reach),
            },
            [
                {"irreversible.1.0": -steep / width, "irreversible.0.1": steep * pull}
                | before
                for steep in (1.0, 3.0, 10.0)
                for before in rest_starts(extent)
            ],
            gain="reversible.0.0",
            own=("rest_input", "rest_memory"),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)

    # Reverse mode recomputes a step, because storing its stages takes longer.
    @partial(jax.checkpoint, prevent_cse=False)
    def step(self, state: DuhemState, input: ScalarLike) -> tuple[DuhemState, Scalar]:
        input = as_array(input)
        change = input - state.input
        memory, _ = runge_kutta(
            lambda point: (self.rate(point[0], point[1], change), change),
            (state.memory, state.input),
            1.0,
            self.substeps,
        )
        return DuhemState(input, memory), _value(self.output, memory, input)


def _value(surface: Surface, x: Scalar, u: Scalar) -> Scalar:
    """Return sum_ij surface[i][j] x^i u^j by Horner's rule in x and u."""
    return _polynomial([_polynomial(row, u) for row in surface], x)


def _polynomial(coefficients: Sequence[Scalar], at: Scalar) -> Scalar:
    if not coefficients:
        return jnp.zeros_like(at)
    # Horner's rule from the highest coefficient, without a multiplication by zero.
    *lower, total = coefficients
    for coefficient in reversed(lower):
        total = total * at + coefficient
    return total
