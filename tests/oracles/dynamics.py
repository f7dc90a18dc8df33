"""Linear dynamics: the ARMA difference equation (3.30)."""

import numpy as np


def arma(x, a, b, x_init=0.0, y_init=0.0):
    """Return the output of (3.30) without delay: x(k) acts on y(k) through b[0].

    y(k) = a[0] y(k-1) + a[1] y(k-2) + ... + b[0] x(k) + b[1] x(k-1) + ...
    Every x before sample 0 is x_init, every y before sample 0 is y_init.
    """
    inputs = np.asarray(x, dtype=float).tolist()
    outputs = []
    for k in range(len(inputs)):
        total = 0.0
        for i, coefficient in enumerate(a, start=1):
            past = outputs[k - i] if k - i >= 0 else y_init
            total += coefficient * past
        for i, coefficient in enumerate(b):
            past = inputs[k - i] if k - i >= 0 else x_init
            total += coefficient * past
        outputs.append(total)
    return np.array(outputs)
