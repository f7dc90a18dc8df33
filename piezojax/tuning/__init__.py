"""Tuning of a study's controller: objective, search, result and comparison."""

from .attempts import RetuneReport as RetuneReport
from .comparison import ComparisonResult as ComparisonResult
from .comparison import compare as compare
from .coupling import Coupling as Coupling
from .coupling import coupling_matrix as coupling_matrix
from .outcome import Outcome as Outcome
from .result import Result as Result
from .result import load_result as load_result
from .retuning import retune as retune
from .tuner import tune as tune
