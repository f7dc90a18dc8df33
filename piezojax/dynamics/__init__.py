"""Dynamics of a stage: linear and scheduled models, filters, creep, delay and drift.

Equations and sections without another source are those of Y. Cao's thesis (2013).
"""

from .analog_low_pass import AnalogLowPass as AnalogLowPass
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
from .filters import Biquad as Biquad
from .filters import FirstOrderLeadLag as FirstOrderLeadLag
from .filters import HighPass as HighPass
from .filters import LowPass as LowPass
from .filters import Notch as Notch
from .filters import SecondOrderLowPass as SecondOrderLowPass
from .lag import FirstOrderLag as FirstOrderLag
from .lag import SecondOrderLag as SecondOrderLag
from .linear_map import LinearMap as LinearMap
from .linearise import linearise as linearise
from .matrix_arma import MatrixARMA as MatrixARMA
from .matrix_arma import observability_form as observability_form
from .mode import Mode as Mode
from .modes import Modes as Modes
from .neural_state_space import NeuralStateSpace as NeuralStateSpace
from .oversampled import Oversampled as Oversampled
from .reduction import Reduction as Reduction
from .reduction import balanced_reduction as balanced_reduction
from .reduction import fast_part as fast_part
from .reduction import reduced as reduced
from .scheduled import AmplitudeScheduled as AmplitudeScheduled
from .slew import AmplifierSlew as AmplifierSlew
from .state_space import StateSpace as StateSpace
from .state_space import reflected as reflected
from .state_space import stabilised as stabilised
from .state_space import stacked as stacked
