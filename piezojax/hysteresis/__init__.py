"""Hysteresis models, one file each, with their inverses beside them."""

from .asymmetric_prandtl_ishlinskii import (
    AsymmetricPrandtlIshlinskii as AsymmetricPrandtlIshlinskii,
)
from .bashash_jalili import BashashJalili as BashashJalili
from .bouc_wen import BoucWen as BoucWen
from .coleman_hodgdon import ColemanHodgdon as ColemanHodgdon
from .coleman_hodgdon import InverseColemanHodgdon as InverseColemanHodgdon
from .duhem import Duhem as Duhem
from .hysteretic_arma import HystereticARMA as HystereticARMA
from .hysteretic_oscillator import HystereticOscillator as HystereticOscillator
from .inverse import Inverse as Inverse
from .inverse import InverseHysteresis as InverseHysteresis
from .learned import LearnedOperator as LearnedOperator
from .model import Hysteresis as Hysteresis
from .normalised_bouc_wen import NormalisedBoucWen as NormalisedBoucWen
from .prandtl_ishlinskii import InversePrandtlIshlinskii as InversePrandtlIshlinskii
from .prandtl_ishlinskii import PrandtlIshlinskii as PrandtlIshlinskii
from .preisach import InversePreisach as InversePreisach
from .preisach import Preisach as Preisach
from .rate_dependent_prandtl_ishlinskii import (
    InverseRateDependentPrandtlIshlinskii as InverseRateDependentPrandtlIshlinskii,
)
from .rate_dependent_prandtl_ishlinskii import (
    RateDependentPrandtlIshlinskii as RateDependentPrandtlIshlinskii,
)
from .rate_dependent_preisach import RateDependentPreisach as RateDependentPreisach
from .shaped import ShapedColemanHodgdon as ShapedColemanHodgdon
from .stop_prandtl_ishlinskii import StopPrandtlIshlinskii as StopPrandtlIshlinskii
