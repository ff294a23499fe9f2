"""Spectra: the bundled ones, interpolation and its limits, files, and reflectances in their three forms."""

from importlib import resources

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlidar.optics.spectra import Spectrum, read_spectrum_csv, reflectance_at, spectrum, spectrum_names

LASERS = np.array([532.0, 1064.0, 1550.0])
WAVELENGTH, REFLECTANCE = np.array([400.0, 500.0, 900.0]), np.array([0.1, 0.3, 0.2])


def test_library():
    kind_of_name = spectrum_names()
    assert len(kind_of_name) >= 36
    assert set(kind_of_name.values()) == {"bark", "wood", "litter", "char", "soil", "built"}
    for name in kind_of_name:
        s = spectrum(name)
        assert s.name == name
        assert s.wavelength.shape == s.reflectance.shape == (180,)
        assert (float(s.wavelength[0]), float(s.wavelength[-1])) == (400.0, 2450.0)
        assert 0.0 <= float(s.reflectance.min()) < float(s.reflectance.max()) < 0.95
    data = resources.files("jaxlidar") / "data"
    assert len((data / "spectra.npz").read_bytes()) < 300_000
    provenance = (data / "spectra.md").read_text()
    for name in kind_of_name:
        assert f"`{name}`" in provenance


def test_bark_and_soil_have_the_brightness_and_colour_of_their_kind():
    # Bark is dark in the green, and brighter in the near infrared.
    for name in spectrum_names("bark"):
        green, infrared = spectrum(name)(LASERS)[:2]
        assert 0.04 < green < 0.4
        assert 1.5 < infrared / green < 10
    # Soils darken by name; red soil reflects little blue light.
    brightness = [float(spectrum(f"soil-{s}")(1064.0)) for s in ("very-dark", "dark", "medium", "bright")]
    assert brightness == sorted(brightness)
    assert float(spectrum("soil-red")(650.0)) > 3 * float(spectrum("soil-red")(450.0))


def test_listing_by_kind():
    assert set(spectrum_names("soil").values()) == {"soil"}
    assert "bark-birch" in spectrum_names("bark")
    with pytest.raises(ValueError, match="kind = 'water' is none of 'bark'"):
        spectrum_names("water")


@pytest.mark.parametrize(
    ("wrong", "close"),
    [
        ("bark-brich", "bark-birch"),
        ("oak", "bark-oak"),
        ("soil_medium", "soil-medium"),
        ("zzz", "jaxlidar.spectrum_names"),
    ],
)
def test_unknown_name(wrong, close):
    with pytest.raises(ValueError, match=f"name = '{wrong}'.*{close}"):
        spectrum(wrong)


def test_interpolation(precision):
    s = Spectrum(WAVELENGTH, REFLECTANCE, "mine")
    np.testing.assert_allclose(s(np.array([400.0, 450.0, 500.0, 600.0, 900.0])), [0.1, 0.2, 0.3, 0.275, 0.2])
    assert s(450.0).shape == ()
    assert s(np.full((2, 3), 450.0)).shape == (2, 3)
    assert s(450.0).dtype == precision
    for outside in (399.9, 900.5, np.nan):
        with pytest.raises(ValueError, match=r"wavelength of the spectrum 'mine' = .* \[400, 900\]"):
            s(outside)
    assert float(jax.jit(lambda w: s(w))(1000.0)) == pytest.approx(0.2)


def test_derivatives(precision):
    s = Spectrum(WAVELENGTH, REFLECTANCE, "mine", scale=0.5)
    gradient = eqx.filter_grad(lambda s: jnp.sum(s(jnp.array([450.0, 700.0]))))(s)
    np.testing.assert_allclose(gradient.scale, 0.2 + 0.25, rtol=1e-6)
    np.testing.assert_allclose(gradient.reflectance, [0.25, 0.5, 0.25], rtol=1e-6)
    np.testing.assert_allclose(jax.grad(s)(450.0), 0.5 * 0.002, rtol=1e-5)
    brighter = eqx.tree_at(lambda s: s.scale, s, jnp.asarray(1.0))
    np.testing.assert_allclose(brighter(450.0), 0.2, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([400.0, 500.0], [0.1, 1.2]), r"reflectance = 1\.2 .*\[0, 1\]"),
        (([400.0, 500.0], [-0.1, 0.2]), r"reflectance = -0\.1"),
        (([400.0, 500.0], [np.nan, 0.2]), "reflectance = nan"),
        (([400.0, 400.0], [0.1, 0.2]), "wavelength = 400 is followed by 400"),
        (([0.0, 400.0], [0.1, 0.2]), r"wavelength = 0 .*\(0, inf\)"),
        (([400.0], [0.1]), "1 samples"),
        (([400.0, 500.0], [0.1, 0.2], "", 6.0), r"scale \* reflectance = 1\.2"),
        (([400.0, 500.0], [0.1, 0.2], "", -1.0), "scale = -1"),
    ],
)
def test_inadmissible(arguments, message):
    arrays = [np.array(a) for a in arguments[:2]]
    with pytest.raises(ValueError, match=message):
        Spectrum(*arrays, *arguments[2:])


def test_reflectance_at():
    np.testing.assert_allclose(reflectance_at(0.4, LASERS), [0.4] * 3)
    np.testing.assert_allclose(reflectance_at(np.array([0.1, 0.2, 0.3]), LASERS), [0.1, 0.2, 0.3])
    sand = spectrum("sand")
    np.testing.assert_allclose(reflectance_at(sand, LASERS), sand(LASERS))
    assert reflectance_at(0.4, 1064.0).shape == (1,)
    with pytest.raises(ValueError, match=r"bark has shape \(2,\).*3 wavelengths"):
        reflectance_at(np.array([0.1, 0.2]), LASERS, "bark")
    with pytest.raises(ValueError, match=r"'sand' = 300 .*\[400, 2450\]"):
        reflectance_at(sand, np.array([300.0, 500.0]))


@pytest.mark.parametrize(
    "text",
    [
        "wavelength,reflectance\n400,0.1\n500,0.2\n",
        "# my soil\n\n400;0.1\n500;0.2",
        "nm\trho\n400\t0.1\n500\t0.2\n",
        "\ufeffwavelength (nm) reflectance\n  400   0.1\n# in between\n5e2 0.2\n",
    ],
)
def test_csv(tmp_path, text):
    path = tmp_path / "soil.csv"
    path.write_text(text, encoding="utf-8")
    s = read_spectrum_csv(path)
    assert s.name == "soil"
    np.testing.assert_allclose(s.wavelength, [400, 500])
    np.testing.assert_allclose(s.reflectance, [0.1, 0.2])
    assert read_spectrum_csv(path, "other").name == "other"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("400,0.1\n500,abc\n", "line 2: '500,abc'"),
        ("400,0.1\n\n500\n", "line 3: '500'"),
        ("400,0.1,7\n500,0.1,7\n", "line 1: '400,0.1,7'"),
        ("a,b\nc,d\n400,0.1\n", "line 2: 'c,d'"),
        ("400,10\n500,20\n", r"line 1: reflectance = 10 .*\[0, 1\]"),
        ("400,nan\n500,0.2\n", "line 1: reflectance = nan"),
        ("0.4,0.1\n0.5,0.2\n", r"line 1: wavelength = 0\.4 .*\[100, inf\) nm"),
        ("400,0.1\n390,0.2\n", "line 2: wavelength = 390 follows 400"),
        ("400,0.1\n", "line 1: the file ends after 1 samples"),
        ("", "ends after 0 samples"),
        ("4x0,0.1\n500,0.2\n600,0.3\n", "line 1: '4x0,0.1'"),
        ("400,0.1\n1e39,0.2\n", r"line 2: wavelength = 1e\+39 .*\[100, inf\) nm of single precision"),
        ("400,0.1\n400.00001,0.2\n", "line 2: wavelength = 400 follows 400"),
        ('400,0.1\n500,"0.2\n', "line 2: '500,\"0.2'"),
        ("400,0.1\n" + "5" * 200_000 + ",0.2\n", "line 2: '5{40}' is not"),
        ("400,0.1\n500,0.2\x0c600,0.3\n", "line 2: '500,0.2"),
    ],
)
def test_damaged_csv(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"bad\.csv, " + ("" if text else ".*") + message):
        read_spectrum_csv(path)


def test_no_text(tmp_path):
    path = tmp_path / "image.csv"
    path.write_bytes(b"400,0.1\n\xff\xd8\xff\xe0")
    with pytest.raises(ValueError, match=r"image\.csv: no text file: line 2 is not UTF-8"):
        read_spectrum_csv(path)
    with pytest.raises(FileNotFoundError, match=r"none\.csv"):
        read_spectrum_csv(tmp_path / "none.csv")


def test_the_derivative_at_a_sample_is_that_of_central_differences():
    """Values at samples are those of the table; one-sided slopes would be 0.002 and -0.00025."""
    own = Spectrum(WAVELENGTH, REFLECTANCE)
    np.testing.assert_array_equal(own(500.0), own.reflectance[1])
    np.testing.assert_allclose(own(WAVELENGTH), own.reflectance, rtol=2e-7)
    slope = jax.grad(lambda wavelength: own(wavelength))
    difference = (own(510.0) - own(490.0)) / 20.0
    np.testing.assert_allclose(slope(500.0), difference, rtol=1e-4)
    np.testing.assert_allclose(slope(500.0), 0.5 * (0.2 / 100.0 - 0.1 / 400.0), rtol=1e-5)
    np.testing.assert_allclose([slope(499.0), slope(501.0)], [0.2 / 100.0, -0.1 / 400.0], rtol=1e-4)
