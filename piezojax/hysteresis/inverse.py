"""What every inverse hysteresis offers, and a numerical one for monotone models."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core.arrays import Scalar, ScalarLike, State, as_array, check_order
from ..core.parameter import parameter
from ..core.rollout import simulate
from ..core.system import System, holding_input


class Inverse(System):
    """A System from a wanted output in um to the voltage that reaches it.

    Its state is that of ``model``, so a controller whose voltage was clipped can
    advance it with the voltage that was really applied.
    """

    model: eqx.AbstractVar[Any]  # a System

    @abc.abstractmethod
    def solve(self, state: Any, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""

    def step(self, state: State, input: Any) -> tuple[State, Scalar]:
        voltage = self.solve(state, input)
        return self.model.step(state, voltage)[0], voltage


class InverseHysteresis(Inverse):
    """Voltage that moves any monotone hysteresis to a wanted output, by Newton's rule.

    Input in um, output in V, between ``lower`` and ``upper`` (V): an output that no
    voltage between them reaches gives the nearer of the two. From any state the next
    output must rise with the input; it may have kinks. ``iterations`` steps start from
    the state's field ``input``, the last voltage, or without one from the middle; each
    is kept inside the bracket found so far, and halves it where Newton's rule leaves
    it. There is no stopping test, so the cost is fixed: the model and its slope, once a
    step. With the 8 of the default every monotone model of this package came to within
    1e-9 um of what was wanted, in steps of a nanometre as in steps over most of the
    range; near the root a further step squares what is left, elsewhere it halves it.
    An explicit scheme (Duhem, NormalisedBoucWen, BoucWen) must have substeps enough for
    the steps asked for: beyond its stability the model itself is not monotone. The
    derivative is that of the implicit function, exact in first order; second
    derivatives are not available.

    Where the output falls as the input rises, between ``lower`` and ``upper`` and on
    any branch, several voltages or none reach it, and no inverse exists: a
    NormalisedBoucWen with ``k_x + 2 sigma rho k_w <= 0``, a ColemanHodgdon with ``a > 2
    b |c|``, plays without a memoryless part, where the output stands still after a
    turn. The constructor runs the model through large and small reversals of the whole
    range, raises ValueError where it finds the output not to rise, and says where. It
    is a probe, not a proof.

    Raises ValueError for that, for parameters outside their limits or ``lower >=
    upper``.
    """

    model: System
    lower: Scalar = parameter("V", "lowest voltage")
    upper: Scalar = parameter("V", "highest voltage")
    iterations: int = parameter("1", "Newton steps", least=1.0, static=True, default=8)

    def __check_init__(self):
        check_order("lower", self.lower, "upper", self.upper)
        check_rising(self.model, self.lower, self.upper)

    def init(self, input: ScalarLike = 0.0) -> State:
        return self.model.init(holding_input(self.model, input))

    def solve(self, state: Any, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""
        wanted = as_array(wanted)
        # Nothing on the way has a derivative: the last step alone carries it.
        still, still_state, target, lower, upper = jax.tree.map(
            jax.lax.stop_gradient, (self.model, state, wanted, self.lower, self.upper)
        )

        def missed(voltage: Scalar) -> tuple[Scalar, Scalar]:
            output, slope = jax.jvp(
                lambda v: still.step(still_state, v)[1],
                (voltage,),
                (jnp.ones_like(voltage),),
            )
            return output - target, slope

        def nearer(_: Any, found: tuple[Scalar, Scalar, Scalar]) -> Any:
            low, high, voltage = found
            error, slope = missed(voltage)
            low = jnp.where(error <= 0.0, voltage, low)
            high = jnp.where(error >= 0.0, voltage, high)
            rises = slope > 0.0
            newton = voltage - error / jnp.where(rises, slope, 1.0)
            newton = jnp.clip(newton, lower, upper)
            # A step too small to see has arrived.
            inside = ((newton > low) & (newton < high)) | (newton == voltage)
            middle = 0.5 * (jnp.maximum(low, lower) + jnp.minimum(high, upper))
            return low, high, jnp.where(rises & inside, newton, middle)

        # The bracket starts outside the range, so that either end is tried once. A
        # loop: unrolled it is a fifth faster, but compiles up to 100 times longer.
        first = getattr(still_state, "input", 0.5 * (lower + upper))
        start = (2.0 * lower - upper, 2.0 * upper - lower, first)
        voltage = jax.lax.fori_loop(0, self.iterations, nearer, start)[2]
        _, slope = missed(voltage)
        slope = jnp.where(slope > 0.0, slope, 1.0)
        output = self.model.step(state, voltage)[1]
        return jnp.clip(voltage - (output - wanted) / slope, self.lower, self.upper)


def check_rising(model: System, lower: ScalarLike, upper: ScalarLike) -> None:
    """Raise ValueError where the output of ``model`` does not rise with its input.

    The model runs through large and small reversals between ``lower`` and ``upper``
    (V). Values that are being traced pass.
    """
    leaves = jax.tree.leaves((model, lower, upper))
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return
    path = _reversals(float(lower), float(upper))
    outputs = _along(model, as_array(path))
    if isinstance(outputs, Tracer):
        return
    outputs = np.asarray(outputs)
    moved, rise = np.diff(path), np.diff(outputs)
    wrong = ~(moved * rise > 0.0) & (moved != 0.0)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise ValueError(
            f"between {path[k]:g} and {path[k + 1]:g} V the output goes from "
            f"{outputs[k]:.6g} to {outputs[k + 1]:.6g} um; an inverse needs a model "
            "whose output rises with the input on every branch"
        )


def _reversals(lower: float, upper: float) -> np.ndarray:
    """Return a path of loops that shrink to the middle, then small ones on the way."""
    shrinking = 0.5 + 0.5 * (-1.0) ** np.arange(1, 13) * np.linspace(1.0, 0.1, 12)
    steps = np.repeat(np.linspace(0.0, 1.0, 9), 2)[1:-1]
    climbing = steps - 0.05 * (np.arange(steps.size) % 2)
    corners = np.concatenate([shrinking, [0.0], np.abs(climbing), [1.0, 0.0]])
    at = np.arange(0.0, corners.size - 1 + 1e-9, 1.0 / 16.0)
    return lower + (upper - lower) * np.interp(at, np.arange(corners.size), corners)


@eqx.filter_jit
def _along(model: System, path: Float[Array, " samples"]) -> Array:
    return simulate(model, path, model.init(path[0]))[1]
