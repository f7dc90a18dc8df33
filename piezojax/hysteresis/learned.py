"""A learned operator: plays of the input, a layer of neurons, past outputs."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, as_scalars, check
from ..core.axes import Rows, as_rows
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis
from .plays import Memory, played


class LearnedState(NamedTuple):
    """Last input (V), plays of the scaled input, past outputs (um), newest first."""

    input: Scalar
    plays: Memory
    outputs: Memory


class LearnedOperator(Hysteresis):
    """``y(k) = sum_i a_i y(k-i) + linear . s(k) + output . tanh(mixing s(k) + bias)``.

    For a loop that no closed form fits: a nonlinear autoregressive model with input
    (NARX, section 2.4.3) whose regressors s(k) remember as hysteresis does. They are
    the scaled input v = (x - centre) / scale, its plays of the half-widths
    ``thresholds``, and its change over the last sample, x(k) - x(k-1) over ``pace``,
    which lets the loop depend on the rate: n + 2 of n plays. Only the past outputs are
    linear, with the coefficients ``autoregressive``, so that their poles alone decide
    whether a free run is stable. Input x in V, output y in um; ``linear`` [n + 2] and
    ``output`` [neurons] in um, ``mixing`` [neurons, n + 2], ``bias`` [neurons];
    ``centre`` and ``scale`` in V, ``pace`` in V a sample. The material starts without
    memory at ``rest_input`` (V).

    Raises ValueError for sizes that do not fit, thresholds, a scale or a pace that are
    not positive, numbers that are not finite, or past outputs that hold any output.
    """

    before: ClassVar[str | None] = "rest_input"
    dynamic: ClassVar[bool] = True

    autoregressive: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    linear: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    mixing: Rows = eqx.field(converter=as_rows)
    bias: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    output: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    thresholds: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    centre: Scalar = eqx.field(converter=as_array)
    scale: Scalar = eqx.field(converter=as_array)
    pace: Scalar = eqx.field(converter=as_array)
    rest_input: Scalar = eqx.field(converter=as_array, default=0.0)

    def __check_init__(self):
        regressors, neurons = len(self.thresholds) + 2, len(self.bias)
        for name, found, needed in (
            ("linear", len(self.linear), regressors),
            ("mixing in each row", len(self.mixing[0]), regressors),
            ("mixing in rows", len(self.mixing), neurons),
            ("output", len(self.output), neurons),
        ):
            if found != needed:
                raise ValueError(
                    f"{name} has {found} weights; with {len(self.thresholds)} plays "
                    f"and {neurons} neurons it must have {needed}"
                )
        for name in ("autoregressive", "linear", "bias", "output", "centre"):
            check(name, getattr(self, name))
        for row in self.mixing:
            check("mixing", row)
        check("thresholds", self.thresholds, above=0.0)
        check("scale in V", self.scale, above=0.0)
        check("pace in V a sample", self.pace, above=0.0)
        check("sum of the autoregressive part", self._held(), below=1.0)

    def _held(self) -> Scalar:
        return sum(self.autoregressive, as_array(0.0))

    def _scaled(self, input: Scalar) -> Scalar:
        return (input - self.centre) / self.scale

    def _driven(self, input: Scalar, plays: Memory, change: Scalar) -> Scalar:
        """Return what input and memory add to the output."""
        regressors = (self._scaled(input), *plays, change / self.pace)
        total = _dot(self.linear, regressors)
        for weight, row, bias in zip(self.output, self.mixing, self.bias, strict=True):
            total = total + weight * jnp.tanh(_dot(row, regressors) + bias)
        return total

    def init(self, input: ScalarLike = 0.0) -> LearnedState:
        input = as_array(input)
        virgin = (self._scaled(self.rest_input),) * len(self.thresholds)
        plays = played(self._scaled(input), virgin, self.thresholds)
        rest = self._driven(input, plays, jnp.zeros_like(input)) / (1.0 - self._held())
        return LearnedState(input, plays, (rest,) * len(self.autoregressive))

    def step(
        self, state: LearnedState, input: ScalarLike
    ) -> tuple[LearnedState, Scalar]:
        input = as_array(input)
        plays = played(self._scaled(input), state.plays, self.thresholds)
        output = self._driven(input, plays, input - state.input)
        output = output + _dot(self.autoregressive, state.outputs)
        outputs = (output, *state.outputs)[: len(state.outputs)]
        return LearnedState(input, plays, outputs), output

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        if self.autoregressive:
            raise ValueError(
                "a LearnedOperator with past outputs contains dynamics and has no "
                "inverse"
            )
        return InverseHysteresis(self, lower, upper)


def _dot(weights: Memory, values: Memory) -> Scalar:
    return sum((w * v for w, v in zip(weights, values, strict=True)), as_array(0.0))
