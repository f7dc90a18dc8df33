"""Linear dynamics that follow the hysteresis."""

from .arma import ARMA as ARMA
from .arma import scaled_to_dc as scaled_to_dc
from .creep import ExponentialCreep as ExponentialCreep
from .creep import LogarithmicCreep as LogarithmicCreep
from .delay import FractionalDelay as FractionalDelay
from .lag import FirstOrderLag as FirstOrderLag
