"""ARMA model with hysteresis, linear in all coefficients except one."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core.arrays import Scalar, ScalarLike, Scalars, State, as_array, as_scalars
from ..core.parameter import parameter
from ..core.system import Affine, Series, series
from ..dynamics import ARMA
from .coleman_hodgdon import ColemanHodgdon
from .inverse import Inverse
from .model import Hysteresis


class HystereticARMA(Hysteresis):
    """Two Coleman-Hodgdon operators with a common autoregressive denominator, (3.32).

    ``z(k) = sum_i autoregressive[i] z(k-1-i) + sum_i moving_1[i] y_1(k-i) + sum_i
    moving_2[i] y_2(k-i)``, and ``offset`` (um) added to z. y_1 (V^2) and y_2 (V) are
    the outputs of the hysteresis with (a, b) = (1, 0) and (0, 1). They depend only on
    ``c`` (1/V), so that for a given c the model is linear in the other coefficients.
    ``moving_1`` and ``moving_2`` have equal length. ``rest_input`` and ``scheme`` as in
    ``ColemanHodgdon``; with the scheme "voros" this is the earlier model (2.11), with
    which the thesis compares its own.

    Raises ValueError for parameters outside their limits, numerators of different
    length or an unknown scheme.
    """

    dynamic: ClassVar[bool] = True

    c: Scalar = parameter("1/V", "decay along the path of the input", below=0.0)
    autoregressive: Scalars = parameter(
        "1", "coefficients of past outputs", converter=as_scalars
    )
    moving_1: Scalars = parameter("um/V^2", "coefficients of y_1", converter=as_scalars)
    moving_2: Scalars = parameter("um/V", "coefficients of y_2", converter=as_scalars)
    offset: Scalar = parameter("um", "offset of the output", default=0.0)
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)
    scheme: str = eqx.field(static=True, default="trapezoid")

    def __check_init__(self):
        if len(self.moving_1) != len(self.moving_2):
            raise ValueError(
                f"moving_1 holds {len(self.moving_1)} and moving_2 "
                f"{len(self.moving_2)} coefficients; they must have equal length"
            )
        self.expanded()  # the parts check the rest

    def expanded(self) -> Series:
        """Return the same model as a sum of two chains and an offset.

        Each parameter of the denominator and of the operators then occurs twice.
        """
        first, second = operators(self.c, self.rest_input, self.scheme)
        chains = (first >> ARMA(self.autoregressive, self.moving_1)) + (
            second >> ARMA(self.autoregressive, self.moving_2)
        )
        return chains >> Affine(1.0, self.offset)

    def init(self, input: ScalarLike = 0.0) -> State:
        return self.expanded().init(input)

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return self.expanded().step(state, input)

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        """Raise ValueError: the output depends on past outputs."""
        del lower, upper
        raise ValueError(
            "a HystereticARMA contains dynamics and has no inverse; invert the "
            "hysteresis that cascade() returns"
        )

    def cascade(self, tolerance: float = 1e-3) -> Series:
        """Return one hysteresis in series with one ARMA of unit DC gain and the offset.

        The result is exact if ``moving_1`` is a multiple of ``moving_2``. Otherwise
        both keep their DC gains, which become a and b, and share the shape that fits
        both best (the first singular vector of the two, each scaled to length one).
        Raises ValueError if the sine of the angle between them is above ``tolerance``
        (1 accepts every model), if both are zero, if the shared shape has a DC gain of
        zero, or if the model has a pole at z = 1.
        """
        numerators = np.array([self.moving_1, self.moving_2], dtype=float)
        lengths = np.linalg.norm(numerators, axis=1, keepdims=True)
        if not lengths.any():
            raise ValueError(
                "moving_1 and moving_2 are zero; the model has no dynamics"
            )
        rows = numerators / np.where(lengths > 0.0, lengths, 1.0)
        # The area that the two unit rows span; 1 - cos^2 would lose half the digits.
        sine = float(np.prod(np.linalg.svd(rows, compute_uv=False)[:2]))
        if rows.shape[1] > 1 and sine > tolerance:
            raise ValueError(
                f"the sine of the angle between moving_1 and moving_2 is {sine:.3g}; "
                f"it must be at most {tolerance:g} for a single hysteresis"
            )
        shape = np.linalg.svd(rows, full_matrices=False)[2][0]
        if abs(shape.sum()) < 1e-12:
            raise ValueError("the shared numerator sums to 0; there is no DC gain")
        rest = 1.0 - sum(float(a) for a in self.autoregressive)
        if abs(rest) < 1e-12:
            raise ValueError(
                "the autoregressive coefficients sum to 1, a pole at z = 1; there is "
                "no DC gain"
            )
        gain_1, gain_2 = numerators.sum(axis=1) / rest
        return series(
            hysteresis=ColemanHodgdon(
                gain_1, gain_2, self.c, rest_input=self.rest_input, scheme=self.scheme
            ),
            dynamics=ARMA(self.autoregressive, shape * rest / shape.sum()),
            calibration=Affine(1.0, self.offset),
        )


def operators(
    c: ScalarLike, rest_input: ScalarLike = 0.0, scheme: str = "trapezoid"
) -> tuple[ColemanHodgdon, ColemanHodgdon]:
    """Return the operators of y_1 and y_2, (3.26)-(3.29): (a, b) = (1, 0), (0, 1)."""
    rest = jnp.zeros_like(as_array(rest_input))
    return (
        ColemanHodgdon(1.0, 0.0, c, rest_input, rest, scheme),
        ColemanHodgdon(0.0, 1.0, c, rest_input, rest, scheme),
    )
