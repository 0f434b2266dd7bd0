"""The cap on Gaussians: which points a model begins with."""

import numpy as np
import pytest

from turbogs_plugin.errors import InputError
from turbogs_plugin.plan.caps import chosen_points


def test_a_model_begins_with_points_from_the_first_to_the_last_that_leave_room():
    chosen = chosen_points(100, 30, 10)
    assert len(chosen) == 20 and (chosen[0], chosen[-1]) == (0, 99)
    assert set(np.diff(chosen)) == {5, 6}
    assert chosen_points(20, 30, 10) == chosen_points(20, 0, 10) == slice(None)
    with pytest.raises(InputError, match="leaves no room beside the 30"):
        chosen_points(20, 30, 30)
