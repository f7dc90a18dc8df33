"""Tables 8-2, 8-3 and their experiments, against print and a plain loop."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from oracles import three_dof as oracle

from piezojax.catalog import p558
from piezojax.reproduction import chapter8, summarise, three_dof

PRINTED = Path(__file__).parents[3] / "shared" / "tables" / "thesis_results.csv"
ROWS = [f"drive_{axis}_{f}Hz" for axis in p558.OUTPUTS for f in (1, 5, 10)]
STAGE = {"weight": 0.02, "radius": 4.0, "delay": 0}
CONTROLLERS = {"8-2": "dob_smc", "8-3": "nominal_smc"}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tables():
    return {name: chapter8.cells(name) for name in CONTROLLERS}


@pytest.fixture(scope="module")
def cell(tables):
    return {(c.row, c.column): c for cells in tables.values() for c in cells}


def driven(cell, controller):
    return [cell[row, f"{controller}:{row.split('_')[1]}"] for row in ROWS]


def test_every_cell_is_present(tables):
    for table, cells in tables.items():
        places = [(c.row, c.column) for c in cells]
        columns = [f"{CONTROLLERS[table]}:{axis}" for axis in p558.OUTPUTS]
        assert places == [(row, column) for row in ROWS for column in columns]
        assert all(math.isfinite(c.sim) and c.sim > 0 for c in cells)


def test_the_data_equal_the_printed_tables(tables):
    if not PRINTED.is_file():
        pytest.skip(f"{PRINTED} is not here")
    with PRINTED.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["table"] in tables]
    printed = {
        (r["table"], r["row"], r["column"], r["unit"], float(r["paper"])) for r in rows
    }
    cells = [c for cells in tables.values() for c in cells]
    assert {(c.table, c.row, c.column, c.unit, c.paper) for c in cells} == printed


def test_the_observer_reduces_the_error_in_nine_cells_of_nine(cell):
    pairs = zip(driven(cell, "dob_smc"), driven(cell, "nominal_smc"), strict=True)
    for observed, nominal in pairs:
        assert observed.paper < nominal.paper
        assert observed.sim < nominal.sim


def test_the_levels_are_lower_than_print(tables):
    # There is no bar: the figures are recorded, so that a change is noticed.
    bounds = {"8-2": (2.2, 2.6), "8-3": (2.4, 2.9)}
    for table, (low, high) in bounds.items():
        groups = summarise(tables[table])[table].model_dump()["groups"]
        group = groups[f"{CONTROLLERS[table]} driven"]
        assert group["cells"] == 9
        assert low < group["geomean_ratio"] < high


@pytest.mark.parametrize("controller", CONTROLLERS.values())
def test_cells_equal_a_loop_from_the_equations(cell, controller):
    runs = list(three_dof.references())
    chosen = ["drive_Z_5Hz", "drive_Rx_10Hz", "drive_Ry_1Hz"]
    targets = oracle.table_sines()[:, [0, 1, 2], [1, 2, 0]]
    noise = np.asarray(three_dof.noise_draws(len(runs), 2000))
    noise = noise[[runs.index(run) for run in chosen]] * [0.0008, 0.013, 0.013]
    z = oracle.simulate(
        controller, targets, noise.swapaxes(0, 1), STAGE, arx="matched"
    )["z"]
    expected = oracle.tracking_rms(z, targets)
    for run, errors in zip(chosen, expected, strict=True):
        for axis, error in zip(p558.OUTPUTS, errors, strict=True):
            found = cell[run, f"{controller}:{axis}"]
            assert found.sim == pytest.approx(error, rel=0.0, abs=1e-9)


def test_the_combined_experiments():
    first = {(c.row, c.column): c for c in chapter8.cells("figure-8-4")}
    second = {(c.row, c.column): c for c in chapter8.cells("figure-8-5")}
    # The text gives one of each pair, and the increase of the other.
    for pair, difference in (
        ([first["Ry", name] for name in chapter8.COLUMNS], 0.0118),
        ([second["Z", name] for name in chapter8.COLUMNS], 0.3361),
        ([second["Ry", name] for name in chapter8.COLUMNS], 0.7141),
    ):
        observed, nominal = pair
        assert nominal.paper - observed.paper == pytest.approx(difference)
        assert observed.sim < nominal.sim
