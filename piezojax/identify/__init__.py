"""From a lab's record to a plant model."""

from .model_bouc_wen import bouc_wen as bouc_wen
from .models import MODELS as MODELS
from .neural import fit_neural_state_space as fit_neural_state_space
from .neural import neural_start as neural_start
from .output_error import Fit as Fit
from .output_error import FitReport as FitReport
from .output_error import free_run as free_run
from .output_error import identify as identify
from .record import Record as Record
from .record import read_record as read_record
from .resample import average_periods as average_periods
from .resample import resample as resample
from .steady_state import fit_steady_state as fit_steady_state
from .steady_state import fit_structure as fit_structure
from .steady_state import steady_response as steady_response
