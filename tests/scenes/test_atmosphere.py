"""The atmosphere: published numbers, closed forms by quadrature, and derivatives."""

import csv
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlidar.scenes.atmosphere import Atmosphere, aerosol_extinction, rayleigh_optical_depth
from tests.helpers import BY_PRECISION

WAVELENGTHS = np.array([355.0, 532.0, 1064.0, 1550.0])


@pytest.fixture
def reference(shared):
    with open(shared / "reference" / "atmosphere.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_rayleigh_reference(reference, precision):
    rows = [row for row in reference if row["kind"] == "rayleigh"]
    assert len(rows) == 6
    for row in rows:
        wavelength = float(row["lambda_nm"])
        tolerance = 0.01 if wavelength == 1550 else 0.005
        tau = float(rayleigh_optical_depth(wavelength))
        assert tau == pytest.approx(float(row["tau_colour"]), rel=0.005)
        assert tau == pytest.approx(float(row["tau_bodhaine_fit30"]), rel=tolerance)
        surface = 1e3 * float(Atmosphere(visibility=None).extinction(wavelength, 0.0))
        assert surface == pytest.approx(float(row["beta_sca_per_km_15C_1013"]), rel=0.005)


def test_visibility_reference(reference):
    rows = [row for row in reference if row["kind"] == "visibility"]
    assert len(rows) == 32
    for row in rows:
        wavelength, visibility = float(row["lambda_nm"]), float(row["V_km"])
        for model in ("kim", "kruse"):
            value = 1e3 * float(aerosol_extinction(wavelength, visibility, model))
            assert value == pytest.approx(float(row[f"sigma_{model}_per_km"]), rel=1e-5)


def test_rayleigh_formula():
    """Against Bodhaine's fit (eq. 30), which holds from 250 to 850 nm, and the fourth power beyond."""
    for nm in (300.0, 400.0, 550.0, 700.0, 850.0):
        x = (nm / 1000) ** 2
        fit = (
            0.0021520 * (1.0455996 - 341.29061 / x - 0.90230850 * x) / (1 + 0.0027059889 / x - 85.968563 * x)
        )
        assert float(rayleigh_optical_depth(nm)) == pytest.approx(fit, rel=5e-4)
    ratio = rayleigh_optical_depth(1500.0) / rayleigh_optical_depth(3000.0)
    assert float(ratio) == pytest.approx(16, rel=0.01)


@pytest.mark.parametrize(
    ("visibility", "kim", "kruse"),
    [
        (0.2, 0.0, 0.585 * 0.2 ** (1 / 3)),
        (0.7, 0.2, 0.585 * 0.7 ** (1 / 3)),
        (3.0, 0.82, 0.585 * 3 ** (1 / 3)),
        (6.0, 1.3, 1.3),
        (50.0, 1.3, 1.3),
        (51.0, 1.6, 1.6),
    ],
)
def test_aerosol_formula(visibility, kim, kruse):
    for model, q in (("kim", kim), ("kruse", kruse)):
        expected = 3.912e-3 / visibility * (1064 / 550) ** -q
        assert float(aerosol_extinction(1064.0, visibility, model)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("altitude", [0.5, 1000.0, 400e3])
@pytest.mark.parametrize("height", [-50.0, 0.0, 0.4, 300.0])
def test_optical_depth_is_the_integral(precision, altitude, height):
    air = Atmosphere(visibility=8.0, base_height=700.0)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    integral = 0.0
    if altitude > height:
        # Panels of one aerosol scale height or less where there is air, Gauss-Legendre on each.
        edges = np.minimum(altitude, height + np.append(np.linspace(0, 3e4, 31), [6e4, 1e5, 2e5, 5e5]))
        half = 0.5 * np.diff(edges)[:, None]
        z = edges[:-1, None] + half * (1 + nodes)
        with jax.enable_x64(True):
            extinction = Atmosphere(visibility=8.0, base_height=700.0).extinction(532.0, z)
        integral = np.sum(half * weights * np.asarray(extinction)) / math.cos(math.radians(35.0))
    depth = air.optical_depth(532.0, height, altitude, 35.0)
    # The heights are rounded, and the thinnest path here is 0.1 m.
    tolerance = 5e-6 if precision == "float32" else 1e-9
    assert float(depth) == pytest.approx(integral, rel=tolerance)
    two_way = air.two_way_transmittance(532.0, height, altitude, 35.0)
    assert float(two_way) == pytest.approx(math.exp(-2 * integral), rel=tolerance)


def test_shapes_and_limits():
    air = Atmosphere(lidar_ratio=50.0)
    heights = np.linspace(-5.0, 40.0, 6)
    for method in (air.optical_depth, air.two_way_transmittance, air.backscatter):
        assert method(WAVELENGTHS, heights, 1000.0).shape == (4, 6)
        assert method(532.0, heights, 1000.0).shape == (6,)
        assert method(WAVELENGTHS, 0.0, 1000.0, 10.0).shape == (4,)
        assert method(532.0, 0.0, 1000.0).shape == ()
    assert air.extinction(WAVELENGTHS, heights.reshape(2, 3)).shape == (4, 2, 3)
    # The whole atmosphere from orbit is Rayleigh's optical depth.
    molecules = Atmosphere(visibility=None)
    np.testing.assert_allclose(
        molecules.optical_depth(WAVELENGTHS, 0.0, 400e3), rayleigh_optical_depth(WAVELENGTHS), rtol=1e-6
    )
    empty = Atmosphere(visibility=None, rayleigh=False, lidar_ratio=50.0)
    assert np.all(empty.two_way_transmittance(WAVELENGTHS, heights, 1000.0) == 1)
    assert np.all(empty.backscatter(WAVELENGTHS, heights, 1000.0) == 0)
    assert np.all(empty.extinction(WAVELENGTHS, heights) == 0)
    # The sensor sees nothing of the air behind it.
    assert float(air.two_way_transmittance(532.0, 20.0, 10.0)) == 1.0
    assert np.all(Atmosphere().backscatter(WAVELENGTHS, heights, 1000.0) == 0)
    thick = Atmosphere(visibility=0.01, lidar_ratio=50.0)
    assert float(thick.two_way_transmittance(532.0, 0.0, 400e3)) == 0.0


def test_backscatter_sums_to_its_closed_form():
    """With one kind of scatterer all of the return is pi / (2 lidar ratio) * (1 - two-way transmittance)."""
    for air, ratio in (
        (Atmosphere(visibility=None, lidar_ratio=30.0), 8 * math.pi / 3),
        (Atmosphere(visibility=3.0, rayleigh=False, lidar_ratio=30.0), 30.0),
    ):
        with jax.enable_x64(True):
            edges = np.concatenate([np.linspace(0, 2e4, 20001), np.linspace(2e4, 1e5, 2001)[1:]])
            slant = 1 / math.cos(math.radians(20))
            centres, lengths = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges) * slant
            total = np.sum(air.backscatter(WAVELENGTHS, centres, 1e5, 20.0) * lengths[None, :], axis=1)
            expected = math.pi / (2 * ratio) * (1 - air.two_way_transmittance(WAVELENGTHS, 0.0, 1e5, 20.0))
        np.testing.assert_allclose(total, expected, rtol=1e-5)


def test_backscatter_value():
    """At the sensor the transmittance is 1, and the return pi (k_molecules 3 / (8 pi) + k_aerosol / S)."""
    air = Atmosphere(visibility=10.0, lidar_ratio=40.0)
    molecules = float(Atmosphere(visibility=None).extinction(532.0, 100.0))
    aerosol = float(air.extinction(532.0, 100.0)) - molecules
    expected = math.pi * (molecules * 3 / (8 * math.pi) + aerosol / 40)
    assert float(air.backscatter(532.0, 100.0, 100.0)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
@BY_PRECISION
def test_derivatives(precision):
    air = Atmosphere(visibility=15.0, lidar_ratio=50.0, base_height=200.0)
    heights = jnp.linspace(0.0, 30.0, 4)
    dynamic, static = eqx.partition(air, eqx.is_array)
    assert len(jax.tree.leaves(dynamic)) == 5

    def total(air_and_height):
        a, h = air_and_height
        a = eqx.combine(a, static)
        return jnp.sum(
            a.two_way_transmittance(WAVELENGTHS, h, 1000.0, 20.0)
            + 1e4 * a.backscatter(WAVELENGTHS, h, 1000.0, 20.0)
        )

    gradient = jax.grad(total)((dynamic, heights))
    forward = jax.jacfwd(total)((dynamic, heights))
    for g, f in zip(jax.tree.leaves(gradient), jax.tree.leaves(forward), strict=True):
        assert np.all(np.isfinite(g))
        assert np.all(g != 0)
        np.testing.assert_allclose(g, f, rtol=1e-4 if precision == "float32" else 1e-10)
    if precision == "float64":
        for i, leaf in enumerate(jax.tree.leaves(dynamic)):
            leaves, tree = jax.tree.flatten(dynamic)

            def at(x, i=i, leaves=leaves, tree=tree):
                changed = jax.tree.unflatten(tree, [*leaves[:i], x, *leaves[i + 1 :]])
                return total((changed, heights))

            step = 1e-4 * leaf
            slope = (at(leaf + step) - at(leaf - step)) / (2 * step)
            np.testing.assert_allclose(jax.tree.leaves(gradient)[i], slope, rtol=1e-6)


@pytest.mark.parametrize("model", ["kim", "kruse"])
def test_finite_everywhere(precision, model):
    @jax.jit
    @jax.vmap
    def outputs(visibility, height):
        def value(visibility, altitude, height):
            air = Atmosphere(visibility=visibility, aerosol_model=model, lidar_ratio=50.0)
            arguments = (WAVELENGTHS, height, altitude, 89.0)
            return jnp.sum(air.two_way_transmittance(*arguments)) + jnp.sum(air.backscatter(*arguments))

        return jax.value_and_grad(value, argnums=(0, 1, 2))(visibility, 400e3, height)

    visibility, height = jnp.meshgrid(
        jnp.array([0.01, 0.5, 1.0, 6.0, 50.0, 1e4]), jnp.array([-100.0, 0.0, 400e3, 500e3])
    )
    for out in jax.tree.leaves(outputs(visibility.ravel(), height.ravel())):
        assert np.all(np.isfinite(out))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"visibility": 0.0}, r"visibility = 0 .*\(0, inf\)"),
        ({"visibility": np.nan}, "visibility = nan"),
        ({"aerosol_model": "mie"}, "aerosol_model = 'mie'.*'kim', 'kruse'"),
        ({"rayleigh_scale_height": -1.0}, "rayleigh_scale_height = -1"),
        ({"aerosol_scale_height": 0.0}, "aerosol_scale_height = 0"),
        ({"lidar_ratio": 0.0}, "lidar_ratio = 0"),
        ({"base_height": 1e4}, r"base_height = 10000 .*\[-500, 9000\]"),
    ],
)
def test_inadmissible(arguments, message):
    with pytest.raises(ValueError, match=message):
        Atmosphere(**arguments)


def test_inadmissible_calls():
    air = Atmosphere()
    with pytest.raises(ValueError, match=r"wavelength = 100 .*\[230, 3000\]"):
        air.extinction(np.array([532.0, 100.0]), 0.0)
    with pytest.raises(ValueError, match="zenith = 90"):
        air.two_way_transmittance(532.0, 0.0, 100.0, 90.0)
    with pytest.raises(ValueError, match="altitude = nan"):
        air.two_way_transmittance(532.0, 0.0, np.nan)
    with pytest.raises(ValueError, match="visibility = -1"):
        aerosol_extinction(532.0, -1.0)
    with pytest.raises(ValueError, match="model = 'x'"):
        aerosol_extinction(532.0, 1.0, "x")
