"""Array types, and the conversions and checks of constructors."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

if TYPE_CHECKING:
    # Constructors convert numbers to arrays. A type checker knows of this conversion
    # only where the field names its converter.
    Scalar = Any
    Scalars = Any
    Matrix = Any
else:
    Scalar = Float[Array, ""]
    Scalars = tuple[Scalar, ...]
    Matrix = Float[Array, "rows columns"]
ScalarLike = Float[Array, ""] | float | int
Signal = Any  # a Scalar, or a tuple with one Scalar per axis
State = Any  # a pytree of arrays; every System defines its own


def as_array(value: Any) -> Array:
    """Return ``value`` as a float64 array.

    Raises ValueError for an integer beyond the range of a float.
    """
    try:
        return jnp.asarray(value, dtype=jnp.float64)
    except OverflowError:
        raise ValueError(_TOO_LARGE) from None


_TOO_LARGE = "an integer is too large; the largest number is 1.8e308"


def as_scalars(values: Iterable[Any]) -> tuple[Array, ...]:
    """Return ``values`` as a tuple of float64 scalars.

    XLA keeps scalars in registers inside the loop; a packed array would not stay there.
    """
    return tuple(as_array(value) for value in values)


def as_signal(value: Any) -> Any:
    """Return a number as a scalar, and a vector or sequence as a tuple of scalars."""
    if isinstance(value, tuple | list) or jnp.ndim(value) == 1:
        return as_scalars(value)
    return as_array(value)


def largest(values: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the largest of ``values``, with the derivative of that element.

    The derivative of ``jnp.max`` looks for the elements that equal the result. If XLA
    computes them a second time and rounds differently, it finds none and returns NaN.
    """
    place = jnp.argmax(jax.lax.stop_gradient(values), axis=-1, keepdims=True)
    return jnp.take_along_axis(values, place, axis=-1)[..., 0]


def smallest(values: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the smallest of ``values``, with the derivative of that element."""
    return -largest(-values)


def as_matrix(value: Any) -> Array:
    """Return ``value`` as a float64 matrix.

    Raises ValueError unless ``value`` holds rows of numbers of one length.
    """
    try:
        matrix = as_array(value)
    except (TypeError, ValueError):
        raise ValueError("a matrix must be rows of numbers of one length") from None
    if matrix.ndim != 2:
        raise ValueError(f"a matrix has shape {matrix.shape}; it must be 2-dimensional")
    return matrix


def concrete(value: Any) -> np.ndarray | None:
    """Return ``value`` as a NumPy array, or None for a JAX tracer."""
    if isinstance(value, Tracer):
        return None
    number = np.asarray(value)
    if number.dtype != object:
        return number
    try:
        return number.astype(float)  # integers of more than 64 bits
    except OverflowError:
        raise ValueError(_TOO_LARGE) from None


def check(
    name: str,
    value: Any,
    *,
    above: float = -np.inf,
    least: float = -np.inf,
    most: float = np.inf,
    below: float = np.inf,
) -> None:
    """Raise ValueError unless ``value`` is finite and inside the stated bounds.

    ``value`` is a number, an array or a nested sequence of them. ``above`` and
    ``below`` are exclusive, ``least`` and ``most`` inclusive. Traced values are not
    checked, because their numbers are not known yet.
    """
    for element in jax.tree.leaves(value):
        number = concrete(element)
        if number is None:
            continue
        inside = (
            (number > above) & (number >= least) & (number <= most) & (number < below)
        )
        if not (np.all(np.isfinite(number)) and np.all(inside)):
            bounds = [
                f"{word} {bound:g}"
                for word, bound in (
                    ("above", above),
                    ("at least", least),
                    ("at most", most),
                    ("below", below),
                )
                if np.isfinite(bound)
            ]
            allowed = " and ".join(["finite", *bounds])
            raise ValueError(f"{name} is {_formatted(number)}; it must be {allowed}")


def check_not_zero(name: str, value: Any) -> None:
    """Raise ValueError if ``value`` is zero; traced values are not checked."""
    number = concrete(value)
    if number is not None and np.any(number == 0.0):
        raise ValueError(f"{name} is 0; it must be another number")


def check_option(name: str, value: Any, allowed: Iterable[Any]) -> None:
    """Raise ValueError unless ``value`` of the option ``name`` is among ``allowed``."""
    known = tuple(allowed)
    if value not in known:
        shown = ", ".join(map(str, known))
        raise ValueError(f"{name} is {value!r}; it must be one of {shown}")


def check_order(
    low_name: str, low: Any, high_name: str, high: Any, *, equal: bool = False
) -> None:
    """Raise ValueError unless ``low < high``; with ``equal``, unless ``low <= high``.

    Traced values are not checked.
    """
    lower, upper = concrete(low), concrete(high)
    if lower is None or upper is None:
        return
    if not np.all(lower <= upper if equal else lower < upper):
        raise ValueError(
            f"{low_name} is {_formatted(lower)} and "
            f"{high_name} is {_formatted(upper)}; "
            f"{low_name} must be {'at most' if equal else 'below'} {high_name}"
        )


def _formatted(number: np.ndarray) -> str:
    if number.ndim == 0:
        return f"{number:g}"
    return " ".join(np.array2string(number, threshold=6).split())
