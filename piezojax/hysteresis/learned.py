"""Learned hysteresis operator from plays, a layer of neurons and past outputs."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars, check
from ..core.axes import Rows, as_rows
from ..core.parameter import parameter
from ..core.recipe import Extent, Fittable, Part, Recipe, rest_bounds
from ..core.space import Range
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis
from .plays import Memory, advance_plays

LEARNED_PLAYS, NEURONS = 5, 4
"""Play operators and neurons of a fitted learned operator."""

SEEDS = 16
"""Number of random starts of a fit, the same in every run.

On records simulated with a learned operator (tests/benchmarks/choice.py), each of 12
starts ended in an optimum worse than the true parameters for two of three noise draws.
Of 16 starts, at least one reached an optimum as good as the true parameters.
"""


class LearnedState(NamedTuple):
    """Last input (V), plays of the scaled input, past outputs (um), newest first."""

    input: Scalar
    plays: Memory
    outputs: Memory


class LearnedOperator(Hysteresis, Fittable):
    """``y(k) = sum_i a_i y(k-i) + linear . s(k) + output . tanh(mixing s(k) + bias)``.

    It suits a loop that no closed form fits. It is a nonlinear autoregressive model
    with exogenous input (NARX, section 2.4.3) whose regressors s(k) have the memory of
    hysteresis. With n plays there are n + 2 regressors: the scaled input v = (x -
    centre) / scale, its plays of the half-widths ``thresholds``, and the change of the
    input over the last sample, (x(k) - x(k-1)) / ``pace``, which makes the loop
    rate-dependent. Past outputs act only linearly, with the coefficients
    ``autoregressive``, so that their poles alone decide whether a free run is stable.
    Input x in V, output y in um; the sizes are ``linear`` [n + 2], ``output``
    [neurons], ``mixing`` [neurons, n + 2], ``bias`` [neurons]. The material starts
    without memory at ``rest_input``.

    Raises ValueError for parameters outside their limits, sizes that do not match, or
    autoregressive coefficients whose sum is 1 or more: the model then has no stable
    output at rest.
    """

    dynamic: ClassVar[bool] = True
    part: ClassVar[Part] = Part(
        "learned_operator",
        "hysteresis",
        "Learned: neurons over play operators, with past outputs (NARX)",
    )

    autoregressive: Scalars = parameter(
        "1", "coefficients of past outputs", converter=as_scalars
    )
    linear: Scalars = parameter("um", "weights of the regressors", converter=as_scalars)
    mixing: Rows = parameter(
        "1", "weights of the regressors in each neuron", converter=as_rows
    )
    bias: Scalars = parameter("1", "offset of each neuron", converter=as_scalars)
    output: Scalars = parameter("um", "weight of each neuron", converter=as_scalars)
    thresholds: Scalars = parameter(
        "1", "half-widths of the plays", above=0.0, converter=as_scalars
    )
    centre: Scalar = parameter("V", "middle of the input")
    scale: Scalar = parameter("V", "half the range of the input", above=0.0)
    pace: Scalar = parameter("V", "typical change of the input in a sample", above=0.0)
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)

    def __check_init__(self):
        regressors, neurons = len(self.thresholds) + 2, len(self.bias)
        for name, size, needed in (
            ("linear", len(self.linear), regressors),
            ("each row of mixing", len(self.mixing[0]), regressors),
            ("each column of mixing", len(self.mixing), neurons),
            ("output", len(self.output), neurons),
        ):
            if size != needed:
                raise ValueError(
                    f"{name} has {size} weights; with {len(self.thresholds)} plays "
                    f"and {neurons} neurons it must have {needed}"
                )
        check("sum of the autoregressive part", self._autoregressive_sum(), below=1.0)

    def _autoregressive_sum(self) -> Scalar:
        return sum(self.autoregressive, as_array(0.0))

    def _scaled(self, input: Scalar) -> Scalar:
        return (input - self.centre) / self.scale

    def _driven(self, input: Scalar, plays: Memory, change: Scalar) -> Scalar:
        """Return the contribution of input and memory to the output."""
        regressors = (self._scaled(input), *plays, change / self.pace)
        total = _dot(self.linear, regressors)
        for weight, row, bias in zip(self.output, self.mixing, self.bias, strict=True):
            total = total + weight * jnp.tanh(_dot(row, regressors) + bias)
        return total

    def init(self, input: ScalarLike = 0.0) -> LearnedState:
        input = as_array(input)
        virgin = (self._scaled(self.rest_input),) * len(self.thresholds)
        plays = advance_plays(self._scaled(input), virgin, self.thresholds)
        rest = self._driven(input, plays, jnp.zeros_like(input)) / (
            1.0 - self._autoregressive_sum()
        )
        return LearnedState(input, plays, (rest,) * len(self.autoregressive))

    def step(
        self, state: LearnedState, input: ScalarLike
    ) -> tuple[LearnedState, Scalar]:
        input = as_array(input)
        plays = advance_plays(self._scaled(input), state.plays, self.thresholds)
        output = self._driven(input, plays, input - state.input)
        output = output + _dot(self.autoregressive, state.outputs)
        outputs = (output, *state.outputs)[: len(state.outputs)]
        return LearnedState(input, plays, outputs), output

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        count = LEARNED_PLAYS + 2
        height = 0.5 * extent.slope * extent.width  # um for half the range of the input
        reach = 3.0 * abs(height)
        starts = [_initial_weights(seed, count, height) for seed in range(SEEDS)]
        first = starts[0]
        return Recipe(
            cls(
                autoregressive=(0.1, 0.0),
                linear=(0.5 * height, *(0.08 * height,) * LEARNED_PLAYS, 0.0),
                mixing=as_rows(
                    [first[f"mixing.{i}.{j}"] for j in range(count)]
                    for i in range(NEURONS)
                ),
                bias=[first[f"bias.{i}"] for i in range(NEURONS)],
                output=[first[f"output.{i}"] for i in range(NEURONS)],
                # A half-width of 1 is half the range: a wider play adds no hysteresis.
                thresholds=np.arange(1, LEARNED_PLAYS + 1) / (LEARNED_PLAYS + 1),
                centre=0.5 * (extent.low + extent.high),
                scale=0.5 * extent.width,
                # The mean change per sample of ten cycles over the range in the record.
                pace=20.0 * extent.width * extent.dt / extent.duration,
                rest_input=extent.first[0],
            ),
            {
                "autoregressive.0": Range(-1.9, 1.9),
                "autoregressive.1": Range(-0.95, 0.95),
                **{f"linear.{j}": Range(-reach, reach) for j in range(count)},
                **{
                    f"mixing.{i}.{j}": Range(-6.0, 6.0)
                    for i in range(NEURONS)
                    for j in range(count)
                },
                **{f"bias.{i}": Range(-4.0, 4.0) for i in range(NEURONS)},
                **{f"output.{i}": Range(-reach, reach) for i in range(NEURONS)},
                **rest_bounds(extent),
            },
            starts,
            gain="linear.0",
            own=("rest_input",),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        if self.autoregressive:
            raise ValueError(
                "a LearnedOperator with past outputs contains dynamics and has no "
                "inverse"
            )
        return InverseHysteresis(self, lower, upper)


def _dot(weights: Memory, values: Memory) -> Scalar:
    return sum((w * v for w, v in zip(weights, values, strict=True)), as_array(0.0))


def _initial_weights(seed: int, count: int, height: float) -> dict[str, float]:
    """Return initial weights of the neurons, so small that tanh is not saturated."""
    draw = np.random.default_rng(seed).normal
    return {
        **{
            f"mixing.{i}.{j}": float(draw(scale=0.7))
            for i in range(NEURONS)
            for j in range(count)
        },
        **{f"bias.{i}": float(draw(scale=0.5)) for i in range(NEURONS)},
        **{
            f"output.{i}": float(draw(scale=0.05 * abs(height))) for i in range(NEURONS)
        },
    }
