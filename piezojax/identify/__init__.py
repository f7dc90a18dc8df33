"""From a lab's records to a plant model."""

from .estimate import Options as Options
from .fit import Fit as Fit
from .fit import FitReport as FitReport
from .fit import identify as identify
from .methods import METHODS as METHODS
from .model_bouc_wen import bouc_wen as bouc_wen
from .models import chain as chain
from .neural import fit_neural_state_space as fit_neural_state_space
from .neural import neural_start as neural_start
from .output_error import free_run as free_run
from .parts import PARTS as PARTS
from .record import Record as Record
from .record import read_record as read_record
from .recursive import Measured as Measured
from .recursive import RecursiveLeastSquares as RecursiveLeastSquares
from .recursive import recursive_least_squares as recursive_least_squares
from .regression import Estimate as Estimate
from .regression import instrumental_variables as instrumental_variables
from .regression import least_squares as least_squares
from .regressors import Orders as Orders
from .regressors import rows as rows
from .resample import average_periods as average_periods
from .resample import resample as resample
from .steady_state import fit_steady_state as fit_steady_state
from .steady_state import fit_structure as fit_structure
from .steady_state import steady_response as steady_response
