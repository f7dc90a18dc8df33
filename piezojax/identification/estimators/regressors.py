"""Regressors of the linear regression in chapter 3 of the thesis."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ...core.arrays import Scalar, ScalarLike, as_array, check
from ...core.rollout import simulate
from ...hysteresis import HystereticARMA
from ...hysteresis.hysteretic_arma import operators
from ..records.record import Record


class Orders(eqx.Module):
    """Orders and options of a regression, fixed before the fit.

    ``autoregressive`` and ``moving`` are the numbers of coefficients. ``rest_input``
    (V) is the input at which the hysteresis was virgin. ``scheme`` is the
    discretisation of the hysteresis: "trapezoid", "quadratic" or, for the earlier model
    (2.11), "voros". Raises ValueError for orders below 1.
    """

    autoregressive: int = eqx.field(static=True, default=2)
    moving: int = eqx.field(static=True, default=3)
    rest_input: Scalar = eqx.field(converter=as_array, default=0.0)
    scheme: str = eqx.field(static=True, default="trapezoid")

    def __check_init__(self):
        check("autoregressive coefficients", self.autoregressive, least=1.0)
        check("moving coefficients", self.moving, least=1.0)

    @property
    def size(self) -> int:
        """Number of coefficients in a row: those of the model and a constant."""
        return self.autoregressive + 2 * self.moving + 1

    def model(self, c: ScalarLike, theta: Iterable[Any]) -> HystereticARMA:
        """Return the model with the coefficients ``theta``, ordered as in ``rows``."""
        theta = tuple(theta)
        first = self.autoregressive
        second = first + self.moving
        poles = theta[:first]
        return HystereticARMA(
            c,
            poles,
            theta[first:second],
            theta[second : second + self.moving],
            offset=theta[-1] / (1.0 - sum(poles)),
            rest_input=self.rest_input,
            scheme=self.scheme,
        )


def rows(
    record: Record, c: ScalarLike, structure: Orders, output: np.ndarray
) -> np.ndarray:
    """Return the rows of (3.33), [samples, structure.size].

    Row k holds output(k-1), output(k-2), ...; y_1 at k-1, k-2, ...; y_2 likewise; and 1
    for the offset. ``output`` [samples] is the measured output or an instrument for it.
    The displacement follows the voltage by one sample, as in the loop, so that the row
    has y(k-1) where (3.33) has y(k). The record begins at rest: samples before it equal
    its first sample.
    """
    return row_matrix(structure, output, operator_outputs(record, c, structure))


def operator_outputs(record: Record, c: ScalarLike, structure: Orders) -> np.ndarray:
    """Return the outputs y_1 and y_2 of both operators, [2, samples]."""
    return np.asarray(_run(structure, as_array(c), jnp.asarray(record.input)))


@eqx.filter_jit
def _run(structure, c, input):
    both = operators(c, structure.rest_input, structure.scheme)
    return [simulate(one, input, one.init(input[0]))[1] for one in both]


def row_matrix(
    structure: Orders, output: np.ndarray, hysteresis: np.ndarray
) -> np.ndarray:
    """Return ``rows`` from y_1 and y_2, [2, samples]."""
    counts = (structure.autoregressive, structure.moving, structure.moving)
    lagged = [
        _delayed(signal, lag)
        for signal, count in zip((output, *hysteresis), counts, strict=True)
        for lag in range(1, count + 1)
    ]
    return np.column_stack([*lagged, np.ones(output.size)])


def _delayed(signal: np.ndarray, lag: int) -> np.ndarray:
    return np.concatenate([np.full(lag, signal[0]), signal[:-lag]])
