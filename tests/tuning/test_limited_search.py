"""Repeated searches below a limit that the exact margins miss."""

import inspect
from types import SimpleNamespace

import numpy as np
import pytest

from piezojax.core.progress import Silent
from piezojax.solve.search_state import SearchState
from piezojax.tuning import limited_search


class Limited:
    """Objective that remembers its limits."""

    def __init__(self, limits):
        self.limits = limits

    def with_limits(self, limits):
        return Limited(limits)


def repeated(monkeypatch, peaks, status="converged", strategy="a strategy"):
    """Return the limits that are searched, and the search, for exact Ms ``peaks``."""
    values, aims = iter(peaks), []

    def minimise(strategy, problem, starts, state, steps, progress):
        aims.append(problem.limits["sensitivity_peak"])
        state.status, state.evaluations = "converged", 10

    monkeypatch.setattr(limited_search, "minimise", minimise)
    monkeypatch.setattr(limited_search, "exact_stability", lambda *_: next(values))
    monkeypatch.setattr(limited_search, "_missed", lambda _, peak: peak)
    case = SimpleNamespace(
        study=SimpleNamespace(
            limits={"sensitivity_peak": 2.0, "effort": 1.0},
            optimiser=SimpleNamespace(steps=7),
        )
    )
    search = SearchState(np.array([0.5]), status=status, evaluations=5)
    tighten = inspect.unwrap(limited_search._tightened)  # its arguments are stand-ins
    return aims, tighten(Limited({}), case, search, strategy, Silent())


def test_the_limit_is_tightened_until_the_exact_one_is_kept(monkeypatch):
    aims, (search, _, stability) = repeated(monkeypatch, [3.0, 2.2, 0.0])
    # Half of the room above 1, and five sixths of that.
    assert aims == pytest.approx([1.5, 1.0 + 0.5 / 1.2])
    assert search.evaluations == 25
    assert stability == 0.0


def test_it_ends_after_three_searches_that_each_leave_some_room(monkeypatch):
    aims, _ = repeated(monkeypatch, [np.inf] * 4)
    assert aims == pytest.approx([1.3, 1.09, 1.027])


@pytest.mark.parametrize(
    "changes", [{"peaks": [0.0]}, {"status": "interrupted"}, {"strategy": None}]
)
def test_it_does_nothing_where_nothing_is_missed_or_can_be_done(monkeypatch, changes):
    aims, _ = repeated(monkeypatch, **({"peaks": [3.0]} | changes))
    assert aims == []
