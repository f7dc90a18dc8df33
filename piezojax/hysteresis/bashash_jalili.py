"""Bashash-Jalili hysteresis: exponential curves between stored extrema."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check_order
from ..core.parameter import parameter
from ..core.recipe import Extent, Fittable, Part, Recipe
from ..core.space import Range
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis, Laws, turning_point_laws

Points = tuple[Scalar, ...]


class ExtremaState(NamedTuple):
    """Last input (V), last output (um) and the remembered turning points.

    The first ``count`` elements of ``inputs`` (V) and ``outputs`` (um), oldest first,
    are valid. The active curve leads from the last of them towards the one before;
    ``direction`` is +1 if that is upwards, else -1.
    """

    input: Scalar
    output: Scalar
    count: Scalar
    direction: Scalar
    inputs: Points
    outputs: Points


class BashashJalili(Hysteresis, Fittable):
    """Hysteresis whose branches are curves between two remembered extrema.

    Input v in V, output x in um. The curve from a turning point (v1, x1) towards the
    extremum (v2, x2) is (2.8)

    ``x = x1 + k (1 + alpha exp(-tau |v - v1|)) (v - v1)``,
    ``k = (x2 - x1) / ((v2 - v1) (1 + alpha exp(-tau |v2 - v1|)))``,

    with two corrections of the printed equation: k contains v2 instead of v, so that
    the curve passes through both points, and the exponent contains the distance, so
    that the curve also holds downwards. Where the input turns, an extremum is stored,
    and the new branch leads to the extremum stored before. When it arrives there, both
    are wiped out and the branch interrupted there continues (2.9). The outermost
    extrema are those of the reference loop, ``lower_input``, ``lower_output`` and
    ``upper_input``, ``upper_output``; beyond them its branches are extended. The model
    starts on the rising branch, or below ``lower_input`` on the falling one.

    The alphas lie above -1 and below e^2, so that every curve rises with v. With
    negative alphas a branch is least steep at its start, and loops run
    counter-clockwise, as for a piezo; with positive alphas they run clockwise.

    The model remembers ``depth`` turning points inside the reference loop. When all are
    in use, a further turn moves back along the present branch: a loop nested deeper has
    no width, the output stays continuous, and the stored points stay valid.

    Return-point memory, wiping-out and rate independence hold exactly. Congruency does
    not: the height of a minor loop depends on the outputs at its two ends, and these
    depend on the history. The inverse is InverseHysteresis; there is no closed form,
    because v occurs in (2.8) outside and inside the exponential. Source: Bashash and
    Jalili 2007, J. Micromech. Microeng. 17.

    Raises ValueError for parameters outside their limits, or a reference loop whose
    upper end is not above the lower one.
    """

    rising: ClassVar[bool] = True
    laws: ClassVar[Laws] = turning_point_laws(without=("congruency",))
    part: ClassVar[Part] = Part(
        "bashash_jalili",
        "hysteresis",
        "Bashash-Jalili: exponential curves between stored extrema",
    )

    lower_input: Scalar = parameter("V", "lower input of the reference loop")
    lower_output: Scalar = parameter("um", "output at the lower input")
    upper_input: Scalar = parameter("V", "upper input of the reference loop")
    upper_output: Scalar = parameter("um", "output at the upper input")
    # The least alpha at which (1 + alpha exp(-z)) z has a flat point is e^2.
    rising_alpha: Scalar = parameter(
        "1", "bend of rising branches", above=-1.0, below=7.389056
    )
    rising_tau: Scalar = parameter("1/V", "decay of the rising bend", least=0.0)
    falling_alpha: Scalar = parameter(
        "1", "bend of falling branches", above=-1.0, below=7.389056
    )
    falling_tau: Scalar = parameter("1/V", "decay of the falling bend", least=0.0)
    depth: int = parameter(
        "1",
        "turning points remembered",
        least=1.0,
        most=64.0,
        whole=True,
        static=True,
        default=8,
    )

    def __check_init__(self):
        check_order("lower_input", self.lower_input, "upper_input", self.upper_input)
        check_order(
            "lower_output", self.lower_output, "upper_output", self.upper_output
        )

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
        # A branch that is traced back beyond its start ends as well.
        retraced = turns & full & (direction * (input - inputs[-1]) >= 0.0)
        count = count + jnp.where(stores, 1.0, 0.0) - jnp.where(retraced, 1.0, 0.0)
        follows = ~turns | stores | retraced

        # The branch leads to the second-last point. Beyond that point it leads to the
        # one two places earlier, and so on. These points lie in the direction of the
        # branch, the earlier ones further away.
        odd = count - 2.0 * jnp.floor(0.5 * count)
        wiped = jnp.zeros(())
        for i in range(1, slots - 1):
            past = direction * (input - inputs[i]) >= 0.0
            ahead = (odd == i % 2) & (count > i + 1.5)
            wiped = wiped + jnp.where(follows & ahead & past, 2.0, 0.0)
        count = count - wiped
        # Beyond the far end of the reference loop its other branch is active.
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

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        width, slope = extent.width, extent.slope
        if slope <= 0.0:
            raise ValueError(
                "the output falls while the input rises; bashash_jalili needs an "
                "output that rises with the input"
            )
        # The reference loop spans the range of the record. The offset of the output
        # fixes one of its ends, so only the other is fitted.
        lower, upper = slope * extent.low, slope * extent.high
        ends = lower + 0.3 * extent.span, lower + 3.0 * extent.span
        bounds = {"upper_output": Range(*ends)}
        for branch in ("rising", "falling"):
            bounds[f"{branch}_alpha"] = Range(-0.99, 3.0)
            bounds[f"{branch}_tau"] = Range(0.2 / width, 100.0 / width, "log")
        return Recipe(
            cls(
                lower_input=extent.low,
                lower_output=lower,
                upper_input=extent.high,
                upper_output=upper,
                rising_alpha=-0.4,
                rising_tau=4.0 / width,
                falling_alpha=-0.4,
                falling_tau=4.0 / width,
            ),
            bounds,
            [
                {"rising_tau": steep / width, "falling_tau": steep / width}
                for steep in (1.5, 4.0, 12.0)
            ],
            gain="upper_output",
        )

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
        """Return the curve (2.8) from (v1, x1) towards (v2, x2) at v."""
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
    """Return the ``back``-th of the ``count`` valid points, counted from the end."""
    picked = points[2 - back]
    for i in range(3 - back, len(points) + 1 - back):
        picked = jnp.where(count == i + back, points[i], picked)
    return picked
