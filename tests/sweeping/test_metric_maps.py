"""Maps of a sweep: averages over runs, lost points, the best point."""

import numpy as np
import xarray as xr

from piezojax.report.sweep_maps import best_table
from piezojax.sweeping.metric_maps import metric_maps


def dataset_of(**metrics):
    """Return a data set of two gains, two references and one plant."""
    variables = {
        "rms_error": (
            ("gain", "plant", "reference"),
            np.array([[[4.0, 1.0]], [[0.1, 0.1]]]),
            {"units": "um", "long_name": "rms error"},
        ),
        **{
            name: (("gain", "plant"), values, {"units": "1", "long_name": name})
            for name, values in metrics.items()
        },
    }
    gain = ("gain", [1.0, 2.0], {"scale": "linear", "units": "1"})
    return xr.Dataset(
        variables,
        {"gain": gain, "plant": ["nominal"], "reference": ["SIN10", "SIN20"]},
        {"title": "two gains", "method": "grid"},
    )


def test_a_metric_is_the_geometric_mean_over_the_runs():
    (found,) = metric_maps(dataset_of(), "rms_error")
    np.testing.assert_allclose(found.values, [2.0, 0.1], rtol=1e-12)
    assert (found.title, found.argmin()) == ("nominal", (1,))


def test_an_unstable_point_with_small_errors_is_not_the_best():
    dataset = dataset_of(sensitivity_peak=np.array([[1.5], [np.inf]]))
    (found,) = metric_maps(dataset, "rms_error")
    np.testing.assert_array_equal(found.values, [2.0, np.nan])
    assert found.argmin() == (0,)
    dataset = dataset_of(sensitivity_peak=np.array([[np.inf], [np.inf]]))
    assert metric_maps(dataset, "rms_error")[0].argmin() is None


def test_the_table_says_that_only_runs_were_judged(tmp_path):
    path = tmp_path / "sweep.nc"
    dataset_of().to_netcdf(path, engine="h5netcdf")
    table = best_table(path)
    assert list(table.columns[1].cells) == ["2"]
    assert table.caption.startswith("Only runs were judged: a point may be unstable")
    dataset_of(sensitivity_peak=np.array([[1.5], [np.inf]])).to_netcdf(
        tmp_path / "margins.nc", engine="h5netcdf"
    )
    table = best_table(tmp_path / "margins.nc")
    assert (list(table.columns[1].cells), table.caption) == (["1"], None)
    assert list(table.columns[-1].cells) == ["1 of 2"]
