"""Leaf optics given as numbers: shapes, derivatives and refusals."""

import jax
import numpy as np
import pytest

from jaxlidar.optics.leaf import LeafOptics

LASERS = np.array([532.0, 1064.0])


def test_numbers_and_spectra(precision):
    R, T = LeafOptics(reflectance=0.5, transmittance=0.25)(LASERS)
    np.testing.assert_array_equal((R, T), [[0.5, 0.5], [0.25, 0.25]])
    assert R.dtype == precision
    R, T = LeafOptics(reflectance=np.array([0.5, 0.25]))(LASERS)
    np.testing.assert_array_equal((R, T), [[0.5, 0.25], [0, 0]])
    R, T = LeafOptics(0.5, 0.5)(532.0)
    assert R.shape == T.shape == ()


def test_differentiable():
    slopes = jax.grad(lambda optics: optics(LASERS)[0].sum())(LeafOptics(0.5, 0.25))
    assert (slopes.reflectance, slopes.transmittance) == (2, 0)
    assert jax.grad(lambda r: LeafOptics(r)(LASERS)[0].sum())(0.5) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-0.1,), r"reflectance = -0.1 .*\[0, 1\]"),
        ((0.5, 1.1), "transmittance = 1.1"),
        ((np.array([0.1, np.nan]),), "reflectance = nan"),
        ((0.7, 0.4), r"reflectance \+ transmittance = 1.1"),
        ((np.zeros(2), np.zeros(3)), "transmittance has 3 values where reflectance has 2"),
        ((np.zeros((2, 2)),), r"reflectance has shape \(2, 2\)"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        LeafOptics(*arguments)


def test_other_number_of_wavelengths_refused():
    with pytest.raises(ValueError, match="reflectance has 3 values"):
        LeafOptics(np.zeros(3))(LASERS)
