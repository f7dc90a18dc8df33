"""Engines that run many lanes at once, in compiled C or in one kernel of a GPU."""

from .engine import Engine as Engine
from .engine import default_engine as default_engine
from .engine import metered as metered
from .engine import reverse_mode as reverse_mode
from .engine import run_outputs as run_outputs
from .metered_run import WithMetric as WithMetric
