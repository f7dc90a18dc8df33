"""The classical Runge-Kutta step, for Systems that are given as a rate of change."""

from collections.abc import Callable

from .arrays import Scalar, ScalarLike

Point = tuple[Scalar, ...]


def runge_kutta(
    rate: Callable[[Point], Point], point: Point, step: ScalarLike, substeps: int
) -> Point:
    """Return ``point`` after ``step`` along ``rate``, in ``substeps`` equal parts.

    Fourth order where ``rate`` is smooth. Source: Kutta 1901.
    """
    step = step / substeps
    # Unrolled: a loop inside the loop over time would be dispatched piece by piece.
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


def _moved(point: Point, by: ScalarLike, along: Point) -> Point:
    return tuple(x + by * slope for x, slope in zip(point, along, strict=True))
