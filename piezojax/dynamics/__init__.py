"""Linear dynamics that follow the hysteresis."""

from .arma import ARMA as ARMA
from .arma import scaled_to_dc as scaled_to_dc
from .lag import FirstOrderLag as FirstOrderLag
