"""Warnings of values that are admissible but absurd, as if in another unit, with the unit that is likely."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from jaxlidar import UnitWarning
from jaxlidar._fields.checks import Magnitude
from jaxlidar.plants import habits
from jaxlidar.sensors import scan, survey
from tests.helpers import ask

UNKNOWN = inversion.Unknown(lambda s: s.ground.reflectance, bounds=(0.0, 1.0))
CUBE = np.full((1, 1, 1), 0.5)

ABSURD = {
    "divergence": (lambda: jl.Lidar(divergence=3e-4), "3e-4 mrad", "in rad.* is 0.3 mrad"),
    "wavelength": (lambda: jl.Lidar(wavelength=1.064), "1.064 nm", "in um.* is 1064 nm"),
    "one of the wavelengths": (lambda: jl.Lidar(wavelength=(1.55, 1064.0)), "1.55 nm", "in um.* is 1550 nm"),
    "wavelength in m": (lambda: jl.Lidar(wavelength=532e-9), "5.32e-7 nm", "in m.* is 532 nm"),
    "altitude": (lambda: jl.Lidar(altitude=0.5), "0.5 m", "in km.* is 500 m"),
    "altitude, large": (lambda: jl.Lidar(altitude=4e8), "4e8 m", "in mm.* is 400000 m"),
    "altitude, beyond all units": (lambda: jl.Lidar(altitude=1e20), "1e20 m", "Check its unit"),
    "aperture": (lambda: jl.Lidar(aperture=200.0), "200 m", "in mm.* is 0.2 m"),
    "field of view": (lambda: jl.Lidar(field_of_view=2e-5), "2e-5 mrad", "in rad.* is 0.02 mrad"),
    "energy": (lambda: jl.Lidar(energy=1000.0), "1000 J", "in uJ.* is 0.001 J"),
    "sampling interval": (lambda: jl.Lidar(sampling_interval=1e-9), "1e-9 ns", "in s.* is 1 ns"),
    "jitter": (lambda: jl.Lidar(jitter=1e-10), "1e-10 ns", "in s.* is 0.1 ns"),
    "fwhm": (lambda: jl.GaussianPulse(fwhm=6e-9), "6e-9 ns", "in s.* is 6 ns"),
    "length": (lambda: jl.RectangularPulse(length=6000.0), "6000 ns", "in ps.* is 6 ns"),
    "decay": (lambda: jl.ExponentiallyModifiedGaussianPulse(2.0, 3e-9), "3e-9 ns", "in s.* is 3 ns"),
    "visibility": (lambda: jl.Atmosphere(visibility=23000.0), "23000 km", "in m.* is 23 km"),
    "wavelength of a spectrum": (lambda: jl.Spectrum([0.4, 2.5], [0.1, 0.2]), "0.4 nm", "in um.* is 400 nm"),
    "tree": (lambda: jl.Habit(height=1500.0), "1500 m", "in cm.* is 15 m"),
    "conifer": (lambda: jl.conifer(height=2000.0), "2000 m", "in cm.* is 20 m"),
    "trunk": (lambda: jl.Habit(trunk_diameter=89.0), "89 m", "in cm.* is 0.89 m"),
    "pigment by area of a metre": (lambda: jl.Prospect(Cab=400.0), "400 ug/cm2", "in mg/m2.* is 40 ug/cm2"),
    "Cw": (lambda: jl.Prospect(Cw=100.0), "100 cm", "in um.* is 0.01 cm"),
    "Cm": (lambda: jl.Prospect(Cm=90.0), "90 g/cm2", "in g/m2.* is 0.009 g/cm2"),
    "Cab": (lambda: jl.Prospect(Cab=4e5), "4e5 ug/cm2", "in ug/m2.* is 40 ug/cm2"),
    "voxel size": (lambda: jl.VoxelMap.from_lad(CUBE, voxel_size=2500.0), "2500 m", "in mm.* is 2.5 m"),
    "scale height": (lambda: jl.Atmosphere(rayleigh_scale_height=8.45), "8.45 m", "in km.* is 8450 m"),
    "wavelength of a record": (lambda: jl.record(np.ones((1, 2)), 1.064, jl.Receiver()), "1.064 nm", "in um"),
}


@pytest.mark.parametrize("name", list(ABSURD))
def test_absurd_values_are_warned_of_at_the_users_line(name):
    make, stated, hint = ABSURD[name]
    with pytest.warns(UnitWarning, match=hint) as warning_list:
        make()
    assert len(warning_list) == 1
    number, unit = stated.split()
    value, _, remainder = str(warning_list[0].message).partition(" = ")[2].partition(" ")
    assert float(value) == pytest.approx(float(number), rel=1e-5)
    assert remainder.startswith(f"{unit} is absurdly")
    assert warning_list[0].filename == __file__


def test_plausible_values_are_not_warned_of():
    """Zero is no absurd value, and instruments from a bench to an orbit are admitted."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jl.Lidar(altitude=5.0, divergence=0.0, jitter=0.0, aperture=0.01, energy=1e-12, wavelength=355.0)
        jl.Lidar(altitude=4e5, divergence=1e-3, sampling_interval=1e3, aperture=80.0, wavelength=1e4)
        jl.Prospect(Cab=0.0, Car=150.0, Cw=0.0, Cm=0.05)
        jl.VoxelMap.from_lad(CUBE, voxel_size=1e-3)
        jl.VoxelMap.from_lad(CUBE, voxel_size=(1e3, 1e3, 0.1))


def test_one_value_is_warned_of_once():
    """Copies by the library and by JAX do not warn again; a change by the user does."""
    with pytest.warns(UnitWarning, match="divergence") as warning_list:
        lidar = jl.Lidar(divergence=3e-4)
    assert len(warning_list) == 1
    scene, key = jl.Scene(ground=jl.Ground(slope=10.0)), jax.random.key(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plan = jl.plan(lidar, scene, effects={"divergence": False})
        jl.simulate(lidar, scene, key=key, plan=plan)
        jax.tree.map(lambda a: a, lidar)
        ask(inversion.cramer_rao, None, lidar, scene, [UNKNOWN], noise=0.01, key=key)
    with pytest.warns(UnitWarning, match="divergence") as warning_list:
        dataclasses.replace(lidar, altitude=500.0)
    assert [w.filename for w in warning_list] == [__file__]


def test_traced_values_are_not_warned_of():
    divergence_of = jax.jit(lambda d: jl.Lidar(divergence=d).divergence)
    assert float(divergence_of(3e-4)) == pytest.approx(3e-4)
    traits = jnp.asarray([50.0, 100.0])
    assert jax.vmap(lambda c: jl.Prospect(Cw=c))(traits).Cw.shape == (2,)


def test_likely_units_differ_from_the_unit():
    classes = filter(dataclasses.is_dataclass, vars(jl).values())
    units = [field.metadata.get("unit") for kind in classes for field in dataclasses.fields(kind)]
    units += [habits._HEIGHT, habits._DIAMETER, scan._HALF_ANGLE, survey._PULSE_RATE]
    magnitudes = [unit for unit in units if isinstance(unit, Magnitude)]
    assert len(magnitudes) > 20
    for unit, low, high, factors in magnitudes:
        assert 0 <= low < high
        assert unit not in factors
        assert all(factor > 0 and factor != 1 for factor in factors.values())
