"""From a lab's records to a plant model."""

from .fit import Fit as Fit
from .fit import FitReport as FitReport
from .fit import identify as identify
from .model_bouc_wen import bouc_wen as bouc_wen
from .models import PARTS as PARTS
from .models import chain as chain
from .neural import fit_neural_state_space as fit_neural_state_space
from .neural import neural_start as neural_start
from .output_error import free_run as free_run
from .record import Record as Record
from .record import read_record as read_record
from .resample import average_periods as average_periods
from .resample import resample as resample
from .steady_state import fit_steady_state as fit_steady_state
from .steady_state import fit_structure as fit_structure
from .steady_state import steady_response as steady_response
