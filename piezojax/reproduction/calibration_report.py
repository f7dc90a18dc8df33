"""Report of a calibration: ratios of fitted and held-out cells, and fitted values."""

from collections.abc import Mapping, Sequence
from typing import Any

from .calibration import EXPERIMENTS, HalfFit
from .cell import Cell
from .summary import ratio_of

TARGET = 1.25
"""Largest geometric-mean ratio of the held-out cells that meets the target."""


def _ratios(cells: Sequence[Cell]) -> dict[str, Any]:
    places = sorted({(cell.table, cell.column) for cell in cells})
    return {
        "geomean_ratio": ratio_of(cells),
        "cells": len(cells),
        "columns": {
            f"{table} {column}": ratio_of(
                [c for c in cells if (c.table, c.column) == (table, column)]
            )
            for table, column in places
        },
    }


def held_out_ratios(fits: Mapping[str, Sequence[HalfFit]]) -> dict[str, Any]:
    """Return the ratios of the held-out cells of all experiments, by half."""
    halves: dict[str, list[Cell]] = {}
    for experiment in fits.values():
        for fit in experiment:
            halves.setdefault(fit.half, []).extend(fit.held_out)
    return {
        half: {
            "held_out": _ratios(cells),
            "target": TARGET,
            "met": ratio_of(cells) <= TARGET,
        }
        for half, cells in halves.items()
    }


def calibration_report(name: str, fits: Sequence[HalfFit]) -> dict[str, Any]:
    """Return both fits of ``EXPERIMENTS[name]`` as plain data for calibration.json."""
    units = {n: q.unit for n, q in EXPERIMENTS[name].quantities().items()}
    return {
        fit.half: {
            "values": {
                n: {"value": value, "unit": units[n]} for n, value in fit.values.items()
            },
            "penalty_weight": fit.penalty_weight,
            "suspect_numbers": list(fit.suspects),
            "selection": [entry._asdict() for entry in fit.rounds],
            "fitted": _ratios(fit.train),
            "held_out_stage_only": _ratios(fit.stage_only),
            "held_out": _ratios(fit.held_out),
            "target": TARGET,
            "met": ratio_of(fit.held_out) <= TARGET,
        }
        for fit in fits
    }
