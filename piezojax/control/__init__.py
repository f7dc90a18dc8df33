"""Controllers: each a System from an Observation to a command."""

from .active_damping import ActiveDamping as ActiveDamping
from .adaptive_inverse import AdaptiveInverse as AdaptiveInverse
from .allocation import Allocated as Allocated
from .allocation import Allocation as Allocation
from .alpha_beta import AlphaBeta as AlphaBeta
from .anticipation import Anticipation as Anticipation
from .devices import E727 as E727
from .devices import NV200 as NV200
from .devices import Device as Device
from .devices import PyRPL as PyRPL
from .devices import Servo as Servo
from .devices import Stabilizer as Stabilizer
from .disturbance_observer import (
    DisturbanceObserverControl as DisturbanceObserverControl,
)
from .feedforward import FeedforwardFeedback as FeedforwardFeedback
from .feedforward import InverseFeedforward as InverseFeedforward
from .filtered import Filtered as Filtered
from .filtered_command import FilteredCommand as FilteredCommand
from .guard import Guard as Guard
from .inversion import InverseGain as InverseGain
from .inversion import InversionControl as InversionControl
from .iterative_learning import LearningLaw as LearningLaw
from .iterative_learning import Trials as Trials
from .iterative_learning import learn as learn
from .kalman import KalmanFilter as KalmanFilter
from .learning_control import LearningControl as LearningControl
from .limited_reference import LimitedReference as LimitedReference
from .mixed_sensitivity import first_order_weight as first_order_weight
from .mixed_sensitivity import mixed_sensitivity as mixed_sensitivity
from .model_reference import ModelReferenceSlidingMode as ModelReferenceSlidingMode
from .multi_axis import MultiAxisSlidingMode as MultiAxisSlidingMode
from .nominal import NominalSlidingMode as NominalSlidingMode
from .observer import Motion as Motion
from .observer import Observer as Observer
from .phase_compensator import PhaseCompensator as PhaseCompensator
from .pid import PID as PID
from .pole_placement import PlacedPID as PlacedPID
from .preview import ExtrapolatedInverse as ExtrapolatedInverse
from .preview import PreviewInverse as PreviewInverse
from .preview import direct_inverse as direct_inverse
from .preview import stable_inverse as stable_inverse
from .preview import zero_phase_inverse as zero_phase_inverse
from .repetitive import RepetitiveControl as RepetitiveControl
from .sliding_mode import ContinuousSlidingMode as ContinuousSlidingMode
from .sliding_mode import SlidingMode as SlidingMode
from .state_sliding_mode import StateSlidingMode as StateSlidingMode
from .state_space_controller import StateSpaceController as StateSpaceController
from .switching import BangBang as BangBang
from .switching import BoundaryLayer as BoundaryLayer
from .switching import SuperTwisting as SuperTwisting
from .switching import SwitchingLaw as SwitchingLaw
from .switching import SwitchingPID as SwitchingPID
from .weighted_mixed_sensitivity import (
    WeightedMixedSensitivity as WeightedMixedSensitivity,
)
