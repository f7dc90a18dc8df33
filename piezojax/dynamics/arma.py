"""Autoregressive moving-average dynamics of any order."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._types import Scalar, ScalarLike, as_array, as_scalars, check
from ..system import System


class ARMAState(NamedTuple):
    """Past outputs and inputs, newest first."""

    outputs: tuple[Scalar, ...]
    inputs: tuple[Scalar, ...]


class ARMA(System):
    """``y(k) = sum_i autoregressive[i] y(k-1-i) + sum_i moving[i] x(k-i)``, (3.30).

    ``autoregressive`` holds a_1, a_2, ... with the sign of the thesis (on the
    right-hand side), ``moving`` holds b_0, b_1, ...; x and y in the units of the
    neighbours in the chain. Raises ValueError for empty ``moving`` or non-finite
    coefficients.
    """

    autoregressive: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    moving: tuple[Scalar, ...] = eqx.field(converter=as_scalars)

    def __check_init__(self):
        if not self.moving:
            raise ValueError("moving is empty; it must hold at least b_0")
        check("autoregressive", self.autoregressive)
        check("moving", self.moving)

    def dc_gain(self) -> Scalar:
        """Return output over input at rest."""
        return as_array(sum(self.moving) / (1.0 - sum(self.autoregressive)))

    def poles(self) -> np.ndarray:
        """Return the poles in the z plane (concrete parameters only)."""
        return np.roots([1.0, *(-float(a) for a in self.autoregressive)])

    def zeros(self) -> np.ndarray:
        """Return the zeros in the z plane (concrete parameters only)."""
        return np.roots([float(b) for b in self.moving])

    def init(self, input: ScalarLike = 0.0) -> ARMAState:
        input = as_array(input)
        output = self.dc_gain() * input
        return ARMAState(
            outputs=(output,) * len(self.autoregressive),
            inputs=(input,) * (len(self.moving) - 1),
        )

    def step(self, state: ARMAState, input: ScalarLike) -> tuple[ARMAState, Scalar]:
        inputs = (as_array(input), *state.inputs)
        output = jnp.zeros_like(inputs[0])
        for coefficient, value in zip(self.moving, inputs, strict=True):
            output = output + coefficient * value
        for coefficient, value in zip(self.autoregressive, state.outputs, strict=True):
            output = output + coefficient * value
        outputs = (output, *state.outputs)[: len(self.autoregressive)]
        return ARMAState(outputs, inputs[:-1]), output


def scaled_to_dc(model: ARMA, gain: ScalarLike) -> ARMA:
    """Return ``model`` with its numerator scaled so that its DC gain is ``gain``."""
    factor = gain / model.dc_gain()
    return ARMA(model.autoregressive, tuple(b * factor for b in model.moving))
