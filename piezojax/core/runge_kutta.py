"""Classical Runge-Kutta step for Systems given by a differential equation."""

from collections.abc import Callable
from typing import Any

from .arrays import Scalar, ScalarLike
from .parameter import parameter

Point = tuple[Scalar, ...]


def parts_of_a_step() -> Any:
    """Return the field of the number of parts into which a step is divided."""
    return parameter(
        "1",
        "parts of a step",
        least=1.0,
        most=1000.0,
        whole=True,
        static=True,
        default=1,
    )


def runge_kutta(
    rate: Callable[[Point], Point], point: Point, step: ScalarLike, substeps: int
) -> Point:
    """Integrate ``rate`` from ``point`` over ``step``, in ``substeps`` equal parts.

    Fourth order where ``rate`` is smooth. Source: Kutta 1901.
    """
    step = step / substeps
    # Unrolled: XLA would dispatch a loop inside the loop over time kernel by kernel.
    for _ in range(substeps):
        first = rate(point)
        second = rate(_moved(point, 0.5 * step, first))
        third = rate(_moved(point, 0.5 * step, second))
        fourth = rate(_moved(point, step, third))
        point = tuple(
            x + step / 6.0 * (a + 2.0 * (b + c) + d)
            for x, a, b, c, d in zip(point, first, second, third, fourth, strict=True)
        )
    return point


def _moved(point: Point, step: ScalarLike, slopes: Point) -> Point:
    return tuple(x + step * slope for x, slope in zip(point, slopes, strict=True))
