"""Limit of linear control: the least tracking error of any linear controller."""

from .attained import Attained as Attained
from .attained import attained as attained
from .performance import performance_limit as performance_limit
from .reached import NEAR as NEAR
from .reached import LimitReport as LimitReport
from .reached import Reached as Reached
from .reached import Shares as Shares
from .wiener import best_response as best_response
from .wiener import error_shares as error_shares
from .wiener import inner_response as inner_response
