"""Points of a sweep, and the messages about bad ones."""

import copy
import dataclasses
from contextlib import nullcontext

import jax
import numpy as np
import pytest
from swept_studies import GRID, PARAMETERS

from piezojax import control
from piezojax.core.parameter import declarations
from piezojax.core.space import Range
from piezojax.identification.residual_record import ResidualRecord
from piezojax.sweeping import read_swept
from piezojax.sweeping.dataset import boxes
from piezojax.sweeping.plan import Plan, bytes_of_point, runs_of_point

BOX = {path: dict(table) for path, table in PARAMETERS.items()}


def changed(path, value):
    """Return GRID with the entry at ``path`` replaced, or removed for None."""
    table = copy.deepcopy(GRID)
    inner = table
    for key in path[:-1]:
        inner = inner.setdefault(key, {})
    if value is None:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return table


def test_grid_is_every_combination_in_c_order(case_of):
    plan = Plan(case_of(GRID))
    assert plan.shape == (5, 3)
    steps = [5e-4, 1e-3, 2e-3]
    wanted = [[p, t] for p in (0.1, 0.5, 1.0, 2.0, 4.0) for t in steps]
    np.testing.assert_allclose(plan.values(0, 15), wanted, rtol=1e-12)
    np.testing.assert_array_equal(plan.values(4, 9), plan.values(0, 15)[4:9])
    # The ends are exactly the bounds, not exponentials of their logarithms.
    assert plan.values(0, 3)[[0, 2], 1].tolist() == [5e-4, 2e-3]


@pytest.mark.parametrize("method", ["latin_hypercube", "sobol"])
def test_samples_are_spread_on_the_scale_of_each_parameter(case_of, method):
    table = {"method": method, "samples": 64, "parameters": BOX}
    values = Plan(case_of(table)).values(0, 64)
    for column, bound in zip(values.T, BOX.values(), strict=True):
        low, high = np.log(bound["lower"]), np.log(bound["upper"])
        share = (np.log(column) - low) / (high - low)
        # one point in each of 64 strips, in both designs
        assert sorted(np.floor(64.0 * share).astype(int)) == list(range(64))


def test_sobol_points_fill_every_box_equally(case_of):
    table = {"method": "sobol", "samples": 64, "parameters": BOX}
    values = np.log(Plan(case_of(table)).values(0, 64))
    low = np.log([bound["lower"] for bound in BOX.values()])
    high = np.log([bound["upper"] for bound in BOX.values()])
    cells = np.floor(8.0 * (values - low) / (high - low)).astype(int)
    assert len({tuple(cell) for cell in cells}) == 64


def test_points_depend_on_study_and_seed_alone(write):
    path = write({"method": "sobol", "samples": 50, "parameters": BOX})
    first, second, other = (
        Plan(read_swept(path, seed=seed)).values(0, 50) for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


def test_samples_of_the_tuning_box_need_no_table(write):
    plan = Plan(read_swept(write(None), samples=10))
    assert (plan.method, plan.points) == ("sobol", 10)
    assert [axis.path for axis in plan.axes] == list(PARAMETERS)


def test_omitted_entries_come_from_the_declarations(case_of):
    known = dict(declarations(control.PID))["integral"]
    tables = {"controller.integral": {"count": 3}, LAG: {"values": [1e-3, 2e-3]}}
    integral, lag = Plan(case_of({"parameters": tables})).axes
    assert integral.range == Range(*known.typical, known.scale, unit="V/(um s)")
    low, high = known.typical
    np.testing.assert_allclose(integral.values, [low, (low * high) ** 0.5, high])
    assert lag.range == Range(1e-3, 2e-3, unit="s")


def test_the_tuning_box_keeps_bounds_scale_and_unit(write):
    axes = Plan(read_swept(write(None), samples=10)).axes
    assert {axis.path: axis.range for axis in axes} == {
        "controller.proportional": Range(0.1, 5.0, "log", unit="V/um"),
        "controller.integral": Range(100.0, 2e4, "log", unit="V/(um s)"),
    }


def test_chunks_and_shards_contain_every_point_once(case_of):
    plan = Plan(case_of({"method": "sobol", "samples": 1000}))
    spans = [plan.span(chunk) for chunk in range(plan.chunks)]
    assert plan.chunks > 4
    assert [p for start, stop in spans for p in range(start, stop)] == list(range(1000))
    shares = [chunk for i in (1, 2, 3) for chunk in plan.share((i, 3))]
    assert sorted(shares) == list(range(plan.chunks))


@pytest.mark.parametrize("plant", [{"records": ["a.csv"]}, {"file": "model.json"}])
def test_the_stretches_of_a_residual_are_runs_of_a_point(case_of, plant):
    case = case_of(GRID)
    alone = runs_of_point(case), bytes_of_point(case)
    # Whatever the source of its plant, a case with a residual has twice as many runs.
    known = dataclasses.replace(
        case,
        study=case.study.model_copy(update={"plant": plant}),
        saved_residual=ResidualRecord(1e-3, {"train": (), "validate": ()}),
    )
    found = runs_of_point(known), bytes_of_point(known)
    assert found == (2 * alone[0], 2 * alone[1])


@pytest.mark.parametrize("shape", [(7,), (5, 3), (3, 4, 5), (1, 6, 1)])
def test_boxes_cover_a_run_of_points(shape):
    count = int(np.prod(shape))
    for start in range(count):
        for stop in range(start + 1, count + 1):
            found = np.full(shape, -1)
            for box, first, last in boxes(shape, start, stop):
                assert (found[box] == -1).all()
                found[box] = np.arange(first, last).reshape(found[box].shape)
            wanted = np.arange(count)
            wanted[:start], wanted[stop:] = -1, -1
            np.testing.assert_array_equal(found.ravel(), wanted)


PID = "controller.proportional"
LAG = "plant.time_constant"


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (["method"], "random", "sweep.method is 'random'"),
        (["metric"], ["x"], "sweep.metric is unknown; allowed are method, samples"),
        (["metrics"], ["rms"], "'rms' is unknown; there are rms_error, peak_error"),
        (["metrics"], [], "sweep.metrics"),
        (["samples"], 10, "a grid takes counts, not samples"),
        (["plants"], ["p754"], "sweep.plants.p754"),
        (["references"], ["SIN7"], "SIN7 is not one of the study's references, "),
        (["every"], 0, "sweep.every is 0"),
        (["parameters"], None, "a grid needs parameters"),
        (["parameters", "gain"], {"values": [1.0]}, "must start with one of"),
        (["parameters", LAG, "count"], None, "a grid needs a count"),
        (["parameters", LAG, "steps"], 3, "steps is unknown; allowed are lower, upper"),
        (["parameters", LAG, "unit"], "s", "unit is unknown; allowed are lower, upper"),
        (["parameters", LAG, "values"], [1.0], "either values, or lower and upper"),
        (["parameters", LAG, "lower"], 3e-3, "the lower below the upper"),
        (["parameters", LAG, "lower"], -1.0, "scale 'log' it must be above 0"),
        (["parameters", PID, "values"], [2.0, 1.0], "values must increase"),
        (["parameters", PID, "values"], [], "at least one number"),
        (
            ["parameters", "controller.proportonal"],
            {"values": [1.0]},
            "no parameter 'proportonal'; the nearest are proportional",
        ),
        (
            ["parameters", "sensor.noise.noise_rms"],
            {"values": [-1.0, 1.0]},
            "noise_rms in um is -1; it must be finite and at least 0",
        ),
        (["parameters", "plant", "time_constant"], {"count": 2}, "stand in quotes"),
    ],
)
def test_bad_tables_are_refused_in_one_line(case_of, path, value, message):
    with pytest.raises(ValueError, match=message) as caught:
        Plan(case_of(changed(path, value)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("lower", "upper", "refused"),
    [
        ([-20.0, 100.0], [50.0, 120.0], True),
        ([-20.0, 40.0], [50.0, 120.0], False),
    ],
)
def test_limits_that_cross_at_a_point_are_refused(case_of, lower, upper, refused):
    case = case_of(
        {
            "parameters": {
                "actuator.limits.lower": {"values": lower},
                "actuator.limits.upper": {"values": upper},
            }
        }
    )
    message = r"sweep.parameters.actuator.limits.\w+: lower is 100 and upper is 50; "
    with pytest.raises(ValueError, match=message) if refused else nullcontext():
        Plan(case)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"method": "sobol"}, "sobol needs samples, the number of points"),
        (
            {"method": "sobol", "samples": 4, "parameters": GRID["parameters"]},
            "leave values and count out",
        ),
        ({"method": "sobol", "samples": 0}, "sweep.samples is 0"),
    ],
)
def test_bad_tables_of_samples_are_refused(case_of, table, message):
    with pytest.raises(ValueError, match=message):
        Plan(case_of(table))


def test_without_a_table_the_error_names_the_missing_keys(case_of):
    with pytest.raises(ValueError, match=r"no table \[sweep\]: add .* or give --sampl"):
        Plan(case_of(None))


def test_samples_of_a_grid_are_refused(write):
    with pytest.raises(ValueError, match="the study sweeps a grid"):
        read_swept(write(GRID), samples=10)


def test_shards_are_counted_from_one(case_of):
    plan = Plan(case_of(GRID))
    for shard in ((0, 3), (4, 3), (1, 0)):
        with pytest.raises(ValueError, match="shards are counted from 1/"):
            plan.share(shard)


def test_blocks_are_larger_on_a_gpu(case_of, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    table = {"method": "sobol", "samples": 1000, "metrics": ["rms_error"]}
    assert Plan(case_of(table)).width == 1000
    assert Plan(case_of(table | {"chunk": 100})).width == 100
    assert Plan(case_of(table | {"chunk": 10})).width == 64
