"""Table of the voltage at the piezo, before and after tuning."""

from rich.table import Table

from ..tuning.drive import HIGH, Drive


def drive_table(
    drive: tuple[dict[str, Drive], dict[str, Drive]],
    rate: float,
    *,
    has_capacitance: bool,
) -> Table:
    """Return the figures of the voltage at the piezo before and after tuning, by axis.

    ``rate`` is the sampling rate, Hz. Figures that need a capacitance are left out
    unless ``has_capacitance``. On a stage with several axes, V stands for the unit of
    the commands, as the caption says.
    """
    table = Table(title="voltage at the piezo on held-out noise, worst reference")
    if len(drive[1]) > 1:
        table.caption = "V stands for the unit of the command of each axis"
    table.add_column("figure")
    for title in ("before", "tuned", "unit"):
        table.add_column(title, justify="right", no_wrap=True)
    for axis, after in drive[1].items():
        before = drive[0][axis]
        shown = "" if len(drive[1]) == 1 else f"{axis}, "
        for field, (meaning, unit) in _DRIVE.items():
            if field in _NEED_CAPACITANCE and not has_capacitance:
                continue
            values = [getattr(figures, field) for figures in (before, after)]
            cells = (
                "diverges" if value is None else f"{value:.3g}" for value in values
            )
            title = meaning.format(high=f"{HIGH * rate:.4g} Hz")
            table.add_row(f"{shown}{title}", *cells, unit)
    return table


_DRIVE = {
    "noise_rms_V": ("noise on a constant reference, rms", "V"),
    "high_frequency_rms_V": ("above {high}, rms", "V"),
    "slew_rms_V_per_s": ("slew rate, rms", "V/s"),
    "slew_peak_V_per_s": ("slew rate, peak", "V/s"),
    "current_rms_A": ("current, rms", "A"),
    "current_peak_A": ("current, peak", "A"),
    "power_W": ("power, mean of |u i|", "W"),
}
"""Rows of the table of the drive: figure, meaning and unit."""

_NEED_CAPACITANCE = ("current_rms_A", "current_peak_A", "power_W")
