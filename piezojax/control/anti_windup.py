"""Declaration of the rate of anti-windup by back-calculation."""

from typing import Any

from ..core.parameter import parameter


def anti_windup() -> Any:
    """Return the field of a back-calculation rate in 1/s, 0 by default.

    The integral of a controller moves at this rate times the difference of the applied
    and the last commanded output (Astrom and Hagglund, Advanced PID Control, 2006).
    """
    return parameter(
        "1/s",
        "rate of anti-windup; 0 switches it off",
        least=0.0,
        scale="log",
        typical=(1e-1, 1e4),
        default=0.0,
    )
