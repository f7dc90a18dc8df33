"""Export of controllers and plants to other programs and to hardware."""

from .device_file import Value as Value
from .driven import Driven as Driven
from .driven import Seen as Seen
from .exporter import export as export
from .exporter import export_alarms as export_alarms
from .linear_models import from_control as from_control
from .linear_models import to_control as to_control
from .vendor import device_values as device_values
