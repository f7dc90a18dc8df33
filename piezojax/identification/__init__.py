"""Identification of plant models from measured records."""

from .chain import DEFAULT as DEFAULT
from .chain import chain as chain
from .closed_loop import APPROACHES as APPROACHES
from .compare import identify_all as identify_all
from .estimators.estimate import Options as Options
from .estimators.free_runs import free_run as free_run
from .estimators.loop_response import loop_response as loop_response
from .estimators.model_bouc_wen import bouc_wen as bouc_wen
from .estimators.neural import fit_neural_state_space as fit_neural_state_space
from .estimators.neural import neural_start as neural_start
from .estimators.preisach_density import fit_preisach as fit_preisach
from .estimators.preisach_density import (
    fit_rate_dependent_preisach as fit_rate_dependent_preisach,
)
from .estimators.recursive import Measured as Measured
from .estimators.recursive import RecursiveLeastSquares as RecursiveLeastSquares
from .estimators.recursive import recursive_least_squares as recursive_least_squares
from .estimators.regression import RegressionFit as RegressionFit
from .estimators.regression import instrumental_variables as instrumental_variables
from .estimators.regression import least_squares as least_squares
from .estimators.regressors import Orders as Orders
from .estimators.regressors import rows as rows
from .estimators.steady_state import fit_steady_state as fit_steady_state
from .estimators.steady_state import fit_structure as fit_structure
from .estimators.steady_state import steady_response as steady_response
from .fit import Fit as Fit
from .fit import FitReport as FitReport
from .make_fit import identify as identify
from .methods import METHODS as METHODS
from .ranking import ModelRanking as ModelRanking
from .records.record import Record as Record
from .records.record import read_record as read_record
from .records.resample import average_periods as average_periods
from .records.resample import resample as resample
from .validation import Validation as Validation
from .validation import ValidationReport as ValidationReport
from .validation import validate as validate
