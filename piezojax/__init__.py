"""Simulate, identify and tune piezo nanopositioning stages."""

from . import _runtime

__version__ = "0.1.0"

_runtime.configure()

from . import catalog as catalog
from . import contours as contours
from . import motions as motions
from . import signals as signals
from .axes import PerAxis as PerAxis
from .charge_drive import ChargeDrive as ChargeDrive
from .contour_error import ContourError as ContourError
from .control import PID as PID
from .control import AdaptiveInverse as AdaptiveInverse
from .control import Allocation as Allocation
from .control import AlphaBeta as AlphaBeta
from .control import Anticipation as Anticipation
from .control import BangBang as BangBang
from .control import BoundaryLayer as BoundaryLayer
from .control import ContinuousSlidingModePID as ContinuousSlidingModePID
from .control import DisturbanceObserverControl as DisturbanceObserverControl
from .control import FeedforwardFeedback as FeedforwardFeedback
from .control import Filtered as Filtered
from .control import InverseFeedforward as InverseFeedforward
from .control import InversionControl as InversionControl
from .control import KalmanFilter as KalmanFilter
from .control import LearningLaw as LearningLaw
from .control import ModelReferencePID as ModelReferencePID
from .control import MultiAxisSlidingModePID as MultiAxisSlidingModePID
from .control import NominalSlidingModePID as NominalSlidingModePID
from .control import RepetitiveControl as RepetitiveControl
from .control import SlidingModePID as SlidingModePID
from .control import StateSpaceController as StateSpaceController
from .control import SuperTwisting as SuperTwisting
from .control import SwitchedSlidingMode as SwitchedSlidingMode
from .control import learn as learn
from .dynamics import ARMA as ARMA
from .dynamics import AmplitudeScheduled as AmplitudeScheduled
from .dynamics import Channel as Channel
from .dynamics import Channels as Channels
from .dynamics import ExponentialCreep as ExponentialCreep
from .dynamics import FirstOrderLag as FirstOrderLag
from .dynamics import FractionalDelay as FractionalDelay
from .dynamics import Held as Held
from .dynamics import HystereticOscillator as HystereticOscillator
from .dynamics import LinearMap as LinearMap
from .dynamics import LogarithmicCreep as LogarithmicCreep
from .dynamics import MatrixARMA as MatrixARMA
from .dynamics import NeuralStateSpace as NeuralStateSpace
from .dynamics import SecondOrderLag as SecondOrderLag
from .dynamics import SpringDamperCreep as SpringDamperCreep
from .dynamics import StateSpace as StateSpace
from .dynamics import ThermalDrift as ThermalDrift
from .hardware import Quantiser as Quantiser
from .hardware import Saturation as Saturation
from .hardware import Sensor as Sensor
from .hardware import SlewLimit as SlewLimit
from .hysteresis import (
    AsymmetricPrandtlIshlinskii as AsymmetricPrandtlIshlinskii,
)
from .hysteresis import BashashJalili as BashashJalili
from .hysteresis import BoucWen as BoucWen
from .hysteresis import ColemanHodgdon as ColemanHodgdon
from .hysteresis import Duhem as Duhem
from .hysteresis import HystereticARMA as HystereticARMA
from .hysteresis import InverseColemanHodgdon as InverseColemanHodgdon
from .hysteresis import InverseHysteresis as InverseHysteresis
from .hysteresis import InversePrandtlIshlinskii as InversePrandtlIshlinskii
from .hysteresis import InversePreisach as InversePreisach
from .hysteresis import (
    InverseRateDependentPrandtlIshlinskii as InverseRateDependentPrandtlIshlinskii,
)
from .hysteresis import LearnedOperator as LearnedOperator
from .hysteresis import NormalisedBoucWen as NormalisedBoucWen
from .hysteresis import PrandtlIshlinskii as PrandtlIshlinskii
from .hysteresis import Preisach as Preisach
from .hysteresis import (
    RateDependentPrandtlIshlinskii as RateDependentPrandtlIshlinskii,
)
from .hysteresis import RateDependentPreisach as RateDependentPreisach
from .hysteresis import ShapedColemanHodgdon as ShapedColemanHodgdon
from .hysteresis import StopPrandtlIshlinskii as StopPrandtlIshlinskii
from .identify import Record as Record
from .identify import RecursiveLeastSquares as RecursiveLeastSquares
from .identify import identify as identify
from .identify import identify_all as identify_all
from .identify import read_record as read_record
from .metrics import Tracking as Tracking
from .rollout import Metric as Metric
from .rollout import in_blocks as in_blocks
from .rollout import simulate as simulate
from .select import Select as Select
from .serial import load as load
from .serial import save as save
from .stability import MultiAxisReport as MultiAxisReport
from .stability import stability_report as stability_report
from .study import Case as Case
from .sweep import sweep as sweep
from .system import Affine as Affine
from .system import Delay as Delay
from .system import Feedback as Feedback
from .system import Parallel as Parallel
from .system import Series as Series
from .system import System as System
from .system import loop_inputs as loop_inputs
from .system import series as series
from .tune import load_result as load_result
from .tune import tune as tune
