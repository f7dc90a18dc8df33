"""Content of the pictures of state-space identification."""

import numpy as np
import pytest

from piezojax.catalog import p558
from piezojax.identification.estimators.frequency import EmpiricalResponse
from piezojax.report.figures import plot_style, write
from piezojax.report.frequency_response import response_figure, singular_values_figure


@pytest.fixture
def measured():
    frequency = np.linspace(1.0, 200.0, 50)
    response = np.asarray(p558.model("7").frequency_response(frequency)) * 1.1
    variance = 0.02 * np.ones(response.shape)
    return EmpiricalResponse(frequency, response, variance, np.ones((50, 3, 3)), 2e-3)


def test_the_picture_separates_the_singular_values_at_the_order(tmp_path):
    values = 10.0 * 0.5 ** np.arange(80)
    with plot_style():
        picture = singular_values_figure(values, 5, "title")
        write(picture, tmp_path / "values.png")
    (ax,) = picture.axes
    kept, left, border = (line.get_xydata() for line in ax.lines)
    np.testing.assert_allclose(kept[:, 1], values[:5] / 10.0)
    np.testing.assert_allclose(left[:, 0], np.arange(6, 61))
    assert border[0, 0] == 5.5
    assert (tmp_path / "values.png").stat().st_size > 1000


def test_a_bode_plot_has_one_panel_per_entry_with_a_band(measured, tmp_path):
    model = p558.model("7")
    with plot_style():
        fitted = np.asarray(model.frequency_response(measured.frequency))
        picture = response_figure(measured, fitted, "abc", p558.OUTPUTS, "um/um")
        write(picture, tmp_path / "response.png")
    titles = [ax.get_title() for ax in picture.axes if ax.get_title()]
    assert titles == [f"{i} to {o}" for o in p558.OUTPUTS for i in "abc"]
    gain = picture.axes[0]
    data, fitted = (line.get_ydata() for line in gain.lines)
    np.testing.assert_allclose(data, np.abs(measured.response[:, 0, 0]))
    np.testing.assert_allclose(data, 1.1 * fitted)
    (band,) = gain.collections
    edges = band.get_paths()[0].vertices[:, 1]
    assert edges.max() == pytest.approx(data.max() + 1.96 * 0.1)
