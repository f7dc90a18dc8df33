"""Maps of what a loop does over parameters, plants and references."""

from .sweeper import Swept as Swept
from .sweeper import read_swept as read_swept
from .sweeper import run_sweep as run_sweep
from .sweeper import sweep as sweep
