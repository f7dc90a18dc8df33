"""Interface of inverse hysteresis models, and a numerical inverse."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core.arrays import Scalar, ScalarLike, State, as_array, check_order
from ..core.feedback import holding_input
from ..core.limited import Limited
from ..core.parameter import parameter
from ..core.rollout import simulate
from ..core.system import System

CONVERGED = 1e-14
"""Largest Newton step that counts as converged, as a share of the input range."""


class Inverse(System):
    """System from a wanted output in um to the voltage that reaches it.

    Its state is that of ``model``, so that a controller can advance it with the voltage
    applied after clipping.
    """

    model: eqx.AbstractVar[Any]  # a System

    @abc.abstractmethod
    def solve(self, state: Any, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""

    def step(self, state: State, input: Any) -> tuple[State, Scalar]:
        voltage = self.solve(state, input)
        return self.model.step(state, voltage)[0], voltage


class InverseHysteresis(Inverse, Limited):
    """Numerical inverse of any monotone hysteresis, by Newton's method.

    Input in um, output in V, between ``lower`` and ``upper`` (V). If no voltage between
    them reaches the wanted output, the nearer limit is returned. From any state the
    next output must rise with the input; it may have kinks.

    Newton's method takes ``iterations`` steps. It starts from the last voltage, the
    field ``input`` of the state, or from the middle of the range if the state has no
    such field. A step that would leave the present bracket halves the bracket instead.
    Near the root a step squares the error, elsewhere it halves it. There is no stopping
    test, so the cost is fixed: one evaluation of the model and its slope per step. With
    the default of 8 steps every monotone model of this package came within 1e-9 um of
    the wanted output, for steps of a nanometre and for steps over most of the range. A
    model with an explicit scheme (Duhem, NormalisedBoucWen, BoucWen) needs enough
    substeps: beyond the limit of stability it is not monotone. The derivative is that
    of the implicit function, exact to first order; second derivatives are not
    available.

    If the output falls on any branch while the input rises between ``lower`` and
    ``upper``, several voltages or none reach an output, and no inverse exists. Examples
    are a NormalisedBoucWen with ``k_x + 2 sigma rho k_w <= 0``, a ColemanHodgdon with
    ``a > 2 b |c|``, and plays without a memoryless part, whose output is constant after
    a turn. The constructor simulates large and small reversals over the whole range and
    raises ValueError, naming the place, if the output does not rise. The reversals are
    samples: the test does not prove that every branch rises.

    Raises ValueError if the output does not rise, for parameters outside their limits
    or ``lower >= upper``.
    """

    model: System
    lower: Scalar = parameter("V", "lowest voltage")
    upper: Scalar = parameter("V", "highest voltage")
    iterations: int = parameter(
        "1", "Newton steps", least=1.0, most=100.0, whole=True, static=True, default=8
    )

    def __check_init__(self):
        check_order("lower", self.lower, "upper", self.upper)
        check_rising(self.model, self.lower, self.upper)

    @property
    def ends(self) -> tuple[Scalar, Scalar]:
        return self.lower, self.upper

    def init(self, input: ScalarLike = 0.0) -> State:
        return self.model.init(holding_input(self.model, input))

    def solve(self, state: Any, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""
        wanted = as_array(wanted)
        # Only the last step is differentiated, not the iteration.
        still, still_state, target, lower, upper = jax.tree.map(
            jax.lax.stop_gradient, (self.model, state, wanted, self.lower, self.upper)
        )

        def error_and_slope(voltage: Scalar) -> tuple[Scalar, Scalar]:
            output, slope = jax.jvp(
                lambda v: still.step(still_state, v)[1],
                (voltage,),
                (jnp.ones_like(voltage),),
            )
            return output - target, slope

        def newton_step(_: Any, bracket: tuple[Scalar, Scalar, Scalar]) -> Any:
            low, high, voltage = bracket
            error, slope = error_and_slope(voltage)
            low = jnp.where(error <= 0.0, voltage, low)
            high = jnp.where(error >= 0.0, voltage, high)
            rises = slope > 0.0
            newton = voltage - error / jnp.where(rises, slope, 1.0)
            newton = jnp.clip(newton, lower, upper)
            # A step of rounding size has converged, even at an end of the bracket.
            converged = jnp.abs(newton - voltage) <= CONVERGED * (upper - lower)
            inside = ((newton > low) & (newton < high)) | converged
            middle = 0.5 * (jnp.maximum(low, lower) + jnp.minimum(high, upper))
            return low, high, jnp.where(rises & inside, newton, middle)

        # The bracket starts outside the range, so that either end can be tried. The
        # loop is not unrolled: that would be a fifth faster, but compile up to 100
        # times longer.
        first = getattr(still_state, "input", 0.5 * (lower + upper))
        start = (2.0 * lower - upper, 2.0 * upper - lower, first)
        voltage = jax.lax.fori_loop(0, self.iterations, newton_step, start)[2]
        _, slope = error_and_slope(voltage)
        slope = jnp.where(slope > 0.0, slope, 1.0)
        output = self.model.step(state, voltage)[1]
        return jnp.clip(voltage - (output - wanted) / slope, self.lower, self.upper)


MOSTLY = 0.8
"""Share of steps in which the output moves against the input, above which its sign is
probably wrong."""

FALLS = (
    ". This one falls while the input rises: reverse the sign of the displacement, or "
    "of the voltage, in the record or in the wiring"
)


def check_rising(model: System, lower: ScalarLike, upper: ScalarLike) -> None:
    """Raise ValueError if the output of ``model`` does not rise with its input.

    The model is simulated over large and small reversals between ``lower`` and
    ``upper`` (V). Traced values are not checked.
    """
    leaves = jax.tree.leaves((model, lower, upper))
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return
    path = _reversals(float(lower), float(upper))
    outputs = _outputs_along(model, as_array(path))
    if isinstance(outputs, Tracer):
        return
    outputs = np.asarray(outputs)
    moved, rise = np.diff(path), np.diff(outputs)
    wrong = ~(moved * rise > 0.0) & (moved != 0.0)
    if wrong.any():
        k = int(np.argmax(wrong))
        falls = np.mean(moved * rise < 0.0) > MOSTLY
        raise ValueError(
            f"between {path[k]:g} and {path[k + 1]:g} V the output goes from "
            f"{outputs[k]:.6g} to {outputs[k + 1]:.6g} um; an inverse needs a model "
            "whose output rises with the input on every branch"
            + (FALLS if falls else "")
        )


def _reversals(lower: float, upper: float) -> np.ndarray:
    """Return inputs: loops that shrink to the middle, then small loops up the range."""
    shrinking = 0.5 + 0.5 * (-1.0) ** np.arange(1, 13) * np.linspace(1.0, 0.1, 12)
    steps = np.repeat(np.linspace(0.0, 1.0, 9), 2)[1:-1]
    climbing = steps - 0.05 * (np.arange(steps.size) % 2)
    corners = np.concatenate([shrinking, [0.0], np.abs(climbing), [1.0, 0.0]])
    at = np.arange(0.0, corners.size - 1 + 1e-9, 1.0 / 16.0)
    return lower + (upper - lower) * np.interp(at, np.arange(corners.size), corners)


@eqx.filter_jit
def _outputs_along(model: System, path: Float[Array, " samples"]) -> Array:
    return simulate(model, path, model.init(path[0]))[1]
