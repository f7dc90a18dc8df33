"""The order in which a Pareto front is solved; test_robust has that of a loop."""

from itertools import pairwise

import numpy as np
import pytest

from piezojax.report.robustness import front_figure, front_table
from piezojax.tuning.front import non_dominated
from piezojax.tuning.result import FrontPoint


def point(error, loss):
    return FrontPoint(
        limit=2.0, value=1.9, loss=loss, kept=True, geomean_rms_um=error, gains={}
    )


def test_a_point_that_diverges_is_named_and_not_drawn():
    table = front_table(
        [point(0.5, -1.0), point(None, 1e6)], "sensitivity_peak", ("um",)
    )
    _, _, errors, losses = (list(column.cells) for column in table.columns)
    assert errors == ["500.00", "diverges"]
    assert losses == ["-1.000", "failed"]
    drawn = front_figure(
        [point(0.5, -1.0), point(None, 1e6)], "sensitivity_peak", "", ("um",)
    )
    assert [len(line.get_xdata()) for line in drawn.axes[0].lines] == [1]
    assert front_figure([point(None, 1e6)], "sensitivity_peak", "", ("um",)) is None


def test_errors_of_a_stage_with_rotations_have_both_units():
    front, units = [point(0.5, -1.0)], ("um", "urad", "um")
    table = front_table(front, "sensitivity_peak", units)
    assert table.columns[2].header == "error, nm or nrad"
    (panel,) = front_figure(front, "sensitivity_peak", "", units).axes
    assert panel.get_ylabel().endswith("geometric mean, nm or nrad")


def place(limit, loss, kept=True, unit=0.0):
    point = FrontPoint(
        limit=limit, value=limit, loss=loss, kept=kept, geomean_rms_um=1.0, gains={}
    )
    return np.array([unit]), point


@pytest.mark.parametrize(
    ("losses", "kept", "again"),
    [
        ([-4.0, -3.0, -2.0], [True, True, True], []),
        # The second is worse than the third and is solved again; the first is kept.
        ([-4.0, -1.0, -2.0], [True, True, True], [1.3]),
        # The first is worse than the second once that is solved again.
        ([-2.4, -1.0, -2.0], [True, True, True], [1.3, 1.4]),
        # A point that violates its limit does not affect others.
        ([-4.0, -3.0, -9.0], [True, True, False], []),
        ([-4.0, -9.0, -2.0], [True, False, True], [1.3]),
    ],
)
def test_a_limit_is_solved_again_from_a_better_tighter_one(losses, kept, again):
    found = [
        place(limit, loss, keeps, unit)
        for limit, loss, keeps, unit in zip(
            (1.4, 1.3, 1.2), losses, kept, (0.4, 0.3, 0.2), strict=True
        )
    ]
    asked = []

    def solved(limit, unit):
        asked.append(limit)
        return place(limit, -2.5 if limit == 1.3 else -5.0, unit=float(unit[0]))

    front = non_dominated(found, solved)
    assert asked == again
    assert [point.limit for _, point in front] == [1.4, 1.3, 1.2]
    for i, limit in enumerate((1.4, 1.3)):
        from_tighter = limit in again
        assert float(front[i][0][0]) == (0.2 if from_tighter else found[i][0][0])
    for (_, looser), (_, tighter) in pairwise(front):
        assert not tighter.kept or looser.loss <= tighter.loss
