"""Stability of a loop around an operating point: poles, margins, sensitivity.

Two functions compute a sensitivity peak. ``stability_report`` is exact: it refines the
frequency response of the linearised loop at its peaks, for loops of one or several
axes. Use it to assess a loop. ``sensitivity_peak`` is differentiable and cheap: it
samples S from the impulse response of the same loops. Use it in objectives, constraints
and sweeps.
"""

from .assess import AxesStability as AxesStability
from .assess import StabilityReports as StabilityReports
from .assess import stability_report as stability_report
from .assess import stability_reports as stability_reports
from .assess import worst_margins as worst_margins
from .axes_margins import MultiAxisReport as MultiAxisReport
from .axes_margins import axes_report_of as axes_report_of
from .broken_loop import BrokenLoop as BrokenLoop
from .broken_loop import broken_loop as broken_loop
from .broken_loop import open_loop as open_loop
from .margins import StabilityReport as StabilityReport
from .margins import report_of as report_of
from .model_error import worst_delay_margin as worst_delay_margin
from .model_error import worst_sensitivity as worst_sensitivity
from .operating_point import OperatingPoint as OperatingPoint
from .sampled_margins import sensitivity_peak as sensitivity_peak
from .small_motion import closed_loop_poles as closed_loop_poles
from .small_motion import sensitivity as sensitivity
