"""Hysteresis models, one file each, with their inverses beside them."""

from .bouc_wen import BoucWen as BoucWen
from .coleman_hodgdon import ColemanHodgdon as ColemanHodgdon
from .coleman_hodgdon import InverseColemanHodgdon as InverseColemanHodgdon
from .hysteretic_arma import HystereticARMA as HystereticARMA
from .prandtl_ishlinskii import (
    AsymmetricPrandtlIshlinskii as AsymmetricPrandtlIshlinskii,
)
from .prandtl_ishlinskii import PrandtlIshlinskii as PrandtlIshlinskii
from .preisach import InversePreisach as InversePreisach
from .preisach import Preisach as Preisach
from .rate_dependent_preisach import RateDependentPreisach as RateDependentPreisach
from .shaped import ShapedColemanHodgdon as ShapedColemanHodgdon
