"""Sweeps: tracking figures of a loop over parameters, plants and references."""

from .sweeper import SweepResult as SweepResult
from .sweeper import read_swept as read_swept
from .sweeper import run_sweep as run_sweep
from .sweeper import sweep as sweep
