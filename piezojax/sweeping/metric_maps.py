"""Metrics of a sweep by point: averages over the runs, lost points, the best point."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..study.sweep_table import METRICS, SENSITIVITY

if TYPE_CHECKING:
    from xarray import Dataset

_BEYOND = 1e3  # factor on the median; points with larger values count as lost


class MetricMap(NamedTuple):
    """A metric by point for one plant and axis, averaged over references and draws.

    ``values`` are in ``unit``, with one dimension per parameter for a grid, or one for
    samples. ``title`` names the plant and the axis.
    """

    title: str
    values: np.ndarray
    unit: str

    def finite(self) -> np.ndarray:
        """Return the values, NaN if lost: not finite, or far above the median."""
        finite = np.where(np.isfinite(self.values), self.values, np.nan)
        if not np.isfinite(finite).any():
            return finite
        middle = np.nanmedian(finite)
        far = (finite > _BEYOND * middle) if middle > 0.0 else False
        return np.where(far, np.nan, finite)

    def argmin(self) -> tuple[int, ...] | None:
        """Return the index of the smallest value, None if every point is lost."""
        values = self.finite()
        if np.isnan(values).all():
            return None
        place = np.unravel_index(np.nanargmin(values), values.shape)
        return tuple(int(i) for i in place)


def open_dataset(path: Path) -> "Dataset":
    """Open the data set of a sweep, to be read lazily and closed by the caller."""
    import xarray as xr

    return xr.open_dataset(path, engine="h5netcdf", decode_times=False)


def metrics_in(dataset: "Dataset") -> list[str]:
    """Return the names of the metrics of a data set, in the order of ``METRICS``."""
    return [name for name in METRICS if name in dataset]


def averaging(name: str) -> str:
    """Return the kind of mean of a metric over references and draws."""
    return "mean" if name == "saturated" else "geometric mean"


def metric_maps(dataset: "Dataset", name: str) -> list[MetricMap]:
    """Return a metric by point, for each plant and axis.

    It is NaN where the sensitivity peak, if it is a metric of the sweep, is infinite.
    """
    variable = dataset[name]
    others = [d for d in ("plant", "axis") if d in variable.dims]
    found = []
    for place in np.ndindex(*(variable.sizes[d] for d in others)):
        chosen = dict(zip(others, place, strict=True))
        unit = str(variable.attrs["units"])
        if "axis" in chosen:
            unit = str(dataset["axis_unit"].values[chosen["axis"]])
        title = ", ".join(str(dataset[d].values[i]) for d, i in chosen.items())
        values = np.where(
            _unstable(dataset, chosen), np.nan, _mean(variable.isel(chosen), name)
        )
        found.append(MetricMap(title, values, unit))
    return found


def _unstable(dataset: "Dataset", chosen: dict[str, int]) -> np.ndarray:
    """Return the points with an infinite sensitivity peak; none without that metric.

    The peak is infinite for an unstable loop, whose runs may still look good.
    """
    if SENSITIVITY not in dataset:
        return np.array(False)
    peak = dataset[SENSITIVITY]
    peak = peak.isel({d: i for d, i in chosen.items() if d in peak.dims})
    return ~np.isfinite(peak.values)


def _mean(variable: Any, name: str) -> np.ndarray:
    """Return the mean over references and draws: geometric, of a share arithmetic."""
    over = [d for d in ("reference", "draw") if d in variable.dims]
    if not over:
        return np.asarray(variable.values)
    share = averaging(name) == "mean"
    total, count = None, 0
    # One run after the other: a large data set is not held in memory.
    for place in np.ndindex(*(variable.sizes[d] for d in over)):
        values = variable.isel(dict(zip(over, place, strict=True))).values
        with np.errstate(divide="ignore"):
            values = values if share else np.log(values)
        total = values if total is None else total + values
        count += 1
    mean = np.asarray(total) / count
    return mean if share else np.exp(mean)
