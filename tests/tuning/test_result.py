"""Outcomes of constraints and summaries of plants, from given numbers."""

import math

import numpy as np
import pytest

from piezojax.analysis.loop_figures import LoopFigures
from piezojax.core.metrics import TrackingFigures
from piezojax.tuning.held_out import HeldOut
from piezojax.tuning.make_result import _perturbed
from piezojax.tuning.result import ConstraintOutcome, Perturbed


def outcome(name, values, limit):
    return ConstraintOutcome.of_values(name, limit, np.array(values))


@pytest.mark.parametrize(
    ("values", "limit", "kept", "active", "on", "worst"),
    [
        ([1.2, 1.9], 2.0, True, False, 2, 1.9),
        ([1.2, 1.97], 2.0, True, True, 2, 1.97),
        ([1.2, 2.001], 2.0, True, True, 2, 2.001),
        ([1.2, 1.93], 2.0, True, False, 2, 1.93),
        ([1.2, 2.003], 2.0, False, False, 1, 2.003),
        ([1.2, 2.01], 2.0, False, False, 1, 2.01),
        ([1.2, math.nan], 2.0, False, False, 1, None),
        ([0.5, 0.02], 2.0, True, False, 2, 0.5),
    ],
)
def test_an_upper_limit(values, limit, kept, active, on, worst):
    found = outcome("sensitivity_peak", values, limit)
    assert (found.kept, found.active, found.on, found.of) == (kept, active, on, 2)
    assert found.value == worst


@pytest.mark.parametrize(
    ("values", "kept", "active", "on", "worst"),
    [
        ([9.0, 2.2], True, False, 2, 2.2),
        ([9.0, 2.03], True, True, 2, 2.03),
        ([9.0, 1.999], True, True, 2, 1.999),
        ([9.0, 1.997], False, False, 1, 1.997),
        ([9.0, 1.99], False, False, 1, 1.99),
        ([-math.inf, 9.0], False, False, 1, None),
    ],
)
def test_a_lower_limit(values, kept, active, on, worst):
    found = outcome("delay_margin", values, 2.0)
    assert (found.kept, found.active, found.on, found.of) == (kept, active, on, 2)
    assert found.value == worst


def figures(rms, saturated=0.0):
    """Return figures [plants, traces, draws] with the given RMS errors."""
    rms = np.array(rms, dtype=float)
    nothing = np.zeros_like(rms)
    names = [name for name in TrackingFigures._fields if name != "rms_error"]
    fields = dict.fromkeys(names, nothing) | {"saturated": nothing + saturated}
    tracking = TrackingFigures(rms_error=rms, **fields)
    return LoopFigures(tracking, None, None, None, dt=1e-4)


DRIVEN = np.array([True, True, False])
BEFORE = [[[4.0], [9.0], [2.0]], [[1.0], [1.0], [3.0]], [[2.0], [math.inf], [1.0]]]
AFTER = [[[1.0], [4.0], [1.0]], [[math.inf], [1.0], [1.0]], [[2.0], [8.0], [1.0]]]


def test_a_summary_of_plants():
    found = Perturbed.of(figures(BEFORE), figures(AFTER), DRIVEN, {})
    assert (found.plants, found.unstable_before, found.unstable) == (3, 1, 1)
    # Plants 0 and 2 are stable after tuning, only plant 0 before and after.
    assert found.geomean_rms_um == pytest.approx(np.median([2.0, 4.0]))
    assert found.worst_rms_um == pytest.approx(4.0)
    assert found.median_better == pytest.approx(3.0)
    assert found.worst_better == pytest.approx(3.0)
    assert found.coupling_better == pytest.approx(2.0)
    assert found.geomeans_um == [pytest.approx(2.0), None, pytest.approx(4.0)]
    assert found.geomeans_before_um == [pytest.approx(6.0), pytest.approx(1.0), None]
    assert found.geomean_before_rms_um is None
    stable = Perturbed.of(figures(BEFORE[:2]), figures(AFTER[:2]), DRIVEN, {})
    assert stable.geomean_before_rms_um == pytest.approx(3.5)
    without = stable.model_copy(update={"geomeans_before_um": []})
    assert without.geomean_before_rms_um is None


def held_out(perturbed):
    """Return a HeldOut with these figures on perturbed plants, and nothing else."""
    found = object.__new__(HeldOut)
    vars(found)["perturbed"] = perturbed
    return found


def test_only_figures_before_and_after_give_a_summary():
    before, after = (held_out(figures(x)) for x in (BEFORE, AFTER))
    found = _perturbed(before, after, DRIVEN, {})
    expected = Perturbed.of(figures(BEFORE), figures(AFTER), DRIVEN, {})
    assert found.model_dump_json() == expected.model_dump_json()
    none = held_out(None)
    for pair in ((before, none), (none, after), (none, none)):
        assert _perturbed(*pair, DRIVEN, {}) is None


def test_plants_lost_before_and_after_are_counted_separately():
    twice = Perturbed.of(figures(AFTER[:2]), figures(BEFORE[:2]), DRIVEN, {})
    assert (twice.unstable_before, twice.unstable) == (1, 0)
    means = [np.exp(np.mean(np.log([4.0, 9.0]))), 1.0]
    assert twice.geomean_rms_um == pytest.approx(np.median(means))


def test_traces_at_rest_give_one_mean_per_plant():
    driven = np.array([True, False, False])
    before = [[[1.0], [4.0], [9.0]], [[1.0], [2.0], [2.0]], [[1.0], [8.0], [2.0]]]
    after = np.ones_like(before)
    found = Perturbed.of(figures(before), figures(after), driven, {})
    assert found.coupling_better == pytest.approx(np.median([6.0, 2.0, 4.0]))
