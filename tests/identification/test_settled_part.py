"""The samples of a record that depend little on the motions before it."""

import numpy as np
import pytest

from piezojax.identification.estimators.free_runs import LATEST, settled_part


def test_a_record_is_settled_once_its_range_is_covered():
    rising = np.concatenate([np.full(10, 5.0), np.linspace(0.0, 100.0, 101)])
    still = np.full(50, 50.0)
    found = settled_part(np.concatenate([rising, still]), slice(0, 161))
    # The input reaches 90 of its 100 V in the sample 10 + 90.
    assert found == slice(100, 161)


def test_a_record_that_covers_its_range_late_keeps_a_part():
    late = np.append(np.zeros(99), 100.0)
    assert settled_part(late, slice(0, 100)) == slice(int(LATEST * 100), 100)


@pytest.mark.parametrize("first", [0, 20])
def test_the_part_lies_in_the_training_part(first):
    swings = 50.0 + 40.0 * np.sin(np.arange(200.0))
    found = settled_part(swings, slice(first, 120))
    assert first < found.start < first + 10
    assert found.stop == 120
