"""The memory rule of Bashash and Jalili: exponential curves between stored extrema."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check, check_order
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis

Points = tuple[Scalar, ...]


class ExtremaState(NamedTuple):
    """Last input (V), output (um), and the turning points that are remembered.

    ``inputs`` (V) and ``outputs`` (um), oldest first, are valid up to ``count``: the
    active curve leads from the last of them towards the one before, ``direction`` +1 if
    that is upwards.
    """

    input: Scalar
    output: Scalar
    count: Scalar
    direction: Scalar
    inputs: Points
    outputs: Points


class BashashJalili(Hysteresis):
    """Hysteresis by a rule: every branch is a curve between two remembered extrema.

    Input v in V, output x in um. The curve from a turning point (v1, x1) towards the
    extreme (v2, x2) is (2.8)

    ``x = x1 + k (1 + alpha exp(-tau |v - v1|)) (v - v1)``,
    ``k = (x2 - x1) / ((v2 - v1) (1 + alpha exp(-tau |v2 - v1|)))``,

    with v2 in k, where v is printed, so that it passes through both points, and with
    the distance in the exponent, so that it holds downwards too. A turn stores an
    extreme, and the new branch heads for the one stored before; where it arrives, the
    loop is wiped out and the branch that was interrupted there goes on (2.9). The
    outermost extrema are those of the reference loop, ``lower_input``, ``lower_output``
    and ``upper_input``, ``upper_output``; beyond them its branches are continued. It
    starts on the rising one (below ``lower_input`` on the falling one).

    ``rising_alpha``, ``falling_alpha`` above -1 and below e^2, so that every curve
    rises with v, and ``rising_tau``, ``falling_tau`` in 1/V, at least 0, shape the
    branches. Negative alphas give a branch that starts flat: loops run
    counter-clockwise, as a piezo's do; positive ones run clockwise.

    ``depth`` turning points inside the reference loop are remembered. Where a further
    one would have to be, the branch is run back as it came: a loop nested deeper than
    that has no width, the output stays continuous, and all that is stored still holds.

    Return-point memory, wiping-out and rate independence hold exactly. Congruency does
    not: a minor loop's height follows from its own two extrema, which lie elsewhere
    after another history. Inverse: InverseHysteresis; none in closed form, v stands in
    (2.8) outside and inside the exponential. Source: Bashash and Jalili 2007, J.
    Micromech. Microeng. 17.

    Raises ValueError for numbers outside these bounds, a reference loop whose upper
    extreme is not above the lower one, or ``depth < 1``.
    """

    lower_input: Scalar = eqx.field(converter=as_array)
    lower_output: Scalar = eqx.field(converter=as_array)
    upper_input: Scalar = eqx.field(converter=as_array)
    upper_output: Scalar = eqx.field(converter=as_array)
    rising_alpha: Scalar = eqx.field(converter=as_array)
    rising_tau: Scalar = eqx.field(converter=as_array)
    falling_alpha: Scalar = eqx.field(converter=as_array)
    falling_tau: Scalar = eqx.field(converter=as_array)
    depth: int = eqx.field(static=True, default=8)

    def __check_init__(self):
        for end in ("lower", "upper"):
            check(f"{end}_input in V", getattr(self, f"{end}_input"))
            check(f"{end}_output in um", getattr(self, f"{end}_output"))
        check_order("lower_input", self.lower_input, "upper_input", self.upper_input)
        check_order(
            "lower_output", self.lower_output, "upper_output", self.upper_output
        )
        for branch in ("rising", "falling"):
            alpha, tau = f"{branch}_alpha", f"{branch}_tau"
            # (1 + alpha exp(-z)) z is flat first at z = 2, where alpha = e^2.
            check(alpha, getattr(self, alpha), above=-1.0, below=7.389056)
            check(f"{tau} in 1/V", getattr(self, tau), least=0.0)
        check("depth", self.depth, least=1.0)

    def init(self, input: ScalarLike = 0.0) -> ExtremaState:
        input = as_array(input)
        rising = input >= self.lower_input
        spare = (jnp.zeros(()),) * self.depth
        lower = jnp.where(rising, self.lower_input, self.upper_input)
        upper = jnp.where(rising, self.upper_input, self.lower_input)
        start = jnp.where(rising, self.lower_output, self.upper_output)
        end = jnp.where(rising, self.upper_output, self.lower_output)
        direction = jnp.where(rising, 1.0, -1.0)
        output = self._curve(input, direction, lower, start, upper, end)
        return ExtremaState(
            input,
            output,
            as_array(2.0),
            direction,
            (upper, lower, *spare),
            (end, start, *spare),
        )

    def step(
        self, state: ExtremaState, input: ScalarLike
    ) -> tuple[ExtremaState, Scalar]:
        input = as_array(input)
        count, inputs, outputs = state.count, state.inputs, state.outputs
        slots = len(inputs)
        moved = input - state.input
        direction = jnp.where(
            moved > 0.0, 1.0, jnp.where(moved < 0.0, -1.0, state.direction)
        )
        turns = direction != state.direction
        full = count > slots - 0.5

        stores = turns & ~full
        inputs, outputs = (
            tuple(
                jnp.where(stores & (count == i), new, old)
                for i, old in enumerate(points)
            )
            for new, points in ((state.input, inputs), (state.output, outputs))
        )
        # Run back past its own start, the last branch is over too.
        retraced = turns & full & (direction * (input - inputs[-1]) >= 0.0)
        count = count + jnp.where(stores, 1.0, 0.0) - jnp.where(retraced, 1.0, 0.0)
        follows = ~turns | stores | retraced

        # The branch heads for the point before the last one; past it, for the point
        # two before, and so on: every second one is on this side, and nested.
        odd = count - 2.0 * jnp.floor(0.5 * count)
        wiped = jnp.zeros(())
        for i in range(1, slots - 1):
            past = direction * (input - inputs[i]) >= 0.0
            ahead = (odd == i % 2) & (count > i + 1.5)
            wiped = wiped + jnp.where(follows & ahead & past, 2.0, 0.0)
        count = count - wiped
        # Past the far end of the reference loop its other branch is the outermost.
        swaps = count < 1.5
        count = jnp.where(swaps, 2.0, count)
        inputs, outputs = (
            (
                jnp.where(swaps, points[1], points[0]),
                jnp.where(swaps, points[0], points[1]),
                *points[2:],
            )
            for points in (inputs, outputs)
        )
        direction = jnp.where(follows, direction, state.direction)
        output = self._curve(
            input,
            direction,
            _picked(inputs, count, 1),
            _picked(outputs, count, 1),
            _picked(inputs, count, 2),
            _picked(outputs, count, 2),
        )
        after = ExtremaState(input, output, count, direction, inputs, outputs)
        return after, output

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)

    def _curve(
        self,
        v: Scalar,
        direction: Scalar,
        v1: Scalar,
        x1: Scalar,
        v2: Scalar,
        x2: Scalar,
    ) -> Scalar:
        """(2.8) from (v1, x1) towards (v2, x2), at v."""
        rising = direction > 0.0
        alpha = jnp.where(rising, self.rising_alpha, self.falling_alpha)
        tau = jnp.where(rising, self.rising_tau, self.falling_tau)

        def bent(distance: Scalar) -> Scalar:
            return (1.0 + alpha * jnp.exp(-tau * jnp.abs(distance))) * distance

        length = bent(v2 - v1)
        apart = length != 0.0
        share = bent(v - v1) / jnp.where(apart, length, 1.0)
        return x1 + (x2 - x1) * share


def _picked(points: Points, count: Scalar, back: int) -> Scalar:
    """Return the valid point that is ``back`` from the end, 1 the last."""
    found = points[2 - back]
    for i in range(3 - back, len(points) + 1 - back):
        found = jnp.where(count == i + back, points[i], found)
    return found
