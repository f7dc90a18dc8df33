"""Hysteresis models, one file each, with their inverses beside them."""

from .coleman_hodgdon import ColemanHodgdon as ColemanHodgdon
from .coleman_hodgdon import InverseColemanHodgdon as InverseColemanHodgdon
from .hysteretic_arma import HystereticARMA as HystereticARMA
