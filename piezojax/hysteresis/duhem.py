"""The generalised Duhem model: hysteresis as a differential equation of the input."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, as_scalars, check
from ..core.runge_kutta import runge_kutta
from .inverse import Inverse, InverseHysteresis
from .loading import loaded
from .model import Hysteresis

Surface: TypeAlias = tuple[tuple[Scalar, ...], ...]


def _as_surface(rows: Iterable[Iterable[Any]]) -> Surface:
    return tuple(as_scalars(row) for row in rows)


class DuhemState(NamedTuple):
    """Last input u (V) and internal state x."""

    input: Scalar
    memory: Scalar


class Duhem(Hysteresis):
    """``x' = F(x, u) u' + G(x, u) |u'|``, ``y = h(x, u)``: rate-independent hysteresis.

    The generalised Duhem model, (2.4), with g(u') = (u', |u'|) and f = (F, G); in the
    thesis' own choice g(u') = (max(u', 0), min(u', 0)) the two are F + G and F - G: the
    slope dx/du of the rising and of the falling branch. Input u in V, output y in um,
    x in any unit.

    F = ``reversible`` + |x| ``reversible_modulus`` and G = ``irreversible`` + |x|
    ``irreversible_modulus``; these and h = ``output`` (x itself, if left out) are
    polynomials: row i, column j multiplies x^i u^j, and rows may differ in length. A
    ShapedColemanHodgdon is ``reversible`` = (slope,), ``irreversible`` = (pull, (c,));
    a BoucWen of nu = 1 is ``reversible`` = ((alpha,),), ``reversible_modulus`` =
    ((-beta_delta,),), ``irreversible`` = ((), (-beta_gamma,)). The material starts on
    its virgin curve from ``rest_input`` (V), ``rest_memory``.

    ``substeps`` parts a step, Runge-Kutta of fourth order except where x changes its
    sign under a modulus. Rate-independent in the same order; what else holds is the
    shape functions' doing. In general, as in the two special cases, the extrema are
    not remembered: no return-point memory, no wiping-out, no congruency. Source: Oh and
    Bernstein 2005, IEEE Trans. Automat. Contr. 50(5).

    Inverse: InverseHysteresis, where y rises with u on every branch.

    Raises ValueError for numbers that are not finite, an empty ``output`` or
    ``substeps < 1``.
    """

    before: ClassVar[str | None] = "rest_input"

    reversible: Surface = eqx.field(converter=_as_surface)
    irreversible: Surface = eqx.field(converter=_as_surface)
    output: Surface = eqx.field(converter=_as_surface, default=((0.0,), (1.0,)))
    reversible_modulus: Surface = eqx.field(converter=_as_surface, default=())
    irreversible_modulus: Surface = eqx.field(converter=_as_surface, default=())
    rest_input: Scalar = eqx.field(converter=as_array, default=0.0)
    rest_memory: Scalar = eqx.field(converter=as_array, default=0.0)
    substeps: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        for name in (
            "reversible",
            "irreversible",
            "output",
            "reversible_modulus",
            "irreversible_modulus",
        ):
            for index, row in enumerate(getattr(self, name)):
                check(f"{name}[{index}]", row)
        if not any(self.output):
            raise ValueError("output is empty; it must hold a coefficient")
        check("rest_input in V", self.rest_input)
        check("rest_memory", self.rest_memory)
        check("substeps", self.substeps, least=1.0)

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
        return loaded(self, virgin, as_array(input))

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)

    # In reverse mode a step is worked out again: its stages take longer to store.
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
    """Return sum_ij surface[i][j] x^i u^j by Horner's rule in both."""
    return _polynomial([_polynomial(row, u) for row in surface], x)


def _polynomial(coefficients: Sequence[Scalar], at: Scalar) -> Scalar:
    if not coefficients:
        return jnp.zeros_like(at)
    # From the highest one: a product with a zero in front of it would be worked out.
    *lower, total = coefficients
    for coefficient in reversed(lower):
        total = total * at + coefficient
    return total
