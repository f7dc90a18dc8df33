import csv

import pytest

from piezojax.report.table_pictures import rates_figure
from piezojax.reproduction import chapter4
from piezojax.reproduction.rates import RATES, errors_by_rate, rates_as_csv


@pytest.fixture(scope="module")
def errors():
    return errors_by_rate(("SIN10", "SIN50"))


def test_every_printed_set_of_gains_is_present(errors):
    found = {(e.column, e.rate) for e in errors}
    assert found == {(c, rate) for c, rates in RATES.items() for rate in rates}
    assert sorted({e.rate for e in errors}) == [1000, 2000, 5000, 10000, 20000]


def test_the_shared_cells_equal_those_of_the_tables(errors):
    cells = {(c.row, c.column): c.sim for c in chapter4.cells("4-5")}
    for each in errors:
        if each.rate == 20_000:
            assert each.error == pytest.approx(cells[each.row, each.column], rel=1e-6)


def test_the_advantage_of_model_reference_grows_towards_low_rates(errors):
    error = {(e.column, e.rate, e.row): e.error for e in errors}
    for row in ("SIN10", "SIN50"):
        gains = [
            error["continuous", rate, row] / error["model_reference", rate, row]
            for rate in (5_000, 20_000)
        ]
        assert gains[0] > gains[1]
        assert gains[0] > 1.0


def test_file_and_picture_contain_every_error(errors):
    lines = list(csv.DictReader(rates_as_csv(errors).splitlines()))
    assert len(lines) == len(errors)
    assert float(lines[0]["sim_um"]) == pytest.approx(errors[0].error, rel=1e-5)
    panels = rates_figure(errors).axes
    assert [ax.get_title() for ax in panels] == ["SIN10", "SIN50"]
    assert sum(line.get_xdata().size for ax in panels for line in ax.lines) == len(
        errors
    )
