"""Linear regression of the ARMA-based hysteresis model of chapter 3.

For a given c of the hysteresis, the model (3.32) is linear in its other parameters. A
line search finds the c with the least free-run error; the one-step error is
insensitive to c. Plain least squares takes the measured output as a regressor, so that
noise on it biases the poles. Instrumental variables use the simulated output instead.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from scipy import linalg
from scipy.optimize import minimize_scalar

from ...core.arrays import as_array, check
from ...hysteresis import HystereticARMA
from ..records.record import Record
from .free_runs import free_run
from .output_error import FAILED_LOSS
from .regressors import Orders, operator_outputs, row_matrix, rows

GRID = 9
"""Number of values of c on the coarse grid, in equal ratios between its bounds."""

PASSES = 10
"""Largest number of rounds of instrumental variables for one value of c."""

CONVERGED = 1e-7
"""Relative change of the autoregressive part below which the rounds end."""


@dataclass(frozen=True)
class RegressionFit:
    """A fitted model from V to um.

    ``simulation_rms`` and ``one_step_rms`` (unit of the output) are the errors of the
    free run and of the one-step prediction over the training part. ``standard_errors``
    has the structure of the model, with NaN where theory gives none.
    """

    model: HystereticARMA
    simulation_rms: float
    one_step_rms: float
    standard_errors: HystereticARMA


def least_squares(
    record: Record,
    structure: Orders | None = None,
    *,
    train: slice | None = None,
    c: float | tuple[float, float] | None = None,
) -> RegressionFit:
    """Fit by ordinary least squares (3.35) over the samples ``train`` (all by default).

    ``c`` (1/V) is a fixed number or a pair of search bounds. By default the bounds span
    a memory of 1/20 to 100 ranges of the input. The estimate is consistent only without
    noise on the output. The standard errors assume a white equation error; noise on the
    output makes them far too small, so prefer ``instrumental_variables``. c has no
    standard error. Raises ValueError for an empty part, c out of range, or an input
    that does not determine the coefficients.
    """
    problem = _Problem(record, structure or Orders(), _part(record, train))
    c, theta = _search(problem, problem.least_squares, c)
    return problem.estimate(c, theta, problem.equation_errors(c, theta))


def instrumental_variables(
    record: Record,
    structure: Orders | None = None,
    *,
    train: slice | None = None,
    c: float | tuple[float, float] | None = None,
) -> RegressionFit:
    """Fit by refined instrumental variables; arguments as in ``least_squares``.

    Rows and outputs are filtered by the inverse denominator. The instruments are the
    same rows with the free run of the last model in place of the measured output. The
    iteration starts from the least-squares estimate and ends when the denominator has
    converged (Young and Jakeman, Int. J. Control 29, 1979). White noise on the output
    then causes no bias, and the variance equals that of the output-error fit, whose
    standard errors s^2 (J'J)^-1 are returned, c included.
    """
    problem = _Problem(record, structure or Orders(), _part(record, train))
    c, theta = _search(problem, problem.refined, c)
    return problem.estimate(c, theta, problem.output_errors(c, theta))


def _part(record: Record, train: slice | None) -> slice:
    start, stop, _ = (train or slice(None)).indices(record.samples)
    if stop <= start:
        raise ValueError(
            f"train is {start}:{stop}; it must hold some of {record.samples} samples"
        )
    return slice(start, stop)


class _Problem:
    """Regression problem of one record, structure and training part, for any c."""

    def __init__(self, record: Record, structure: Orders, part: slice):
        samples = part.stop - part.start
        if samples <= structure.size:
            raise ValueError(
                f"train holds {samples} samples; "
                f"{structure.size} coefficients need more"
            )
        self.record, self.structure, self.part = record, structure, part
        self.input = jnp.asarray(record.input)

    def least_squares(self, c: float, _: np.ndarray | None = None) -> np.ndarray:
        matrix = rows(self.record, c, self.structure, self.record.output)[self.part]
        return _solve(matrix, matrix, self.record.output[self.part])

    def refined(self, c: float, theta: np.ndarray | None = None) -> np.ndarray:
        """Return theta for c, iterated from ``theta`` or from least squares."""
        theta = self.least_squares(c) if theta is None else theta
        order = self.structure.autoregressive
        hysteresis = operator_outputs(self.record, c, self.structure)
        for _ in range(PASSES):
            previous = theta[:order]
            theta = _stable(theta, order)
            run = self.simulated(c, theta)
            denominator = np.concatenate([[1.0], -theta[:order]])
            # The filtered output starts at the noise-free rest point of the run.
            start = np.array([run[0], run[0], *hysteresis[:, 0]])[:, None]
            signals = np.array([self.record.output, run, *hysteresis])
            moving = scipy.signal.lfilter([1.0], denominator, signals - start)
            output, run, *filtered = moving + start / denominator.sum()
            matrix, instruments = (
                row_matrix(self.structure, signal, np.array(filtered))[self.part]
                for signal in (output, run)
            )
            theta = _solve(instruments, matrix, output[self.part])
            theta[-1] *= denominator.sum()  # the filter's gain for the constant
            change = np.linalg.norm(theta[:order] - previous)
            if change <= CONVERGED * np.linalg.norm(previous):
                break
        return theta

    def error(self, c: float, theta: np.ndarray) -> np.ndarray:
        """Return the free-run error over the training part."""
        return (self.simulated(c, theta) - self.record.output)[self.part]

    def simulated(self, c: float, theta: np.ndarray) -> np.ndarray:
        """Return the free run over the whole record, [samples]."""
        run = _simulated(self.structure, as_array(c), as_array(theta), self.input)
        return np.asarray(run)

    def estimate(
        self, c: float, theta: np.ndarray, standard_errors: HystereticARMA
    ) -> RegressionFit:
        matrix = rows(self.record, c, self.structure, self.record.output)[self.part]
        one_step = matrix @ theta - self.record.output[self.part]
        return RegressionFit(
            self.structure.model(c, theta),
            _rms(self.error(c, theta)),
            _rms(one_step),
            standard_errors,
        )

    def equation_errors(self, c: float, theta: np.ndarray) -> HystereticARMA:
        """Return standard errors from s^2 (W'W)^-1 at fixed c.

        That of the offset holds to first order.
        """
        matrix = rows(self.record, c, self.structure, self.record.output)[self.part]
        error = matrix @ theta - self.record.output[self.part]
        covariance = _covariance(matrix, error)
        model = partial(self.structure.model, c)
        slopes = jax.jacfwd(lambda t: jnp.stack(_free(model(t))))(jnp.asarray(theta))
        slopes = np.asarray(slopes)
        deviations = np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))
        return _refilled(model(theta), [np.nan, *deviations[1:]])

    def output_errors(self, c: float, theta: np.ndarray) -> HystereticARMA:
        """Return standard errors from s^2 (J'J)^-1, J the Jacobian of the free run."""
        model = self.structure.model(c, theta)
        jacobian = np.asarray(_slopes(model, self.input))
        covariance = _covariance(jacobian[self.part], self.error(c, theta))
        return _refilled(model, np.sqrt(np.diag(covariance)))


@eqx.filter_jit
def _simulated(structure, c, theta, input):
    return free_run(structure.model(c, theta), input, input[0])


def _free(model: HystereticARMA) -> list:
    """Return the fitted numbers: all except the rest input."""
    return [
        model.c,
        *model.autoregressive,
        *model.moving_1,
        *model.moving_2,
        model.offset,
    ]


def _refilled(model: HystereticARMA, values) -> HystereticARMA:
    """Return ``model`` with its fitted numbers replaced, unchecked."""
    leaves = [jnp.asarray(value) for value in values]
    return eqx.tree_at(
        lambda m: [*_free(m), m.rest_input], model, [*leaves, jnp.asarray(np.nan)]
    )


@eqx.filter_jit
def _slopes(model: HystereticARMA, input: jax.Array) -> jax.Array:
    def run(values):
        changed = eqx.tree_at(_free, model, list(values))
        return free_run(changed, input, input[0])

    return jax.jacfwd(run)(jnp.stack(_free(model)))


def _solve(
    instruments: np.ndarray, matrix: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Return theta with ``instruments' (matrix theta - target) = 0``.

    An orthonormal basis of the instruments and scaled columns keep the condition number
    at that of the rows, not its square.
    """
    scale = np.linalg.norm(matrix, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    # Column-major order is four times as fast.
    columns = np.divide(instruments, scale, order="F")
    factors: Any = linalg.qr(
        columns, mode="economic", overwrite_a=True, check_finite=False
    )
    base, triangle = factors
    pivots = np.abs(np.diag(triangle))
    if not pivots.min() > 1e-14 * pivots.max():
        raise ValueError(
            "the input does not determine the coefficients; "
            "use more frequencies or fewer coefficients"
        )
    return np.linalg.lstsq(base.T @ (matrix / scale), base.T @ target)[0] / scale


def _stable(theta: np.ndarray, order: int) -> np.ndarray:
    """Return ``theta`` with poles outside the unit circle reflected into it."""
    poles = np.roots([1.0, *-theta[:order]])
    if np.all(np.abs(poles) < 1.0):
        return theta
    inside = np.where(np.abs(poles) < 1.0, poles, 0.999 / np.conj(poles))
    return np.concatenate([-np.poly(inside)[1:].real, theta[order:]])


def _covariance(jacobian: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return s^2 (J'J)^-1 for a white error, by singular value decomposition."""
    scale = np.linalg.norm(jacobian, axis=0)
    _, values, base = np.linalg.svd(jacobian / scale, full_matrices=False)
    root = base.T / values / scale[:, None]
    freedom = max(jacobian.shape[0] - jacobian.shape[1], 1)
    return root @ root.T * np.sum(error**2) / freedom


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _search(
    problem: _Problem,
    fit: Callable[..., np.ndarray],
    c: float | tuple[float, float] | None,
) -> tuple[float, np.ndarray]:
    """Return c and theta of least free-run error, by a grid and Brent's method."""
    if c is None:
        width = float(np.ptp(problem.record.input))
        c = (-20.0 / width, -0.01 / width)
    if not isinstance(c, tuple):
        check("c in 1/V", c, below=0.0)
        return c, fit(c)
    lowest, highest = c
    if not -np.inf < lowest < highest < 0.0:
        raise ValueError(
            f"c is searched from {lowest:g} to {highest:g} 1/V; "
            "both must be below 0, the lower first"
        )

    def loss(c: float, theta: np.ndarray) -> float:
        with np.errstate(over="ignore"):  # of a run that diverges
            mean_square = float(np.mean(problem.error(c, theta) ** 2))
        # The search computes with the loss, so it must be finite.
        return mean_square if mean_square < FAILED_LOSS else FAILED_LOSS

    grid = -np.geomspace(-lowest, -highest, GRID)
    fits, theta = [], None
    for value in grid:
        theta = fit(value, theta)
        fits.append(theta)
    losses = [loss(value, theta) for value, theta in zip(grid, fits, strict=True)]
    best = int(np.argmin(losses))
    if losses[best] >= FAILED_LOSS:
        raise ValueError("no c in its bounds led to a finite simulation of the record")
    found: Any = minimize_scalar(
        lambda value: loss(value, fit(value, fits[best])),
        bounds=(grid[max(best - 1, 0)], grid[min(best + 1, GRID - 1)]),
        method="bounded",
        options={"xatol": 1e-7 * abs(grid[best])},
    )
    value = float(found.x if found.fun < losses[best] else grid[best])
    return value, fit(value, fits[best])
