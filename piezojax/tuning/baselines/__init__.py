"""Baselines of tuning: rules for a PID, and searches without gradients."""

from .baseline_runs import compare_baselines as compare_baselines
from .entries import BaselineEntry as BaselineEntry
from .entries import Baselines as Baselines
from .entries import load_baselines as load_baselines
from .rules import Rule as Rule
from .rules import Ultimate as Ultimate
from .searches import Budget as Budget
from .searches import cma_es as cma_es
from .searches import nelder_mead as nelder_mead
