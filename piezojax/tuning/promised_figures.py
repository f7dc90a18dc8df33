"""Errors of the promised figures of a loop that errors of its plant cause."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.constraints import CONSTRAINTS
from ..analysis.stability.operating_point import OperatingPoint
from ..core.arrays import as_array
from ..core.feedback import Feedback
from ..identification.information import Unknowns
from ..study import Case
from .data import make_data
from .objective import margins_on
from .runs import Signals, sampled

LOGGED = 2000
"""Largest number of samples of a run at which its error is differentiated."""


class PromisedFigure(NamedTuple):
    """A figure of a tuned loop: name, ``value`` in ``unit``, and its sensitivity.

    With the covariance C of the changes of the plant's parameters, the relative
    variance of the figure is trace(``sensitivity`` C), to first order.
    """

    name: str
    value: float
    unit: str
    sensitivity: Float[np.ndarray, "n n"]

    def relative_error(self, covariance: Float[np.ndarray, "n n"]) -> float:
        """Return the standard error of the figure, relative to its value."""
        return float(np.sqrt(np.trace(self.sensitivity @ covariance)))


def promised_figures(
    case: Case, loop: Feedback, unknowns: Unknowns
) -> list[PromisedFigure]:
    """Return the figures of ``loop`` that depend on the ``unknowns`` of its plant.

    They are the rms tracking error of each reference of ``case``, and each limited
    margin. The error of a reference is a signal; the rms value of its change, relative
    to its own rms value, counts as the relative error of the figure.
    """
    start = jnp.zeros(len(unknowns.paths))
    data, study = make_data(case), case.study
    # The plant of each change rests at its own input.
    quiet = jax.tree.map(lambda x: x[:, :1], data.holdout.run_noise)
    signals = dataclasses.replace(data.holdout, **quiet._asdict(), holding=None)
    every = max(2, signals.references.shape[1] // LOGGED)
    errors, slopes = _errors(unknowns, loop, signals, study.settled, every, start)
    found = []
    for name, error, slope in zip(data.names, errors, slopes, strict=True):
        rms = float(np.sqrt(np.mean(error**2)))
        relative = slope / (rms * np.sqrt(len(slope)))
        found.append(PromisedFigure(name, 1e3 * rms, "nm", relative.T @ relative))
    limits = tuple(n for n in study.limits if CONSTRAINTS[n].source == "margins")
    if limits:
        reference = as_array(case.margin_reference)
        times = study.dt, case.margin_duration
        values, slope_of = _margins(unknowns, loop, limits, reference, *times, start)
        for name in limits:
            slope = np.asarray(slope_of[name])
            value = float(np.exp(values[name]))
            unit = CONSTRAINTS[name].unit
            found.append(PromisedFigure(name, value, unit, np.outer(slope, slope)))
    return found


@eqx.filter_jit
def _errors(
    unknowns: Unknowns,
    loop: Feedback,
    signals: Signals,
    first: int,
    every: int,
    changes: Array,
) -> tuple[Array, Array]:
    """Return errors [references, samples], and their derivatives [..., n]."""

    def errors(changes: Array) -> tuple[Array, Array]:
        _, found = sampled(
            lambda changes: dataclasses.replace(loop, plant=unknowns.at(changes)),
            changes,
            signals,
            first,
            every=every,
        )
        assert found is not None
        return found[:, 0], found[:, 0]

    slopes, found = jax.jacfwd(errors, has_aux=True)(changes)
    return found, slopes


@eqx.filter_jit
def _margins(
    unknowns: Unknowns,
    loop: Feedback,
    limits: tuple[str, ...],
    reference: Array,
    dt: float,
    duration: float,
    changes: Array,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the logarithms of the worst margins, and their derivatives [n]."""

    def logarithms(changes: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        changed = dataclasses.replace(loop, plant=unknowns.at(changes))
        point = OperatingPoint(reference, dt=dt)
        margins = margins_on(limits, lambda _: changed, None, point, None, duration)
        found = {
            name: jnp.log(CONSTRAINTS[name].worst(margins[name])) for name in limits
        }
        return found, found

    slopes, found = jax.jacfwd(logarithms, has_aux=True)(changes)
    return found, slopes
