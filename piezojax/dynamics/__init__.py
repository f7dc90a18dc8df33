"""Dynamics: linear ones that follow the hysteresis, and those that contain it."""

from .arma import ARMA as ARMA
from .arma import scaled_to_dc as scaled_to_dc
from .channels import Channel as Channel
from .channels import Channels as Channels
from .channels import channels_of as channels_of
from .creep import ExponentialCreep as ExponentialCreep
from .creep import LogarithmicCreep as LogarithmicCreep
from .creep import SpringDamperCreep as SpringDamperCreep
from .delay import FractionalDelay as FractionalDelay
from .drift import ThermalDrift as ThermalDrift
from .held import Held as Held
from .lag import FirstOrderLag as FirstOrderLag
from .lag import SecondOrderLag as SecondOrderLag
from .linear_map import LinearMap as LinearMap
from .matrix_arma import MatrixARMA as MatrixARMA
from .matrix_arma import observability_form as observability_form
from .neural_state_space import NeuralStateSpace as NeuralStateSpace
from .reduction import Reduction as Reduction
from .reduction import balanced_reduction as balanced_reduction
from .scheduled import AmplitudeScheduled as AmplitudeScheduled
from .state_space import StateSpace as StateSpace
from .state_space import reflected as reflected
from .state_space import stabilised as stabilised
from .state_space import stacked as stacked
