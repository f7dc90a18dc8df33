"""Baselines of tuning: rules for a PID, and searches without gradients."""

from .contest import contest as contest
from .entries import Baselines as Baselines
from .entries import Contestant as Contestant
from .entries import load_baselines as load_baselines
from .rules import Rule as Rule
from .rules import Ultimate as Ultimate
from .searches import Budget as Budget
from .searches import cma_es as cma_es
from .searches import nelder_mead as nelder_mead
