"""From a lab's record to a plant model."""

from .models import MODELS as MODELS
from .output_error import Fit as Fit
from .output_error import FitReport as FitReport
from .output_error import free_run as free_run
from .output_error import identify as identify
from .record import Record as Record
from .record import read_record as read_record
from .recursive import Measured as Measured
from .recursive import RecursiveLeastSquares as RecursiveLeastSquares
from .recursive import recursive_least_squares as recursive_least_squares
from .regression import Estimate as Estimate
from .regression import instrumental_variables as instrumental_variables
from .regression import least_squares as least_squares
from .regressors import Structure as Structure
from .regressors import rows as rows
