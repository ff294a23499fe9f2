"""PROSPECT against prosail, against the published lidar simulator's Table 4, and its refusals."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import prosail
import pytest
from scipy.optimize import brentq

from jaxlidar.optics import prospect
from jaxlidar.optics.coefficients import TRAITS, load_coefficients, shipped
from jaxlidar.optics.leaf_surface import leaf_surface
from jaxlidar.optics.plate_model import plate_model
from jaxlidar.optics.prospect import Prospect
from tests.helpers import slow_unless

WAVELENGTHS = np.arange(400.0, 2501.0)
LASERS = np.array([532.0, 1064.0, 1550.0])
# Table 4 of the simulator's paper, percent: reflectance, transmittance, absorptance.
TABLE_4 = np.array([[36.0, 8.0, 56.0], [66.0, 30.0, 4.0], [57.0, 27.0, 16.0]])
LEAVES = (
    {"N": 1.5, "Cab": 40.0, "Car": 8.0, "Cbrown": 0.0, "Cw": 0.01, "Cm": 0.009},
    {"N": 1.0, "Cab": 5.0, "Car": 1.0, "Cbrown": 0.4, "Cw": 0.002, "Cm": 0.002},
    {"N": 2.7, "Cab": 90.0, "Car": 20.0, "Cbrown": 0.1, "Cw": 0.04, "Cm": 0.02},
)


def prosail_arguments(leaf):
    """Traits by the names that prosail gives them."""
    return {name.lower(): value for name, value in leaf.items()}


@pytest.mark.parametrize("leaf", LEAVES)
@pytest.mark.parametrize("version", ["5", "D"])
def test_against_prosail(leaf, version, precision):
    ant = {"Cant": 3.0} if version == "D" else {}
    _, R, T = prosail.run_prospect(
        **prosail_arguments(leaf), ant=ant.get("Cant", 0.0), prospect_version=version, alpha=40.0
    )
    reflectance, transmittance = Prospect(**leaf, **ant, version=version)(WAVELENGTHS)
    assert reflectance.dtype == precision
    # The bound of both precisions; double precision agrees to 1e-13 (examples/validation).
    np.testing.assert_allclose(reflectance, R, atol=1e-5)
    np.testing.assert_allclose(transmittance, T, atol=1e-5)


def test_against_prosail_at_another_incidence():
    _, R, T = prosail.run_prospect(**prosail_arguments(LEAVES[0]), alpha=59.0)
    np.testing.assert_allclose(Prospect(**LEAVES[0], alpha=59.0)(WAVELENGTHS), (R, T), atol=1e-5)


def optics_of_total(K, face):
    """R, T and absorptance of a leaf of 3.4 plates with the total optical depth K."""
    return [float(x) for x in plate_model(K / 3.4, 3.4, face)]


def test_table_4_from_its_absorptances():
    """With D's refractive index, N = 3.4 and K solved from the absorptance, R and T round to the table's."""
    table = shipped("D")
    with jax.enable_x64(True):
        for wavelength, expected, expected_K in zip(LASERS, TABLE_4, (0.2756, 0.0098, 0.0487)):
            n = float(np.interp(wavelength, table.wavelength, table.index))
            face, target = leaf_surface(n, 40.0), expected[2] / 100
            optics = partial(optics_of_total, face=face)
            K = brentq(lambda K, optics=optics, target=target: optics(K)[2] - target, 1e-6, 5.0)
            assert abs(K / expected_K - 1) < 0.005
            np.testing.assert_array_equal(np.round(100 * np.array(optics(K))), expected)


def test_paper_leaf(precision):
    leaf = Prospect.paper()
    R, T = leaf(LASERS)
    per_cent = 100 * np.stack([R, T, leaf.absorptance(LASERS)], axis=1)
    # The table is rounded to whole per cents, an error of 0.29 (rms) by itself.
    assert np.sqrt(np.mean((per_cent - TABLE_4) ** 2)) < 0.3


def test_between_tabulated_wavelengths_coefficients_are_interpolated():
    with jax.enable_x64(True):
        table, leaf = shipped("D"), Prospect()
        n = np.mean(table.index[[150, 151]])
        K = np.mean(table.absorption[:, [150, 151]], axis=1) @ [40.0, 8.0, 0.0, 0.0, 0.01, 0.009]
        R, T, A = plate_model(K / 1.5, 1.5, leaf_surface(n))
        np.testing.assert_allclose(leaf(550.5), (R, T), rtol=1e-14)
        np.testing.assert_allclose(leaf.absorptance(550.5), A, rtol=1e-14)
        assert leaf(550.5)[0].shape == ()


@pytest.mark.parametrize("version", slow_unless(["D"], ["D", "PC", "4", "5"]))
def test_every_trait_is_differentiable(version, precision):
    leaf = Prospect(N=1.7, version=version)
    slopes, reverse = (jax.jit(kind(lambda leaf: leaf(LASERS)))(leaf) for kind in (jax.jacfwd, jax.jacrev))
    unit = float(np.finfo(precision).eps)
    traits = {name: float(getattr(leaf, name)) for name in ("N", *TRAITS[version])}
    for name in traits:
        step = 1e-6 * max(traits[name], 0.01)
        with jax.enable_x64(True):
            base, up = (
                np.asarray(Prospect(**{**traits, name: traits[name] + s}, version=version)(LASERS))
                for s in (0, step)
            )
        for output, (forward, backward) in enumerate(zip(slopes, reverse)):
            forward, backward = getattr(forward, name), getattr(backward, name)
            np.testing.assert_allclose(forward, backward, rtol=50 * unit, atol=unit)
            np.testing.assert_allclose(forward, (up - base)[output] / step, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("trait", ["Cant", "Cbrown"])
def test_gradient_at_a_trait_of_zero(trait):
    slope = jax.grad(lambda c: jnp.sum(Prospect(**{trait: c})(LASERS)[0]))(0.0)
    assert np.isfinite(slope)
    assert slope < 0


def test_a_leaf_without_pigments_water_and_dry_matter():
    """A leaf that absorbs nothing: gradients stay finite and R + T = 1."""
    names = TRAITS["D"]
    leaf = Prospect(1.0, *np.zeros(6))
    R, T = leaf(WAVELENGTHS)
    np.testing.assert_allclose(R + T, 1.0, rtol=1e-6)
    np.testing.assert_array_equal(leaf.absorptance(WAVELENGTHS), 0)
    slopes = jax.grad(lambda leaf: jnp.sum(leaf(WAVELENGTHS)[0] - 2 * leaf(WAVELENGTHS)[1]))(leaf)
    assert all(np.isfinite(getattr(slopes, name)) for name in ("N", *names))


def test_new_values_compile_nothing():
    traces = []

    @jax.jit
    def reflectance(leaf):
        traces.append(1)
        return leaf(LASERS)[0]

    values = [reflectance(Prospect(Cab=c, N=n)) for c, n in ((10.0, 1.2), (40.0, 1.5), (70, 2))]
    assert len(traces) == 1
    assert values[0][0] > values[1][0]


@pytest.mark.slow
def test_traced_wavelengths(precision):
    leaf = Prospect()
    np.testing.assert_allclose(
        jax.jit(lambda w: leaf(w))(LASERS), leaf(LASERS), rtol=20 * float(np.finfo(precision).eps)
    )
    rise = leaf(1551.0)[0] - leaf(1550.0)[0]
    np.testing.assert_allclose(jax.grad(lambda w: leaf(w)[0])(1550.5), rise, rtol=1e-3)
    assert np.isnan(jax.jit(lambda w: leaf(w))(jnp.array([399.0]))[0][0])


def random_leaves(n):
    """Leaves of version D whose traits differ by up to 30 %, as one `Prospect`."""
    rng = np.random.default_rng(1)
    values = [c * rng.uniform(0.7, 1.3, n) for c in (2.0, 40.0, 8.0, 1.0, 0.1, 0.01, 0.009)]
    return jax.vmap(lambda *traits: Prospect(*traits))(*map(jnp.asarray, values))


@pytest.mark.slow
def test_batches(precision, monkeypatch):
    monkeypatch.setattr(prospect, "_LEAVES_AT_ONCE", 3)
    leaves, wavelengths = random_leaves(7), np.array([450.0, 700.5, 1550.0])
    R, T = jax.jit(lambda leaves: leaves(wavelengths))(leaves)
    jacobian = jax.jit(lambda leaves: leaves.jacobian(wavelengths, batch_size=3))
    values, slopes = jacobian(leaves)
    tolerance = 20 * float(np.finfo(precision).eps)
    np.testing.assert_allclose(values, (R, T), rtol=tolerance)
    assert set(slopes) == {"N", *TRAITS["D"]}
    jacobian_of_leaf = jax.jit(jax.jacfwd(lambda leaf: leaf(wavelengths)))
    for i in range(7):
        leaf = jax.tree.map(lambda x, i=i: x[i], leaves)
        np.testing.assert_allclose((R[i], T[i]), leaf(wavelengths), rtol=tolerance)
        for output, expected in enumerate(jacobian_of_leaf(leaf)):
            for name, columns in slopes.items():
                np.testing.assert_allclose(
                    columns[output][i], getattr(expected, name), rtol=5 * tolerance, atol=tolerance
                )


def test_pro(shared, precision):
    """The authors' table of PROSPECT-PRO: pigments, water and index are those of PROSPECT-D."""
    table = load_coefficients(shared / "prospect" / "dataSpec_PRO.txt")
    table_D = shipped("D")
    np.testing.assert_array_equal(table.wavelength, table_D.wavelength)
    np.testing.assert_array_equal(table.index, table_D.index)
    np.testing.assert_array_equal(table.absorption[:5], table_D.absorption[:5])
    leaf = Prospect(Cp=0.0, Cc=0.0, version="PRO", coefficients=table)
    np.testing.assert_array_equal(leaf(WAVELENGTHS), Prospect(Cm=0.0)(WAVELENGTHS))
    darker = Prospect(version="PRO", coefficients=table)
    assert np.all(darker.absorptance(WAVELENGTHS) >= leaf.absorptance(WAVELENGTHS))
    # The same file is an equal table, a static field: nothing compiles anew.
    reread = load_coefficients(str(shared / "prospect" / "dataSpec_PRO.txt"))
    assert reread == table
    assert hash(reread) == hash(table)
    with pytest.raises(ValueError, match=r"Cm = 0.009 .*'PRO'.*only 0 is admissible"):
        Prospect(Cm=0.009, version="PRO", coefficients=table)
    with pytest.raises(ValueError, match="coefficients"):
        Prospect(coefficients=table)


HEADER = "lambda nrefrac SAC_CHL SAC_CAR SAC_ANT SAC_BROWN SAC_EWT SAC_LMA SAC_PROT SAC_CBC\n"
ROWS = "400 1.5 1 2 3 4 5 6 7 8\n401 1.4 1 2 3 4 5 6 7 8\n"


def test_reader(tmp_path):
    path = tmp_path / "table.txt"
    path.write_text(HEADER + "\n" + ROWS)
    table = load_coefficients(path)
    np.testing.assert_array_equal(table.absorption[:, 0], [1, 2, 3, 4, 5, 7, 8])
    assert "400..401 nm" in repr(table)
    leaf = Prospect(version="PRO", coefficients=table)
    assert leaf(400.5)[0] > 0
    with pytest.raises(ValueError, match=r"wavelengths = 532 .*\[400, 401\]"):
        leaf(532.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: the file is empty"),
        (HEADER.replace("SAC_CBC", "") + ROWS, "line 1: the header lacks SAC_CBC"),
        (HEADER + ROWS + "402 1.4 1 2\n", "line 4: 4 columns"),
        (HEADER + ROWS.replace("1.4", "oops"), "line 3: nrefrac = 'oops'"),
        (HEADER + ROWS.replace("1.4", "nan"), "line 3: nrefrac = 'nan'"),
        (HEADER + ROWS.replace("1.4", "0.4"), "line 3: nrefrac = 0.4"),
        (HEADER + ROWS.replace("401 1.4 1", "401 1.4 -1"), "line 3: SAC_CHL = '-1'"),
        (HEADER + ROWS.replace("401", "400"), "line 3: the wavelength 400 nm does not increase"),
        (HEADER + ROWS[: ROWS.index("401")], "line 2: the table ends after 1 rows"),
    ],
)
def test_damaged_file(tmp_path, text, message):
    path = tmp_path / "damaged.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"damaged.txt, {message}"):
        load_coefficients(path)


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_coefficients(tmp_path / "nothing.txt")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"N": 0.9}, r"N = 0.9 .*\[1, inf"),
        ({"N": np.nan}, "N = nan"),
        ({"Cab": -1.0}, r"Cab = -1 .*\[0, inf"),
        ({"Cw": np.inf}, "Cw = inf"),
        ({"Cm": np.nan}, "Cm = nan"),
        ({"Cab": np.array([1.0, 2.0])}, r"Cab has shape \(2,\)"),
        ({"alpha": 91.0}, r"alpha = 91 .*\[0, 90\]"),
        ({"alpha": -1.0}, "alpha = -1"),
        ({"alpha": np.nan}, "alpha = nan"),
        ({"version": "6"}, "version = '6' is none of '4', '5', 'D', 'PC', 'PRO'"),
        ({"version": "4", "Car": 8.0}, "Car = 8.0 is no trait of version '4'"),
        ({"version": "5", "Cant": 1.0}, "Cant = 1.0 is no trait of version '5'"),
        ({"Cp": 0.001}, "Cp = 0.001 is no trait of version 'D'"),
        ({"version": "PC", "Cm": 0.009}, "Cm = 0.009 is no trait of version 'PC'"),
        ({"version": "PRO"}, "coefficients = None with version 'PRO'"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Prospect(**arguments)


def test_traits_of_other_versions_may_be_zero():
    leaf = Prospect(version="4", Car=0.0, Cant=0, Cbrown=None)
    np.testing.assert_array_equal(leaf(LASERS), Prospect(version="4")(LASERS))


@pytest.mark.parametrize("wavelengths", [399.9, 2500.1, np.array([500.0, np.nan]), np.array([1.064])])
def test_wavelengths_refused(wavelengths):
    with pytest.raises(ValueError, match=r"wavelengths = .*\[400, 2500\]"):
        Prospect()(wavelengths)


def test_batch_size_refused():
    with pytest.raises(ValueError, match="batch_size = 0"):
        random_leaves(2).jacobian(LASERS, batch_size=0)


@pytest.mark.parametrize("version", ["4", "5", "D", "PC"])
def test_shipped_tables(version):
    table = shipped(version)
    assert table.absorption.shape == (len(TRAITS[version]), 2101)
    np.testing.assert_array_equal(table.wavelength, WAVELENGTHS)
    assert table.index.min() > 1.2
    assert table.index.max() < 1.6
    assert np.all(table.absorption >= 0)
    assert np.all(table.absorption.max(axis=1) > 0)


@pytest.mark.parametrize(("version", "name"), [("D", "prospectd"), ("5", "prospect5")])
def test_shipped_tables_equal_prosail(version, name):
    table, prosail_table = shipped(version), getattr(prosail.spectral_lib, name)
    columns = {"Cab": "kab", "Car": "kcar", "Cant": "kant", "Cbrown": "kbrown", "Cw": "kw", "Cm": "km"}
    for trait, column in zip(TRAITS[version], table.absorption):
        # prosail stores its version 5 in single precision.
        np.testing.assert_allclose(column, getattr(prosail_table, columns[trait]), rtol=1e-7)
    np.testing.assert_allclose(table.index, prosail_table.nr, rtol=1e-7)


def test_the_derivative_by_a_tabulated_wavelength_is_that_of_central_differences():
    """At 700 nm, where chlorophyll's absorption falls steeply, one-sided slopes differ by 5 % and more."""
    leaf, step = Prospect(), 0.5
    with jax.enable_x64():
        leaf = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), leaf)
        at = jax.jit(lambda wavelength: jnp.stack(leaf(wavelength)))
        slope = jax.jacfwd(at)(jnp.float64(700.0))
        difference = (at(jnp.float64(700.0 + step)) - at(jnp.float64(700.0 - step))) / (2.0 * step)
        one_sided = (at(jnp.float64(700.0 + step)) - at(jnp.float64(700.0))) / step
        np.testing.assert_allclose(at(jnp.float64(700.0)), leaf(700.0), rtol=1e-10)
    np.testing.assert_allclose(slope, difference, rtol=5e-3)
    assert np.all(np.abs(np.asarray(one_sided / difference) - 1.0) > 0.02)
