"""The lidar: defaults, conventions of axes and angles, and inadmissible arguments."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlidar.extend import along
from jaxlidar.sensors.catalogue import instrument
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.pulse import GaussianPulse, RectangularPulse
from jaxlidar.sensors.receiver import Receiver
from jaxlidar.trace.first.footprint import make_beam


def test_without_arguments_it_is_table_1(precision):
    lidar = Lidar()
    assert float(lidar.altitude) == 1000.0
    assert isinstance(lidar.pulse, GaussianPulse)
    assert float(lidar.pulse.fwhm) == 6.0
    np.testing.assert_array_equal(lidar.wavelength, [1064.0])
    np.testing.assert_allclose(lidar.divergence, 0.3, rtol=1e-7)
    np.testing.assert_allclose(lidar.aperture, 0.2, rtol=1e-7)
    assert float(lidar.zenith) == 0.0
    assert lidar.altitude.dtype == precision
    np.testing.assert_allclose(lidar.footprint_radius, 0.15, rtol=1e-6)
    np.testing.assert_allclose(lidar.aperture_half_angle, 1e-4, rtol=1e-6)
    np.testing.assert_allclose(lidar.aperture_area, np.pi * 0.01, rtol=1e-6)
    np.testing.assert_allclose(lidar.sensor, [0.0, 0.0, 1000.0])
    assert lidar.field_of_view is None
    assert lidar.receiver.window == "fixed"


def test_the_public_keywords():
    lidar = Lidar(
        wavelength=(532.0, 1064.0, 1550.0),
        altitude=1000.0,
        pulse=RectangularPulse(length=4.0),
        divergence=0.3,
        aperture=0.2,
        zenith=10,
        azimuth=30,
        energy=(1e-3, 2e-3, 3e-3),
        sampling_interval=1,
        profile="top-hat",
        position=(3.0, -2.0),
        field_of_view=1.0,
        jitter=0.1,
        efficiency=0.7,
        receiver=Receiver(background=1e-18),
    )
    np.testing.assert_allclose(lidar.energy_per_wavelength, [1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose(lidar.efficiency_per_wavelength, [0.7, 0.7, 0.7])
    assert jax.tree.all(jax.tree.map(eqx.is_inexact_array, lidar))


@pytest.mark.parametrize(
    ("azimuth", "east", "north"),
    [(0, 0, 1), (90, 1, 0), (180, 0, -1), (270, -1, 0), (45, 0.5**0.5, 0.5**0.5)],
)
def test_azimuth_is_the_compass_direction_of_travel(azimuth, east, north, precision):
    lidar = Lidar(zenith=30.0, azimuth=azimuth, altitude=400.0, position=(10.0, 20.0))
    np.testing.assert_allclose(lidar.direction, [east / 2, north / 2, -(0.75**0.5)], atol=1e-6)
    slant = 400.0 / 0.75**0.5
    np.testing.assert_allclose(lidar.range_to_reference, slant, rtol=1e-6)
    # A beam that travels east comes from a sensor in the west, at the given altitude.
    np.testing.assert_allclose(
        lidar.sensor, [10 - slant * east / 2, 20 - slant * north / 2, 400.0], rtol=1e-5
    )
    np.testing.assert_allclose(
        lidar.sensor + lidar.range_to_reference * lidar.direction, [10.0, 20.0, 0.0], atol=1e-4
    )
    np.testing.assert_allclose(lidar.footprint_radius, slant * 0.15e-3, rtol=1e-6)


def test_values_are_leaves_and_do_not_retrace():
    traces = []

    @eqx.filter_jit
    def radius(lidar):
        traces.append(None)
        return lidar.footprint_radius

    np.testing.assert_allclose([radius(Lidar(altitude=a)) for a in (10.0, 4e5)], [1.5e-3, 60.0], rtol=1e-6)
    assert len(traces) == 1
    slope = jax.grad(lambda a: Lidar(altitude=a, zenith=60.0).range_to_reference)(100.0)
    np.testing.assert_allclose(slope, 2.0, rtol=1e-6)
    slope = jax.grad(lambda x: jnp.sum(Lidar(position=(x, 0.0), zenith=89.0).sensor))(1.0)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"wavelength": 0.0}, r"wavelength = 0 .*\(0, inf\)"),
        ({"wavelength": np.nan}, "wavelength = nan"),
        ({"wavelength": (1064.0, 532.0)}, r"wavelength = \[1064.0, 532.0\] .*strictly increasing"),
        ({"wavelength": (532.0, 532.0)}, "strictly increasing"),
        ({"wavelength": np.zeros(0)}, "one or more"),
        ({"altitude": 0.0}, "altitude = 0"),
        ({"altitude": -5.0}, "altitude = -5"),
        ({"divergence": -0.1}, "divergence = -0.1"),
        ({"aperture": 0.0}, "aperture = 0"),
        ({"zenith": 89.5}, r"zenith = 89.5 .*\[0, 89\]"),
        ({"zenith": -1.0}, "zenith = -1"),
        ({"azimuth": np.nan}, "azimuth = nan"),
        ({"energy": 0.0}, "energy = 0"),
        ({"energy": (1e-3, 1e-3)}, r"energy has shape \(2,\)"),
        ({"sampling_interval": 0.0}, "sampling_interval = 0"),
        ({"profile": "square"}, "profile = 'square' is none of 'gaussian', 'top-hat'"),
        ({"position": (np.inf, 0.0)}, "position = inf"),
        ({"field_of_view": 0.0}, "field_of_view = 0"),
        ({"jitter": -0.1}, "jitter = -0.1"),
        ({"efficiency": 1.1}, r"efficiency = 1.1 .*\(0, 1\]"),
        ({"efficiency": 0.0}, "efficiency = 0"),
        ({"efficiency": (0.5, 0.5)}, "efficiency has shape"),
        ({"position": (1.0, 2.0, 3.0)}, r"position has shape \(3,\)"),
    ],
)
def test_inadmissible_input_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Lidar(**fields)


def test_an_instrument_stands_anywhere():
    """`dataclasses.replace` gives altitude and position again, and says the way out."""
    scanner = instrument("RIEGL VUX-1UAV")
    with pytest.raises(ValueError, match=r"altitude is given together with sensor; .* Lidar\.at places"):
        dataclasses.replace(scanner, sensor=(0.0, 0.0, 0.0))
    for zenith, azimuth in ((None, None), (120.0, 30.0)):
        placed = scanner.at((4e5, 5.3e6, 60.25), zenith, azimuth)
        again = dataclasses.replace(placed.at((1.0, 2.0, 3.0)), position=placed.position)
        assert eqx.tree_equal(placed, again)
        direct = {"sensor": (4e5, 5.3e6, 60.25), "zenith": zenith or 0.0, "azimuth": azimuth or 0.0}
        fields = dataclasses.fields(scanner)
        rest = {f.name: getattr(scanner, f.name) for f in fields if f.name not in ("altitude", "position")}
        assert eqx.tree_equal(placed, Lidar(**(rest | direct)))
    with pytest.raises(ValueError, match=r"sensor = \(0, 0\); admissible are three numbers"):
        scanner.at((0, 0))
    with pytest.raises(ValueError, match="zenith = 200"):
        scanner.at((0, 0, 0), zenith=200.0)


def test_the_longest_flight_returns_at_the_end_of_the_record():
    """From points around an oblique beam, in random directions: flight and return use up the path length.

    `longest_flight` is the distance after which the return path ends exactly with the record, and zero for
    points from which no light returns in time.
    """
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        beam = make_beam(Lidar(altitude=800.0, zenith=35.0, azimuth=20.0))
        x = tuple(jnp.asarray(v) for v in rng.uniform(-30.0, 30.0, (3, 200)))
        w = rng.normal(size=(3, 200))
        w = tuple(jnp.asarray(v) for v in w / np.linalg.norm(w, axis=0))
        max_path = jnp.asarray(rng.uniform(-50.0, 100.0, 200))
        flight = beam.longest_flight(x, w, max_path)
        path = np.asarray(flight + beam.excess(along(x, w, flight)))
        possible = np.asarray(beam.excess(x) < max_path)
    assert 50 < possible.sum() < 200
    np.testing.assert_allclose(path[possible], max_path[possible], atol=1e-6)
    assert np.all(np.asarray(flight)[~possible] == 0.0)
