"""Metrics of a loop, accumulated while it runs."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .arrays import Scalar, State
from .limited import Sample
from .rollout import Metric


class TrackingFigures(NamedTuple):
    """Tracking error, effort and saturation of one run of a loop.

    Four figures are over the window of the Tracking metric: ``rms_error`` and
    ``peak_error`` of the true displacement against the reference in um, ``rms_effort``
    of the voltage in V, and ``rms_slew`` of the change of the voltage per sample in V.
    Two are over the whole run, because saturation during the start-up counts too:
    ``saturated``, the share of samples (0 to 1) at which the voltage differs from the
    command, or the controller itself limits the command, and ``peak_voltage`` in V.
    """

    rms_error: Scalar
    peak_error: Scalar
    rms_effort: Scalar
    rms_slew: Scalar
    saturated: Scalar
    peak_voltage: Scalar


class Tracking(Metric):
    """Metric of the tracking error, effort and saturation of a Feedback loop.

    ``start`` is the first sample of the window: the thesis excludes the start-up
    transient. A sample counts as saturated if the voltage differs from the command by
    more than ``tolerance`` (V), so that the rounding of a converter does not count, and
    if the command is at a limit of the controller's own (``Watched``). If a run ends
    before ``start``, the figures over the window are NaN.
    """

    start: int = eqx.field(static=True, default=0)
    tolerance: float = eqx.field(static=True, default=0.1)

    def init(self) -> State:
        zero = jnp.zeros(())
        return {
            "samples": zero,
            "count": zero,
            "error": zero,
            "peak": zero,
            "effort": zero,
            "slew": zero,
            "saturated": zero,
            "voltage": zero,
            "last": zero,
        }

    def update(self, total: State, index: Array, output: Sample) -> State:
        inside = jnp.where(index >= self.start, 1.0, 0.0)
        error = output.displacement - output.reference
        voltage = output.voltage
        change = jnp.where(index > self.start, voltage - total["last"], 0.0)
        clipped = jnp.abs(output.command - voltage) > self.tolerance
        held = getattr(output, "at_limit", None)
        if held is not None:
            clipped = clipped | held
        return {
            "samples": total["samples"] + 1.0,
            "count": total["count"] + inside,
            "error": total["error"] + inside * error**2,
            "peak": jnp.maximum(total["peak"], inside * jnp.abs(error)),
            "effort": total["effort"] + inside * voltage**2,
            "slew": total["slew"] + inside * change**2,
            "saturated": total["saturated"] + jnp.where(clipped, 1.0, 0.0),
            "voltage": jnp.maximum(total["voltage"], jnp.abs(voltage)),
            "last": voltage,
        }

    def result(self, total: State) -> TrackingFigures:
        count = jnp.maximum(total["count"], 1.0)
        counted = jnp.where(total["count"] > 0.0, 0.0, jnp.nan)
        return TrackingFigures(
            rms_error=root(total["error"] / count) + counted,
            peak_error=total["peak"] + counted,
            rms_effort=root(total["effort"] / count) + counted,
            rms_slew=root(total["slew"] / count) + counted,
            saturated=total["saturated"] / jnp.maximum(total["samples"], 1.0),
            peak_voltage=total["voltage"],
        )


class ExtremeFigures(NamedTuple):
    """Extremes of one run of a loop.

    ``peak_slew`` is the largest change of the voltage between two samples of the
    window, V.
    ``overshoot`` is the excess of the displacement over the highest reference or below
    the lowest one, whichever is larger, as a share of the range of the reference; it is
    0 for a constant reference.
    """

    peak_slew: Scalar
    overshoot: Scalar


class Extremes(Metric):
    """Metric of the largest voltage change, and of the overshoot over the whole run.

    ``start`` is the first sample of the window of the voltage change: a run begins with
    a step, if a disturbance does not begin at 0.
    """

    start: int = eqx.field(static=True, default=0)

    def init(self) -> State:
        zero, least = jnp.zeros(()), jnp.asarray(-jnp.inf)
        return {
            "slew": zero,
            "last": jnp.asarray(jnp.nan),
            "highest": least,
            "lowest": -least,
            "top": least,
            "bottom": -least,
        }

    def update(self, total: State, index: Array, output: Sample) -> State:
        first = index <= self.start
        change = output.voltage - jnp.where(first, output.voltage, total["last"])
        return {
            "slew": jnp.maximum(total["slew"], jnp.abs(change)),
            "last": output.voltage,
            "highest": jnp.maximum(total["highest"], output.displacement),
            "lowest": jnp.minimum(total["lowest"], output.displacement),
            "top": jnp.maximum(total["top"], output.reference),
            "bottom": jnp.minimum(total["bottom"], output.reference),
        }

    def result(self, total: State) -> ExtremeFigures:
        swing = total["top"] - total["bottom"]
        above = total["highest"] - total["top"]
        below = total["bottom"] - total["lowest"]
        beyond = jnp.maximum(above, below)
        moves = swing > 0.0
        overshoot = jnp.maximum(beyond, 0.0) / jnp.where(moves, swing, 1.0)
        return ExtremeFigures(total["slew"], jnp.where(moves, overshoot, 0.0))


class Chosen(Metric):
    """The figures ``names`` of a metric, as a dict; a compiler can drop the others."""

    metric: Metric
    names: tuple[str, ...] = eqx.field(static=True)

    def init(self) -> State:
        return self.metric.init()

    def update(self, total: State, index: Array, output: Sample) -> State:
        return self.metric.update(total, index, output)

    def result(self, total: State) -> dict[str, Any]:
        figures = self.metric.result(total)._asdict()
        return {name: figures[name] for name in self.names}


class MetricPair(Metric):
    """Two metrics of one run; the result is the tuple of their figures."""

    first: Metric
    second: Metric

    def init(self) -> State:
        return self.first.init(), self.second.init()

    def update(self, total: State, index: Array, output: Sample) -> State:
        return (
            self.first.update(total[0], index, output),
            self.second.update(total[1], index, output),
        )

    def result(self, total: State) -> tuple[Any, Any]:
        return self.first.result(total[0]), self.second.result(total[1])


def root(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root with slope 0 at 0; NaN gives NaN.

    The slope of sqrt at 0 is infinite, but a run without error must have gradient 0.
    """
    positive = square > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0 * square)
