"""Limit of linear control: the least tracking error of any linear controller."""

from .limit_report import NEAR as NEAR
from .limit_report import LimitComparison as LimitComparison
from .limit_report import LimitReport as LimitReport
from .limit_report import Shares as Shares
from .performance import performance_limit as performance_limit
from .verification import LimitErrors as LimitErrors
from .verification import verify_limit as verify_limit
from .wiener import best_response as best_response
from .wiener import error_shares as error_shares
from .wiener import inner_response as inner_response
