"""Intensity factors of facets and phase functions, against their integrals and against the mean over normals.

An intensity factor is pi times a density per steradian. Over all directions the reflected lobe of facets, its
transmitted one, and that of a phase function each integrate to pi, and straight back facets return 2/3.
"""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

import jaxlidar as jl
from jaxlidar.optics.facets import facet_reflection, facet_transmission

TOLERANCE = 1e-5


def phase_factor(g):
    """Intensity factor of a phase function, as a function of the cosine of the scattering angle."""
    phase = jl.Isotropic(albedo=0.5) if g is None else jl.HenyeyGreenstein(albedo=0.5, g=g)

    def factor(cosine):
        sine = jnp.sqrt(1.0 - cosine * cosine)
        zero, one = jnp.zeros_like(cosine), jnp.ones_like(cosine)
        return phase.intensity_factor((zero, zero, one), (sine, zero, cosine))

    return factor


LOBES = {
    "facets, reflected": facet_reflection,
    "facets, transmitted": facet_transmission,
    "isotropic": phase_factor(None),
    "forward": phase_factor(0.7),
    "backward": phase_factor(-0.4),
}


@pytest.mark.parametrize("name", LOBES)
def test_every_lobe_integrates_to_its_energy(name):
    cosine, weight = np.polynomial.legendre.leggauss(200)
    with jax.enable_x64(True):
        factor = np.asarray(LOBES[name](jnp.asarray(cosine)), float)
    # The azimuth gives 2 pi; the density is the factor over pi.
    energy = 2.0 * np.sum(weight * factor)
    assert energy == pytest.approx(1.0, abs=TOLERANCE)
    assert 1.005 * energy != pytest.approx(1.0, abs=TOLERANCE)


@pytest.mark.parametrize(("double", "rtol"), [(False, 5e-7), (True, 1e-13)])
def test_facets_are_exact_to_the_last_digits(double, rtol):
    """Against 40 digits, also where sin b and b cos b cancel, and with derivatives."""
    near_ends = np.logspace(-15 if double else -6, -1, 30)
    with jax.enable_x64(double), mpmath.workdps(40):
        cosine = jnp.asarray(np.concatenate([np.linspace(-0.999, 0.999, 100), 1.0 - near_ends]), float)
        reflection, slope = jax.vmap(jax.value_and_grad(facet_reflection))(cosine)
        exact = [mpmath.mpf(float(c)) for c in cosine]
        factor = 2 / (3 * mpmath.pi)
        expected = [float(factor * (mpmath.sqrt(1 - c * c) - c * mpmath.acos(c))) for c in exact]
        expected_slope = [float(-factor * mpmath.acos(c)) for c in exact]
        mirrored = facet_transmission(-cosine)
        np.testing.assert_allclose(reflection, expected, rtol=rtol)
        np.testing.assert_allclose(mirrored, expected, rtol=rtol)
        np.testing.assert_allclose(slope, expected_slope, rtol=10 * rtol, atol=10 * rtol)
        # Planted: an error of a few last digits.
        with pytest.raises(AssertionError):
            np.testing.assert_allclose((1.0 + 4 * rtol) * reflection, expected, rtol=rtol)


@pytest.mark.parametrize("angle", [10.0, 60.0, 90.0, 135.0, 180.0])
def test_facets_are_the_mean_over_normals(angle):
    """The integral over normals of |n.w| (n.v) / pi, with n on the side from which light comes."""
    b = np.deg2rad(angle)

    def over_azimuth(cosine):
        # w = -z: normals with z > 0 are lit. v lies at the angle pi - b from z.
        sine, across, along = np.sqrt(1 - cosine * cosine), np.sin(b), -np.cos(b)

        def seen(phi):
            return max(sine * np.cos(phi) * across + cosine * along, 0.0)

        # The lit and seen azimuths end where n.v changes sign.
        edge = -cosine * along / max(sine * across, 1e-12)
        end = np.pi if edge <= -1.0 else 0.0 if edge >= 1.0 else np.arccos(edge)
        return cosine * 2.0 * quad(seen, 0.0, end, epsabs=1e-9)[0] / np.pi

    exact = quad(over_azimuth, 0.0, 1.0, epsabs=1e-8, limit=200)[0]
    with jax.enable_x64(True):
        reflected, transmitted = (
            float(f(jnp.asarray(np.cos(x))))
            for f, x in ((facet_reflection, b), (facet_transmission, np.pi - b))
        )
    assert reflected == pytest.approx(exact, abs=TOLERANCE)
    assert transmitted == pytest.approx(exact, abs=TOLERANCE)
