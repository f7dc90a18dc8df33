"""Model (3.32) of chapter 3 and the rows of its regression (3.33), in plain loops."""

import numpy as np

from . import hysteresis


def _past(values, k):
    """Return values[k], or the first value before the record."""
    return values[max(k, 0)]


def operators(x, c, scheme, x_init=0.0):
    """Return y_1 (a = 1, b = 0) and y_2 (a = 0, b = 1) of the voltages x."""
    run = {
        "trapezoid": hysteresis.trapezoid,
        "quadratic": hysteresis.quadratic,
        "voros": hysteresis.voros,
    }[scheme]
    return run(x, 1.0, 0.0, c, x_init), run(x, 0.0, 1.0, c, x_init)


def rows(x, z, c, scheme):
    """Return rows [z(k-1), z(k-2), y_1(k-1 .. k-3), y_2(k-1 .. k-3), 1], k < N.

    The last entries of each row follow (3.33) with its last row corrected, and with one
    sample between voltage and displacement.
    """
    first, second = operators(x, c, scheme)
    table = []
    for k in range(len(x)):
        row = [_past(z, k - 1), _past(z, k - 2)]
        row += [_past(first, k - i) for i in (1, 2, 3)]
        row += [_past(second, k - i) for i in (1, 2, 3)]
        table.append([*row, 1.0])
    return np.array(table)


def model(x, c, a, b1, b2, scheme, offset=0.0, x_init=0.0):
    """Return z of (3.32) plus an offset, b[0] at the same sample, from rest at zero."""
    first, second = operators(x, c, scheme, x_init)
    outputs = []
    for k in range(len(x)):
        total = 0.0
        for i, coefficient in enumerate(a, start=1):
            total += coefficient * (outputs[k - i] if k >= i else 0.0)
        for i, (one, two) in enumerate(zip(b1, b2, strict=True)):
            if k >= i:
                total += one * first[k - i] + two * second[k - i]
        outputs.append(total)
    return np.array(outputs) + offset
