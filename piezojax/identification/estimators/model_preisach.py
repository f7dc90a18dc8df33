"""Fit of a Preisach model with a lag, with as many cells as the record determines."""

import itertools
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from ...core.arrays import as_array
from ...core.paths import parameters, replace
from ...core.space import Range, space_of
from ...core.system import Series, series
from ...dynamics import FirstOrderLag
from ...hysteresis import Preisach, RateDependentPreisach
from ...hysteresis.play_lines import line_by_line
from ...hysteresis.preisach import STARTS
from ..records.record import Record
from .estimate import bound_warning
from .free_runs import from_rest
from .preisach_density import (
    empty,
    fit_preisach,
    fit_rate_dependent_preisach,
    responses,
)
from .standard_errors import standard_errors

_free_run = eqx.filter_jit(from_rest)

Model = Preisach | RateDependentPreisach

PLAIN, RATE_DEPENDENT = "preisach", "rate_dependent_preisach"
"""The models' names; the second one has two densities, blended by the rate."""

CELLS = range(3, 11)
"""Allowed numbers of cells per side."""

LEAST_EFFECT = 1e-3
"""Least rms change of the output (um) for a change of the weights of norm 1 um, in the
direction of least effect. Below it, a nanometre of output would determine more than a
micrometre of weight."""

TOO_FEW = {
    PLAIN: "the turning points of the training part do not distinguish even the cells "
    f"of a Preisach triangle with {CELLS[0]} cells per side",
    RATE_DEPENDENT: "the turning points and rates of the training part do not "
    "distinguish even the cells of two Preisach triangles with "
    f"{CELLS[0]} cells per side",
}
"""Reasons why a record supports no such model."""

LAGS = (0.05, 50.0)
"""Bounds of the lag, samples."""

LAG = 1.5
"""Start of the search for the lag, samples."""

RATES = (0.1, 10.0)
"""Bounds of the rate at which both densities have equal shares, as multiples of the rms
rate of the input."""

FIRST_RATES = (0.3, 1.0, 3.0)
"""Candidate starting values of that rate, in the same unit."""

STEP = 1e-4
"""Relative change of a lag or a rate in the finite differences of the output."""

CONVERGED = 1e-5
"""Change of the logarithms at which the search ends, far below standard errors."""

STEPS = 20
"""Largest number of steps of that search."""


class Chain(NamedTuple):
    """A Preisach model followed by a lag."""

    hysteresis: Model
    lag: FirstOrderLag

    def system(self) -> Series:
        """Return both as one plant."""
        return series(hysteresis=self.hysteresis, lag=self.lag)


class SearchParameter(NamedTuple):
    """A positive search parameter: name, range and candidate starting values."""

    name: str
    range: Range
    firsts: tuple[float, ...]


class PreisachFit(NamedTuple):
    """Fitted plant, its parameters by name, their standard errors, and warnings."""

    system: Series
    values: dict[str, float]
    deviations: list[float | None]
    warnings: list[str]


def distinguishable_cells(record: Record, train: slice, model: str = PLAIN) -> int:
    """Return the number of cells per side that the samples ``train`` determine, or 0.

    They must do so for each of the assumed histories before the record (STARTS).
    """
    seen = _delayed_input(record.until(train.stop))
    return next(
        (
            cells
            for cells in reversed(CELLS)
            if all(_determines(seen, train, model, cells, start) for start in STARTS)
        ),
        0,
    )


def _determines(
    record: Record, train: slice, model: str, cells: int, start: str
) -> bool:
    shape = empty(record, cells, None, start)
    if model == RATE_DEPENDENT:
        shape = RateDependentPreisach(
            shape, shape.weights, _rms_rate(record), record.dt
        )
    rows = responses(shape, record.input, None, train)
    strength = np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False)
    least = LEAST_EFFECT * np.sqrt(len(rows))
    return len(rows) >= rows.shape[1] and bool(strength[-1] >= least)


def preisach_with_lag(record: Record, train: slice, model: str) -> PreisachFit:
    """Return the Preisach model and lag whose free run fits ``record`` best.

    For each lag (and rate) the weights are those of ``fit_preisach`` (or
    ``fit_rate_dependent_preisach``), so the search is over the lag (and rate) only. It
    takes the better of both histories before the record, virgin and saturated. Raises
    ValueError as those functions do, and if the record determines too few cells.
    """
    cells = distinguishable_cells(record, train, model)
    if not cells:
        raise ValueError(TOO_FEW[model])
    seen = record.until(train.stop)
    problem = _Problem(seen, _delayed_input(seen), train, cells)
    unknowns = _unknowns(problem.shifted, model)
    optima = {start: problem.optimum(unknowns, start) for start in STARTS}
    start = min(STARTS, key=lambda start: optima[start].cost)
    logs, warnings = optima[start].x, _at_edges(unknowns, optima[start].x)
    if not optima[start].status:
        warnings.append(f"lag and rate had not converged after {STEPS} steps")
    chain = problem.fitted(logs, start)
    searched = {u.name: float(v) for u, v in zip(unknowns, np.exp(logs), strict=True)}
    return PreisachFit(
        chain.system(),
        _named(chain.hysteresis, cells) | searched,
        problem.deviations(chain, searched),
        warnings,
    )


class _Problem(NamedTuple):
    """A record up to the end of the training part, and the same with its input
    delayed."""

    seen: Record
    shifted: Record
    train: slice
    cells: int

    def fitted(self, logs: np.ndarray, start: str) -> Chain:
        """Return the model with the best weights at logarithms of the unknowns."""
        lag, *rate = (float(value) for value in np.exp(logs))
        dynamics = FirstOrderLag(lag, self.seen.dt)
        fit = fit_rate_dependent_preisach if rate else fit_preisach
        hysteresis = fit(
            self.shifted,
            *rate,
            cells=self.cells,
            train=self.train,
            dynamics=dynamics.as_arma(),
            start=start,
        )
        return Chain(hysteresis, dynamics)

    def errors(self, system: Series) -> np.ndarray:
        """Return the errors of the free run over the training part, um."""
        run = np.asarray(_free_run(system, as_array(self.seen.input)))
        return (run - self.seen.output)[self.train]

    def reduced(self, logs: np.ndarray, start: str) -> np.ndarray:
        """Return the errors with the best weights."""
        return self.errors(self.fitted(logs, start).system())

    def slopes(self, logs: np.ndarray, start: str) -> np.ndarray:
        """Return the slopes of ``reduced``, one column per unknown."""
        here = self.reduced(logs, start)
        moved = [self.reduced(logs + s, start) for s in STEP * np.eye(logs.size)]
        return (np.column_stack(moved) - here[:, None]) / STEP

    def optimum(self, unknowns: list[SearchParameter], start: str) -> OptimizeResult:
        """Return the optimum of the search with the history ``start``."""

        def loss(logs: np.ndarray) -> float:
            return float(np.sum(self.reduced(logs, start) ** 2))

        firsts = map(np.log, itertools.product(*(u.firsts for u in unknowns)))
        bounds = np.log([[u.range.lower, u.range.upper] for u in unknowns]).T
        options = {"jac": self.slopes, "bounds": bounds, "args": (start,)}
        ending = {"xtol": CONVERGED, "max_nfev": STEPS}
        first = min(firsts, key=loss)
        return least_squares(self.reduced, first, **options, **ending)

    def deviations(
        self, chain: Chain, searched: dict[str, float]
    ) -> list[float | None]:
        """Return standard errors of weights, lowest output and searched parameters."""
        system = chain.system()
        left = self.errors(system)
        moved = [
            (self.errors(replace(system, {name: value * (1.0 + STEP)})) - left)
            / (value * STEP)
            for name, value in searched.items()
        ]
        rows = responses(
            chain.hysteresis, self.shifted.input, chain.lag.as_arma(), self.train
        )
        jacobian = np.column_stack([rows, np.ones(left.size), *moved])
        freedom = max(left.size - jacobian.shape[1], 1)
        return standard_errors(jacobian.T @ jacobian, float(np.sum(left**2)) / freedom)


def _unknowns(record: Record, model: str) -> list[SearchParameter]:
    """Return the parameters to search for, in the order of ``fitted``."""
    found = [
        SearchParameter(
            "lag.time_constant",
            Range(LAGS[0] * record.dt, LAGS[1] * record.dt, "log", unit="s"),
            (LAG * record.dt,),
        )
    ]
    if model == RATE_DEPENDENT:
        rate = _rms_rate(record)
        firsts = tuple(rate * first for first in FIRST_RATES)
        found.append(
            SearchParameter(
                "hysteresis.rate",
                Range(RATES[0] * rate, RATES[1] * rate, "log", unit="V/s"),
                firsts,
            )
        )
    return found


def _named(hysteresis: Model, cells: int) -> dict[str, float]:
    """Return the weights and the lowest output, in the order of the responses."""
    known = parameters(hysteresis, "hysteresis.")
    values = {
        f"{name}.{i}.{j}": float(leaf[i, j])
        for name, leaf in known.items()
        if leaf.ndim == 2
        for i, j in line_by_line(cells)
    }
    return values | {
        name: float(leaf) for name, leaf in known.items() if name.endswith(".lowest")
    }


def _at_edges(unknowns: list[SearchParameter], logs: np.ndarray) -> list[str]:
    space = space_of({u.name: u.range for u in unknowns})
    places = space.to_unit(as_array(np.exp(logs)))
    return [
        text
        for name, place in zip(space.paths, places, strict=True)
        for text in bound_warning(name, float(place))
    ]


def _rms_rate(record: Record) -> float:
    """Return the rms rate of the input, V/s."""
    return float(np.sqrt(np.mean(np.diff(record.input) ** 2))) / record.dt


def _delayed_input(record: Record) -> Record:
    """Return ``record`` with its input delayed by a sample.

    A plant maps u(k) to y(k+1).
    """
    input = np.concatenate([record.input[:1], record.input[:-1]])
    return Record(input, record.output, record.dt)
