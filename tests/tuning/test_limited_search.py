"""Repeated searches if the exact margins violate a limit."""

import inspect
from types import SimpleNamespace

import numpy as np
import pytest

from piezojax import Feedback
from piezojax.analysis.stability import (
    OperatingPoint,
    stability_report,
    stability_reports,
)
from piezojax.control import PID
from piezojax.core.about import About
from piezojax.core.error_bound import ErrorBound
from piezojax.core.progress import Silent
from piezojax.dynamics import FirstOrderLag
from piezojax.hardware import Saturation, Sensor
from piezojax.solve.search_state import SearchState
from piezojax.tuning import limited_search
from piezojax.tuning.evaluator import Carried
from piezojax.tuning.model_alarms import model_alarms

DT = 1e-4


def integral_loop(integral):
    return Feedback(
        PID(0.0, integral, dt=DT),
        FirstOrderLag(2e-4, DT),
        Saturation(-10.0, 10.0),
        Sensor(0.0),
    )


class Limited:
    """Objective that records its limits and the plants of its margins."""

    def __init__(self, limits, stages="first"):
        self.limits, self.stages = limits, stages

    def with_limits(self, limits):
        return Limited(dict(limits), self.stages)

    def on_margin_stages(self, stages):
        return Limited(self.limits, stages)


def repeated(monkeypatch, peaks, plants=(), status="converged", strategy="a strategy"):
    """Return the limits and plants of each search, and the result.

    ``peaks`` are the exact Ms; ``plants`` are the largest excess, Ms of the carried
    plants and the worst plants.
    """
    values, found, searched = iter(peaks), iter(plants), []

    def minimise(strategy, problem, starts, state, steps, progress):
        searched.append((problem.limits.get("sensitivity_peak"), problem.stages))
        state.status, state.evaluations = "converged", 10

    monkeypatch.setattr(limited_search, "minimise", minimise)
    monkeypatch.setattr(limited_search, "exact_stability", lambda *_: next(values))
    monkeypatch.setattr(limited_search, "_alarming_peak", lambda _, peak: peak)
    case = SimpleNamespace(
        study=SimpleNamespace(
            limits={"sensitivity_peak": 2.0, "effort": 1.0},
            optimiser=SimpleNamespace(steps=7),
        ),
        ensemble=None,
        space=SimpleNamespace(put=lambda loop, unit: loop),
        loop=None,
    )
    evaluator = SimpleNamespace(
        worst_plants=lambda *_: Carried(*next(found, (0.0, 0.0, None)), np.empty(0))
    )
    search = SearchState(
        np.array([0.5]), status=status, evaluations=5, warnings=["the start diverges"]
    )
    for name in ("_descent", "_repeated"):  # with replaced arguments
        unchecked = inspect.unwrap(getattr(limited_search, name))
        monkeypatch.setattr(limited_search, name, unchecked)
    return searched, limited_search._repeated(
        Limited({}), case, evaluator, None, search, strategy, Silent()
    )


def test_the_limit_is_tightened_until_the_exact_one_is_kept(monkeypatch):
    searched, found = repeated(monkeypatch, [3.0, 2.2, 0.0])
    # half of the difference to 1, then five sixths of that
    assert [aim for aim, _ in searched] == pytest.approx([1.5, 1.0 + 0.5 / 1.2])
    _, search, _, stability = found
    assert search.evaluations == 25
    assert search.warnings == ["the start diverges"]
    assert stability == 0.0


def test_the_search_ends_after_five_repetitions(monkeypatch):
    searched, _ = repeated(monkeypatch, [np.inf] * 6)
    aims = 1.0 + 0.3 ** np.arange(1, 6)
    assert [aim for aim, _ in searched] == pytest.approx(aims)


def test_the_search_is_repeated_until_no_plant_violates_a_limit(monkeypatch):
    plants = [(0.2, 0.0, "second"), (1.1e-3, 0.0, "third"), (9e-4, 0.0, "fourth")]
    searched, (objective, *_) = repeated(monkeypatch, [0.0] * 4, plants)
    assert searched == [(None, "second"), (None, "third")]
    assert objective.stages == "third"


def test_plants_and_limits_change_in_the_same_search(monkeypatch):
    searched, _ = repeated(monkeypatch, [3.0, 0.0], [(0.2, 0.0, "second")])
    assert searched == [(1.5, "second")]


def test_the_limit_is_tightened_where_a_carried_plant_rings_longer(monkeypatch):
    plants = [(0.2, 2.6, "second"), (0.1, 2.2, None)]
    searched, _ = repeated(monkeypatch, [0.0] * 3, plants)
    aims = 1.0 + 1.0 / 1.6, 1.0 + 1.0 / 1.6 / 1.2
    assert searched == [(pytest.approx(aim), "second") for aim in aims]


@pytest.mark.parametrize(
    "changes",
    [
        {"peaks": [0.0], "plants": [(1e-4, 0.0, "second")]},
        {"status": "interrupted"},
        {"strategy": None},
    ],
)
def test_the_search_is_not_repeated_without_need_or_remedy(monkeypatch, changes):
    searched, _ = repeated(monkeypatch, **({"peaks": [3.0]} | changes))
    assert searched == []


def alarming_peak(loop, bound=None, **limits):
    """Return the Ms that repeats the search of a study with one ``loop``."""
    case = SimpleNamespace(
        study=SimpleNamespace(limits=limits),
        plant_about=SimpleNamespace(error_bound=bound),
    )
    stability = stability_reports({"after": loop}, 1.0, DT)
    return inspect.unwrap(limited_search._alarming_peak)(case, stability)


def test_an_exact_peak_with_an_alarm_repeats_the_search():
    loop = integral_loop(4000.0)
    exact = stability_report(loop, OperatingPoint(1.0, dt=DT)).sensitivity_peak
    assert alarming_peak(loop, sensitivity_peak=0.98 * exact) == pytest.approx(exact)
    assert alarming_peak(loop, sensitivity_peak=exact) == 0.0
    assert alarming_peak(loop) == 0.0
    assert alarming_peak(integral_loop(1e5), sensitivity_peak=2.0) == np.inf


def test_the_error_bound_of_the_plant_is_included():
    loop = integral_loop(4000.0)
    exact = stability_report(loop, OperatingPoint(1.0, dt=DT)).sensitivity_peak
    bound = ErrorBound(frequency=(1.0, 5e3), relative=(0.3, 0.3), excited=(True, True))
    found = alarming_peak(loop, bound, sensitivity_peak=1.01 * exact)
    assert found > 1.1 * exact


def test_beyond_the_band_of_a_narrow_record_the_search_is_not_repeated():
    """Other gains cannot help there; the alarm remains."""
    loop = integral_loop(4000.0)
    exact = stability_report(loop, OperatingPoint(1.0, dt=DT)).sensitivity_peak
    narrow = ErrorBound(
        frequency=(1.0, 20.0, 25.0, 5e3),
        relative=(0.01, 0.01, 50.0, 50.0),
        excited=(True, True, False, False),
    )
    limit = 1.05 * exact
    assert alarming_peak(loop, narrow, sensitivity_peak=limit) == 0.0
    stability = stability_reports({"after": loop}, 1.0, DT)
    (alarm,) = model_alarms(About(error_bound=narrow), False, limit, stability)
    assert "the record excites nothing" in alarm
    wide = narrow.model_copy(update={"excited": (True,) * 4})
    assert alarming_peak(loop, wide, sensitivity_peak=limit) == np.inf
