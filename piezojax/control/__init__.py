"""Controllers: each a System from an Observation to a command."""

from .alpha_beta import AlphaBeta as AlphaBeta
from .alpha_beta import Motion as Motion
from .bang_bang import BangBangSlidingMode as BangBangSlidingMode
from .continuous import ContinuousSlidingModePID as ContinuousSlidingModePID
from .disturbance_observer import (
    DisturbanceObserverControl as DisturbanceObserverControl,
)
from .inversion import InversionControl as InversionControl
from .model_reference import ModelReferencePID as ModelReferencePID
from .pid import PID as PID
from .sliding_mode import SlidingModePID as SlidingModePID
