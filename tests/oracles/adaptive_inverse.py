"""The learned inverse as a plain loop: least squares over all past samples."""

import numpy as np


class AdaptiveInverse:
    """Learned inverse without forgetting, with a ``feedback`` of ``control``.

    In every sample the weights are computed from all past rows and the prior as one
    further row for each weight: no recursion is shared with the tested code.
    """

    def __init__(self, feedback, weights, deviations, thresholds, **numbers):
        self.feedback = feedback
        self.thresholds = thresholds
        self.share, self.dt = numbers["share"], numbers["dt"]
        self.lead = numbers["lead"]
        self.pole = np.exp(-numbers["cutoff"] * self.dt)
        self.equation_error = numbers["equation_error"]
        self.start = np.array([0.0, *weights])
        prior = np.array([numbers["offset_deviation"], *deviations])
        self.normal = np.diag(self.equation_error**2 / prior**2)
        self.right = self.normal @ self.start
        self.lags = np.zeros((2, 2))
        self.seen = [0.0, 0.0, 0.0], np.zeros(len(thresholds))
        self.wanted = [0.0, 0.0, 0.0], np.zeros(len(thresholds))
        self.terms = np.zeros(3 + len(thresholds))
        self.fed = self.voltage = 0.0

    def _terms(self, memory, y):
        past, stops = memory
        velocity = (y - past[0]) / self.dt
        acceleration = (y - 2.0 * past[0] + past[1]) / self.dt**2
        ahead = y + self.lead * velocity
        for i, r in enumerate(self.thresholds):
            stops[i] = min(max(stops[i] + ahead - past[2], -r), r)
        past[:] = y, past[0], ahead
        return np.array([y, velocity, acceleration, *stops])

    def step(self, z, r_next, r, r_prev):
        signals = np.array([self.voltage, z])
        for lag in self.lags:
            lag += (1.0 - self.pole) * (signals - lag)
            signals = lag.copy()
        row = np.array([1.0, *self._terms(self.seen, signals[1])])
        self.normal += np.outer(row, row)
        self.right += row * signals[0]
        weights = np.linalg.solve(self.normal, self.right)[1:]
        rest = 1.0 - self.share
        left = self.feedback.step(
            z - self.share * r, rest * r_next, rest * r, rest * r_prev
        )
        terms = self._terms(self.wanted, r_next)
        self.fed += weights @ (terms - self.terms)
        self.terms = terms
        return left + self.share * self.fed

    def applied(self, u):
        self.voltage = u
        self.feedback.applied(u - self.share * self.fed)
