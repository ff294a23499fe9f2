"""Errors of what a fit of a layered canopy says."""

import numpy as np
import pytest

from inversion.scene import layered_canopy
from inversion.scene.layered_canopy import LAYERS


def test_errors_of_sums_need_the_covariance():
    values = {"a": np.array(1.0), "b": np.array([1.0, 2.0]), "c": np.array(3.0)}
    covariance = np.diag([1.0, 4.0, 9.0, np.inf])
    covariance[0, 1] = covariance[1, 0] = -1.0
    stderr = layered_canopy._propagated({"a": 1.0, "b": np.array([1.0, 0.0])}, covariance, values)
    assert stderr == pytest.approx(np.sqrt(1.0 + 4.0 - 2.0))


def test_the_top_is_uncertain_by_the_layers_that_may_be_empty():
    density, stderr = np.full(LAYERS, 0.1), np.full(LAYERS, 0.01)
    # The underside of the uppermost layer, one below the top; then of the third from above.
    assert layered_canopy._top_error(density, stderr, 2.0) == pytest.approx(1.0)
    stderr[-2:] = 0.06
    assert layered_canopy._top_error(density, stderr, 2.0) == pytest.approx(3.0)
    # An empty layer between full ones tells nothing of the top.
    stderr[3] = 1.0
    assert layered_canopy._top_error(density, stderr, 2.0) == pytest.approx(3.0)
    assert layered_canopy._top_error(density, np.full(LAYERS, 1.0), 2.0) == pytest.approx(0.5 * 2.0 * LAYERS)
