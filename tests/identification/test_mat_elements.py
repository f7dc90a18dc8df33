"""Damaged MATLAB files are refused before SciPy reads them."""

import io

import numpy as np
import pytest
from scipy.io import savemat

from piezojax.identification.records.columns import ContentError
from piezojax.identification.records.mat_elements import check_elements

RIGHT = {
    "t": np.arange(9.0),
    "fs": 1e3,
    "flag": True,
    "text": "bench",
    "whole": np.arange(5, dtype=np.int16),
    "complex": np.array([1.0 + 2.0j, 3.0]),
    "stage": {"drive": np.ones((2, 3)), "inner": {"a": 1.0}},
    "cells": np.array([np.arange(2.0), "x", np.zeros((0, 0))], dtype=object),
}


def written(**options):
    file = io.BytesIO()
    savemat(file, RIGHT, **options)
    return file.getvalue()


@pytest.mark.parametrize("packed", [False, True])
def test_valid_files_pass(packed):
    check_elements(written(do_compression=packed, oned_as="column"))
    check_elements(written()[:128])  # no variable at all


# first variable: tag at 128, flags at 136, shape at 152, name at 168, data at 176
@pytest.mark.parametrize(
    ("place", "byte"),
    [(128, 99), (129, 1), (136, 200), (152, 19), (176, 8), (177, 77), (131, 5)],
)
def test_an_unknown_type_or_size_is_refused(place, byte):
    content = bytearray(written())
    content[place] = byte
    with pytest.raises(ContentError, match="the file is damaged"):
        check_elements(bytes(content))


@pytest.mark.parametrize("packed", [False, True])
def test_a_file_cut_short_is_refused(packed):
    content = written(do_compression=packed)
    for end in (len(content) - 1, len(content) // 2, 150):
        with pytest.raises(ContentError, match="the file is damaged"):
            check_elements(content[:end])


def test_a_broken_archive_is_refused():
    content = bytearray(written(do_compression=True))
    content[136:150] = bytes(14)
    with pytest.raises(ContentError, match="the file is damaged"):
        check_elements(bytes(content))
