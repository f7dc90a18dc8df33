"""The Preisach model, by relays and by lines of relays of one width.

The triangle of the weights: alpha in cell i and beta in cell j of n equal cells
between low and high, j <= i. The weight of a cell lies evenly on its diagonal, from
its corner of least alpha and beta to that of most.
"""

import itertools

import numpy as np
from scipy.optimize import brentq

from .control import PIDSMC


class Relays:
    """Relays that are stepped separately: `parts` of them in each cell.

    Without `rest` all are down initially; else those are up whose mean of alpha and
    beta is below rest.
    """

    def __init__(self, weights, low, high, parts, rest=None):
        cells = len(weights)
        size = (high - low) / cells
        self.alpha, self.beta, self.weight = [], [], []
        for i in range(cells):
            for j in range(i + 1):
                for m in range(parts):
                    along = (m + 0.5) / parts
                    self.alpha.append(low + size * (i + along))
                    self.beta.append(low + size * (j + along))
                    self.weight.append(weights[i][j] / parts)
        if rest is None:
            self.up = [False] * len(self.weight)
        else:
            self.up = [
                (a + b) / 2 < rest for a, b in zip(self.alpha, self.beta, strict=True)
            ]

    def output(self, input):
        """Switch the relays by the input; return the weights of those that are up."""
        total = 0.0
        for r in range(len(self.up)):
            if input < self.beta[r]:
                self.up[r] = False
            elif input > self.alpha[r]:
                self.up[r] = True
            if self.up[r]:
                total += self.weight[r]
        return total


def along(weights, low, high, parts, inputs, rest=None):
    """Return the output of the relays along the inputs minus that of all down."""
    relays = Relays(weights, low, high, parts, rest)
    return np.array([relays.output(u) for u in inputs])


class Lines:
    """Infinitely many such relays, by plays: their output and its inverse.

    A line of relays with half-width r = (alpha - beta)/2 is up as far as a play of
    that half-width; its weight below w is linear between the corners of the cells.
    """

    def __init__(self, weights, low, high, rest):
        cells = len(weights)
        size = (high - low) / cells
        self.low, self.high = low, high
        self.r = [0.5 * size * k for k in range(cells)]
        self.knots = [low + r + size * np.arange(cells - k + 1) for k, r in self.lines]
        self.below = [
            [0.0, *itertools.accumulate(weights[j + k][j] for j in range(cells - k))]
            for k in range(cells)
        ]
        self.w = [rest] * cells

    @property
    def lines(self):
        return enumerate(self.r)

    def moved(self, input):
        """Return the outputs of the plays after `input`."""
        return [
            min(max(w, input - r), input + r)
            for w, r in zip(self.w, self.r, strict=True)
        ]

    def output(self, input):
        """Return the output after `input` without storing it."""
        parts = zip(self.moved(input), self.knots, self.below, strict=True)
        return sum(float(np.interp(w, x, y)) for w, x, y in parts)

    def inverse(self, wanted):
        """Return the input whose output is `wanted`."""
        return brentq(
            lambda u: self.output(u) - wanted, self.low, self.high, xtol=1e-13
        )


class PreisachInversion(PIDSMC):
    """PID-SMC that commands a hysteresis output, with an inverse Preisach model."""

    def __init__(self, gains, rate, lines, lowest):
        super().__init__("inversion", gains, rate)
        self.lines, self.lowest = lines, lowest

    def step(self, z, r_next, r, r_prev):
        """The command u(k), not yet clipped."""
        f = self.optimal_inverse(self.sliding_mode(z, r_next, r, r_prev))
        self.f1, self.f2 = f, self.f1
        return self.lines.inverse(f - self.lowest)

    def applied(self, u):
        """Move the model by the applied voltage."""
        super().applied(u)
        self.lines.w = self.lines.moved(u)
