"""Table 7-4 and Figure 7.4, against print and a loop from the equations."""

import csv
import io
import math
from pathlib import Path

import numpy as np
import pytest
from oracles import three_dof as oracle
from rich.console import Console

from piezojax.catalog import p558
from piezojax.report.reproduction_tables import reproduction_table
from piezojax.report.table_pictures import cells_figure
from piezojax.reproduction import chapter7, summarise, three_dof

PRINTED = Path(__file__).parents[3] / "shared" / "tables" / "thesis_results.csv"
ROWS = [f"drive_{axis}_{f}Hz" for axis in p558.OUTPUTS for f in (1, 5, 10)]
STAGE = {"weight": 0.02, "radius": 4.0, "delay": 1}
OPTIONS = {"pid_smc": {"alpha_beta": False}, "pid": {}}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def table():
    return chapter7.cells("7-4")


@pytest.fixture(scope="module")
def cell(table):
    return {(c.row, c.column): c for c in table}


@pytest.fixture(scope="module")
def groups(table):
    return summarise(table)["7-4"].model_dump()["groups"]


def driven(cell, controller):
    return [cell[row, f"{controller}:{row.split('_')[1]}"] for row in ROWS]


def test_every_cell_is_present(table):
    places = [(c.row, c.column) for c in table]
    columns = [f"{name}:{axis}" for name in OPTIONS for axis in p558.OUTPUTS]
    assert sorted(places) == sorted((row, column) for row in ROWS for column in columns)
    assert all(math.isfinite(c.sim) and c.sim > 0 for c in table)


def test_the_data_equal_the_printed_tables(table):
    if not PRINTED.is_file():
        pytest.skip(f"{PRINTED} is not here")
    with PRINTED.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["table"] == "7-4"]
    printed = {(r["row"], r["column"], r["unit"], float(r["paper"])) for r in rows}
    assert {(c.row, c.column, c.unit, c.paper) for c in table} == printed


# The bars


def test_the_errors_of_the_pid_agree_with_print(groups):
    assert groups["pid driven"]["cells"] == 9
    assert groups["pid driven"]["geomean_ratio"] <= 1.15


def test_the_errors_of_the_sliding_mode_control_agree_with_print(groups):
    assert groups["pid_smc driven"]["cells"] == 9
    assert groups["pid_smc driven"]["geomean_ratio"] <= 1.6


def test_the_sliding_mode_control_is_better_in_nine_cells_of_nine(cell):
    pairs = zip(driven(cell, "pid_smc"), driven(cell, "pid"), strict=True)
    for smc, pid in pairs:
        assert smc.paper < pid.paper
        assert smc.sim < pid.sim


# Against a plain loop


@pytest.mark.parametrize("controller", OPTIONS)
def test_cells_equal_a_loop_from_the_equations(cell, controller):
    runs = list(three_dof.references())
    chosen = ["drive_Z_5Hz", "drive_Rx_10Hz", "drive_Ry_1Hz"]
    targets = oracle.table_sines()[:, [0, 1, 2], [1, 2, 0]]
    noise = np.asarray(three_dof.noise_draws(len(runs), 2000))
    noise = noise[[runs.index(run) for run in chosen]] * [0.0008, 0.013, 0.013]
    z = oracle.simulate(
        controller, targets, noise.swapaxes(0, 1), STAGE, **OPTIONS[controller]
    )["z"]
    expected = oracle.tracking_rms(z, targets)
    for run, errors in zip(chosen, expected, strict=True):
        name, hertz = run.split("_")[1:]
        for axis, error in zip(p558.OUTPUTS, errors, strict=True):
            # Off the diagonal the printed rows and columns are exchanged.
            found = cell[f"drive_{axis}_{hertz}", f"{controller}:{name}"]
            assert found.sim == pytest.approx(error, rel=0.0, abs=1e-9)


def test_transposed_couplings_agree_better_than_those_as_printed(cell):
    logs, exchanged = [], []
    for (row, column), found in cell.items():
        controller, measured = column.split(":")
        _, axis, hertz = row.split("_")
        if axis != measured:
            other = cell[f"drive_{measured}_{hertz}", f"{controller}:{axis}"]
            logs.append(abs(math.log(found.sim / found.paper)))
            exchanged.append(abs(math.log(other.sim / found.paper)))
    assert len(logs) == 36
    assert np.mean(logs) < 0.5 * np.mean(exchanged)


def test_the_table_is_complete_on_a_narrow_terminal(table):
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(reproduction_table("7-4", table, summarise(table)["7-4"]))
    text = console.export_text()
    assert "pid_smc driven 1." in text
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    for found in table:
        assert f"{found.paper:.4f} / {found.sim:.4f}" in text


def test_every_group_is_in_the_picture(table, groups):
    (ax,) = cells_figure(table).axes
    drawn = {line.get_label(): line.get_xdata() for line in ax.get_lines()}
    for name, group in groups.items():
        assert len(drawn[name]) == group["cells"]


def test_the_combined_experiment():
    found = {(c.row, c.column): c for c in chapter7.cells("figure-7-4")}
    assert found["Z", "pid_smc"].paper == 0.1086
    assert found["Ry", "pid"].paper == 2.9961
    assert found["Z", "pid"].paper == pytest.approx(0.1086 + 0.6151)
    assert found["Ry", "pid"].paper == pytest.approx(1.1831 + 1.813)
    for axis in p558.OUTPUTS:
        assert found[axis, "pid_smc"].sim < found[axis, "pid"].sim
    for axis in ("Z", "Ry"):
        assert 0.7 < found[axis, "pid"].ratio < 1.1
        assert 1.0 < found[axis, "pid_smc"].ratio < 2.5


def test_references_of_the_axes():
    runs = three_dof.references()
    np.testing.assert_allclose(
        runs["drive_Rx_5Hz"], oracle.table_sines()[:-1, 1, 1], rtol=0, atol=1e-12
    )
    for run in runs.values():
        assert run.shape == (2000, 3)
    first, second = (runs[name] for name in three_dof.EXPERIMENTS)
    np.testing.assert_allclose(np.abs(first).max(0), [10.0, 50.0, 0.0], rtol=1e-3)
    assert np.ptp(second[:1000, 0]) == pytest.approx(20.0, rel=1e-3)
    assert np.abs(second[:, 2]).max() == pytest.approx(50.0)
    assert np.all(second[:, 1] == 0.0)
