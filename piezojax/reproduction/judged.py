"""A calibration as plain numbers: ratios of fitted and held-out cells, and values."""

from collections.abc import Mapping, Sequence
from typing import Any

from .calibration import EXPERIMENTS, Swap
from .cell import Cell
from .summary import ratio_of

BAR = 1.25
"""Most that the held-out geometric-mean ratio may be."""


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


def together(found: Mapping[str, Sequence[Swap]]) -> dict[str, Any]:
    """Return the ratios of all held-out cells, whatever their experiment, by half."""
    halves: dict[str, list[Cell]] = {}
    for swaps in found.values():
        for swap in swaps:
            halves.setdefault(swap.half, []).extend(swap.held_out)
    return {
        half: {"held_out": _ratios(cells), "bar": BAR, "met": ratio_of(cells) <= BAR}
        for half, cells in halves.items()
    }


def as_plain(name: str, swaps: Sequence[Swap]) -> dict[str, Any]:
    """Return both fits of ``EXPERIMENTS[name]`` as they go into calibration.json."""
    units = {n: q.unit for n, q in EXPERIMENTS[name].quantities().items()}
    return {
        swap.half: {
            "values": {
                n: {"value": value, "unit": units[n]}
                for n, value in swap.values.items()
            },
            "pull_towards_print": swap.strength,
            "doubts": list(swap.doubts),
            "selection": [found._asdict() for found in swap.rounds],
            "fitted": _ratios(swap.train),
            "held_out_without_doubts": _ratios(swap.alone),
            "held_out": _ratios(swap.held_out),
            "bar": BAR,
            "met": ratio_of(swap.held_out) <= BAR,
        }
        for swap in swaps
    }
