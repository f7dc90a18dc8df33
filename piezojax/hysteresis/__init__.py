"""Hysteresis models and their inverses, one model per file.

Equations and sections without another source are those of Y. Cao's thesis (2013).
"""

# isort: off
# Models are listed and tried in this order.
from .coleman_hodgdon import ColemanHodgdon as ColemanHodgdon
from .shaped import ShapedColemanHodgdon as ShapedColemanHodgdon
from .prandtl_ishlinskii import PrandtlIshlinskii as PrandtlIshlinskii
from .asymmetric_prandtl_ishlinskii import (
    AsymmetricPrandtlIshlinskii as AsymmetricPrandtlIshlinskii,
)
from .stop_prandtl_ishlinskii import StopPrandtlIshlinskii as StopPrandtlIshlinskii
from .rate_dependent_prandtl_ishlinskii import (
    RateDependentPrandtlIshlinskii as RateDependentPrandtlIshlinskii,
)
from .duhem import Duhem as Duhem
from .normalised_bouc_wen import NormalisedBoucWen as NormalisedBoucWen
from .dahl_frictions import DahlFrictions as DahlFrictions
from .bashash_jalili import BashashJalili as BashashJalili
from .learned import LearnedOperator as LearnedOperator
from .preisach import Preisach as Preisach
from .rate_dependent_preisach import RateDependentPreisach as RateDependentPreisach
from .hysteretic_arma import HystereticARMA as HystereticARMA
from .bouc_wen import BoucWen as BoucWen
from .hysteretic_oscillator import HystereticOscillator as HystereticOscillator
# isort: on

from .coleman_hodgdon import InverseColemanHodgdon as InverseColemanHodgdon
from .inverse import Inverse as Inverse
from .inverse import InverseHysteresis as InverseHysteresis
from .model import Hysteresis as Hysteresis
from .prandtl_ishlinskii import InversePrandtlIshlinskii as InversePrandtlIshlinskii
from .preisach import InversePreisach as InversePreisach
from .rate_dependent_prandtl_ishlinskii import (
    InverseRateDependentPrandtlIshlinskii as InverseRateDependentPrandtlIshlinskii,
)
