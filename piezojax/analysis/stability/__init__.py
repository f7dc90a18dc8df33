"""Stability of a loop around an operating point: poles, margins, sensitivity.

A sensitivity peak has two sources. ``stability_report`` is exact: the frequency
response of the linearised loop, refined at its peaks, for loops of one or several axes;
use it to judge a loop. ``sensitivity_peak`` is differentiable and cheap: the response
of a loop of one axis to an impulse; use it in objectives, constraints and sweeps.
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
from .differentiable import closed_loop_poles as closed_loop_poles
from .differentiable import sensitivity as sensitivity
from .differentiable import sensitivity_peak as sensitivity_peak
from .margins import StabilityReport as StabilityReport
from .margins import report_of as report_of
from .operating_point import OperatingPoint as OperatingPoint
