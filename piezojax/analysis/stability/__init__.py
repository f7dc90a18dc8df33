"""How stable a loop is around an operating point: poles, margins, sensitivity."""

from .assess import stability_report as stability_report
from .broken_loop import BrokenLoop as BrokenLoop
from .broken_loop import broken_loop as broken_loop
from .broken_loop import open_loop as open_loop
from .differentiable import closed_loop_poles as closed_loop_poles
from .differentiable import loop_response as loop_response
from .differentiable import sensitivity_peak as sensitivity_peak
from .impulse import sensitivity as sensitivity
from .margins import StabilityReport as StabilityReport
from .margins import report_of as report_of
from .multi_axis import MultiAxisReport as MultiAxisReport
from .multi_axis import axes_report_of as axes_report_of
