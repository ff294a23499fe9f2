"""Results as netCDF and Zarr: exact round trips, units, cases that can be run again, damage, old files."""

import dataclasses
import json
import pickle
import sys
from importlib import metadata

import equinox as eqx
import jax
import numpy as np
import pytest
from jaxtyping import Float

import inversion
import jaxlidar as jl
from jaxlidar._fields.checks import required_for
from jaxlidar.results import datasets, groups
from tests.results.test_store import flip_a_bit

h5py = pytest.importorskip("h5py")


@pytest.fixture(scope="module")
def case():
    scene = jl.Scene(ground=jl.Ground(slope=5.0), plates=(jl.Plate(2.0, 0.3, 0.2, 0.5),))
    lidar = jl.Lidar(wavelength=(532.0, 1064.0))
    return jl.io.Case(lidar, scene, jax.random.key(3), {"n_photons": 8192, "max_orders": 3})


@pytest.fixture(scope="module")
def wave(case):
    return case.simulate()


@pytest.fixture(scope="module")
def fit(wave, case):
    rng = np.random.default_rng(0)
    values = {"ground height": np.float32(0.1), "scene/leaf": rng.random(3), "a.b": rng.random((2, 2))}
    values = {name: jax.numpy.asarray(v) for name, v in values.items()}
    n = 8
    return inversion.Retrieval(
        values=values,
        stderr={name: v + np.inf for name, v in values.items()},
        robust_stderr={name: v + np.inf for name, v in values.items()},
        prior_share=values,
        at_bound={name: v > 0.5 for name, v in values.items()},
        simulation_error=values,
        covariance=jax.numpy.asarray(rng.random((n, n))),
        scene=case.scene,
        waveform=wave,
        residuals=wave.reflectance,
        fitted=wave.reflectance,
        reduced_chi2=jax.numpy.asarray(1.1),
        second_minimum=jax.numpy.asarray(np.inf),
        independent_samples=jax.numpy.asarray(12.5),
        averaging=jax.numpy.asarray(rng.random((n, n))),
        strength={"scene/leaf": jax.numpy.asarray(0.7)},
        bounds={name: np.stack([v, v + 1.0]) for name, v in values.items()},
        converged=True,
        status="converged: it ended at a minimum",
        steps=7,
        history=(3.0, 1.0 / 3.0, np.inf),
        labels=tuple(f"label {i}" for i in range(n)),
    )


@pytest.fixture(scope="module")
def fits():
    rng = np.random.default_rng(1)
    return inversion.Retrieval(
        values={"Cab": rng.random(5), "layers": rng.random((5, 3))},
        stderr={"Cab": rng.random(5), "layers": rng.random((5, 3))},
        robust_stderr={"Cab": rng.random(5), "layers": rng.random((5, 3))},
        prior_share={"Cab": rng.random(5), "layers": rng.random((5, 3))},
        at_bound={"Cab": rng.random(5) > 0.5, "layers": rng.random((5, 3)) > 0.5},
        covariance=rng.random((5, 4, 4)),
        reduced_chi2=rng.random(5),
        second_minimum=rng.random(5),
        independent_samples=rng.random(5),
        averaging=rng.random((5, 4, 4)),
        strength={"layers": rng.random(5)},
        bounds={"Cab": rng.random(2), "layers": rng.random((2, 3))},
        converged=np.array([True, False, True, True, False]),
        steps=np.arange(5),
        simulation_error={"Cab": rng.random(5), "layers": rng.random((5, 3))},
        residuals=rng.random((5, 2, 7)),
        fitted=rng.random((5, 2, 7)),
        status=("done", "ü", "", "failed: no photon", "done"),
        labels=("Cab", "layers[0]", "layers[1]", "layers[2]"),
    )


def same(result, expected):
    """True if two results are equal bit for bit, in their types, names and static fields too."""
    pairs = list(zip(jax.tree.leaves(result), jax.tree.leaves(expected)))
    same_classes = all(isinstance(a, np.ndarray) == isinstance(b, np.ndarray) for a, b in pairs)
    same_bits = all(
        np.asarray(a).dtype == np.asarray(b).dtype and np.asarray(a).tobytes() == np.asarray(b).tobytes()
        for a, b in pairs
    )
    return jax.tree.structure(result) == jax.tree.structure(expected) and same_classes and same_bits


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
@pytest.mark.parametrize("name", ["wave", "fit", "fits"])
def test_results_are_read_as_they_were_written(name, suffix, request, tmp_path):
    result, path = request.getfixturevalue(name), tmp_path / f"a{suffix}"
    jl.io.save(result, path)
    assert same(jl.open(path), result)
    changed = eqx.tree_at(lambda r: jax.tree.leaves(r)[0], result, replace_fn=lambda x: x + 1)
    assert not same(jl.open(path), changed)


def test_double_precision_is_kept_when_jax_reads_in_single_precision(wave, tmp_path):
    with jax.enable_x64(True):
        double = jax.tree.map(lambda x: np.asarray(x, np.float64) / 3, wave)
        double = jax.tree.map(jax.numpy.asarray, double)
        double.save(tmp_path / "a.nc")
    assert same(jl.open(tmp_path / "a.nc"), double)


def test_results_have_a_method_that_saves_them(wave, fit, fits, tmp_path):
    fits.save(tmp_path / "fits.nc")
    assert same(jl.open(tmp_path / "fits.nc"), fits)
    wave.save(tmp_path / "wave.nc")
    fit.save(tmp_path / "fit.nc")
    assert same(jl.open(tmp_path / "wave.nc"), wave)
    assert same(jl.open(tmp_path / "fit.nc").scene, fit.scene)


def test_a_saved_run_is_repeated_bit_for_bit(wave, case, tmp_path):
    path = tmp_path / "a.nc"
    wave.save(path, case)
    repeated = jl.rerun(path)
    # `info` has the elapsed time, which differs.
    assert jax.tree.all(jax.tree.map(np.array_equal, repeated, with_info(wave, repeated.info)))
    other_key = jl.io.Case(case.lidar, case.scene, jax.random.key(4), case.arguments).simulate()
    assert not np.array_equal(other_key.reflectance, wave.reflectance)
    assert repeated.info["photons"] == wave.info["photons"] > 0
    stored_case = jl.io.read_case(path)
    assert same((stored_case.lidar, stored_case.scene), (case.lidar, case.scene))


def with_info(wave, info):
    """Return a waveform with its `info` replaced."""
    return type(wave)(**{**vars(wave), "info": info})


def test_runs_that_cannot_be_repeated_are_refused(wave, case, tmp_path):
    path = tmp_path / "a.nc"
    wave.save(path)
    with pytest.raises(ValueError, match=r"a.nc: /case: no such attribute: it was saved without its case"):
        jl.rerun(path)
    with_info(wave, {**wave.info, "stopped": "interrupted"}).save(path, case)
    with pytest.raises(ValueError, match=r"a.nc: the run ended early \(interrupted\)"):
        jl.rerun(path)
    wave.save(path, case)
    with jax.enable_x64(True), pytest.raises(ValueError, match="simulated in float32; JAX is configured for"):
        jl.rerun(path)
    with pytest.raises(ValueError, match=r"case has a lidar of .* not the case that it was simulated from"):
        wave.save(path, jl.io.Case(jl.Lidar()))


def test_xarray_reads_coordinates_and_units(wave, case, tmp_path):
    xarray = pytest.importorskip("xarray")
    wave.save(tmp_path / "a.nc", case)
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf", decode_timedelta=False) as data:
        assert set(data.coords) == {"time", "wavelength", "component", "fate", "height"}
        assert data.reflectance.dims == ("wavelength", "time")
        assert data.time.attrs["units"] == "ns"
        assert data.attrs["Conventions"] == "CF-1.11"
        assert "[scene.ground]" in data.attrs["case"]
        assert set(json.loads(data.attrs["versions"])) == {"jaxlidar", "jax", "jaxlib", "numpy"}
        ground = data.components.sel(component="ground", wavelength=532.0)
        assert np.array_equal(ground, wave.components["ground"][0])
        assert all({"units", "long_name"} <= set(v.attrs) for v in data.data_vars.values())


def test_every_quantity_of_a_registered_class_has_units():
    for layout in datasets.LAYOUTS.values():
        if layout.kind.__module__.startswith(("jaxlidar", "inversion")):
            names = {f.name for f in dataclasses.fields(layout.kind) if not f.metadata.get("static")}
            assert names - {"scene", "waveform", "truth", "acquisition"} == set(layout.quantities)


def test_damaged_values_are_refused_with_the_name_of_their_variable(wave, tmp_path):
    path = tmp_path / "a.nc"
    wave.save(path)
    content, recorded = path.read_bytes(), np.asarray(wave.recorded).tobytes()
    assert content.count(recorded) >= 1
    offset = content.rindex(recorded) + 5
    path.write_bytes(content[:offset] + bytes([content[offset] ^ 1]) + content[offset + 1 :])
    # Without noise, `energy` has the same bytes as `recorded`.
    with pytest.raises(ValueError, match=r"a.nc: /(recorded|energy): damaged"):
        jl.open(path)


def test_missing_foreign_and_incomplete_files_are_refused(wave, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        jl.open(tmp_path / "none.nc")
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["x"] = 1.0
    with pytest.raises(ValueError, match=r"a.nc: no attribute jaxlidar_kind"):
        jl.open(tmp_path / "a.nc")
    wave.save(tmp_path / "a.nc")
    with h5py.File(tmp_path / "a.nc", "r+") as file:
        file.attrs["jaxlidar_format"] = 9
    with pytest.raises(ValueError, match=r"jaxlidar_format = 9; admissible is 2: jaxlidar .* wrote the file"):
        jl.open(tmp_path / "a.nc")
    wave.save(tmp_path / "a.nc")
    with h5py.File(tmp_path / "a.nc", "r+") as file:
        del file["lost"]
    with pytest.raises(ValueError, match=r"a.nc: /lost: no such variable"):
        jl.open(tmp_path / "a.nc")


class Heights(eqx.Module):
    top: Float[np.ndarray, " trees"]


def test_a_class_of_another_package_is_loaded_by_its_entry_point(tmp_path, monkeypatch):
    with pytest.raises(TypeError, match="result is of the class Heights; admissible are"):
        jl.io.save(Heights(np.ones(2)), tmp_path / "a.nc")
    # When the test ends, monkeypatch removes the class from the registry.
    monkeypatch.setitem(datasets.LAYOUTS, "Heights", None)
    jl.io.keep_as_netcdf(Heights, "heights", {"top": ("m", "height")})
    jl.io.save(Heights(np.array([1.0, 2.0])), tmp_path / "a.nc")
    layout = datasets.LAYOUTS.pop("Heights")
    with pytest.raises(ValueError, match=r"a.nc: it holds a Heights, which is not known here"):
        jl.open(tmp_path / "a.nc")

    class HeightsEntryPoint:
        name = "Heights"

        def load(self):
            datasets.LAYOUTS["Heights"] = layout

    entry_points = {datasets.ENTRY_POINTS: [HeightsEntryPoint()]}
    monkeypatch.setattr(metadata, "entry_points", lambda group: entry_points.get(group, []))
    assert jl.open(tmp_path / "a.nc").top.tolist() == [1.0, 2.0]


@pytest.mark.parametrize(("package", "suffix"), [("h5netcdf", ".nc"), ("zarr", ".zarr")])
def test_missing_packages_are_named_with_the_extra_to_install(wave, tmp_path, monkeypatch, package, suffix):
    # Python raises an ImportError for such an entry.
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf'needs {package}: pip install "jaxlidar\[io\]"'):
        wave.save(tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_the_error_of_a_package_that_cannot_be_loaded_passes():
    with pytest.raises(ImportError, match=r"^cannot import name 'nothing'"), required_for("reading"):
        from math import nothing  # pyright: ignore[reportAttributeAccessIssue]  # noqa: F401


def test_a_failed_write_leaves_the_old_file(wave, tmp_path):
    path = tmp_path / "a.nc"
    wave.save(path)
    with pytest.raises(TypeError, match="a set is nothing that a file can hold"):
        with_info(wave, {"seeds": {1, 2}}).save(path)
    assert same(jl.open(path), wave)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("size", [0, 7, 100, 20_000, -1])
def test_files_that_were_cut_are_refused_by_name(wave, tmp_path, size):
    path = tmp_path / "a.nc"
    wave.save(path)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ValueError, match=r"a.nc: "):
        jl.open(path)


# -- Zarr --------------------------------------------------------------------------------------------------


def test_zarr_stores_have_the_case_and_are_opened_by_xarray(wave, case, tmp_path):
    wave.save(path := tmp_path / "flat.zarr", case)
    assert jl.open(path).info == wave.info
    assert np.array_equal(jl.rerun(path).reflectance, wave.reflectance)
    xarray = pytest.importorskip("xarray")
    # xarray would warn of a store without consolidated metadata.
    data = xarray.open_zarr(path, decode_timedelta=False, chunks=None)
    assert data.reflectance.dims == ("wavelength", "time")
    assert data.energy.attrs["units"] == "J"


def test_damaged_zarr_stores_are_refused_by_array(wave, tmp_path):
    wave.save(path := tmp_path / "a.zarr")
    flip_a_bit(chunk := path / "energy" / "c" / "0" / "0")
    with pytest.raises(ValueError, match=r"a.zarr: /energy: damaged"):
        jl.open(path)
    chunk.unlink()
    with pytest.raises(ValueError, match=r"a.zarr: /energy: damaged \(1 chunks are missing\)"):
        jl.open(path)
    (path / "energy" / "zarr.json").write_text("{")
    with pytest.raises(ValueError, match=r"a.zarr: .*damaged"):
        jl.open(path)
    (path / "zarr.json").unlink()
    with pytest.raises(ValueError, match=r"a.zarr: no Zarr store of version 3: it has no zarr.json"):
        jl.open(path)
    with pytest.raises(FileNotFoundError, match=r"b.zarr: no such folder"):
        jl.open(tmp_path / "b.zarr")


def test_a_folder_that_is_no_zarr_store_is_not_overwritten(wave, tmp_path):
    (folder := tmp_path / "a.zarr").mkdir()
    (folder / "thesis.txt").write_text("years of work")
    with pytest.raises(ValueError, match=r"a.zarr: it is there already and no Zarr store; nothing is over"):
        wave.save(folder)
    assert (folder / "thesis.txt").exists()


def test_paths_that_are_no_files_are_named_as_they_were_given(wave, tmp_path, monkeypatch):
    """Planted: the paths of drafts, which the user did not give."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "some_folder").mkdir()
    with pytest.raises(OSError, match=r"no name of a file: ''$"):
        wave.save("")
    with pytest.raises(IsADirectoryError, match=r"a folder, not a file: 'some_folder'$"):
        wave.save("some_folder")
    assert [path.name for path in tmp_path.iterdir()] == ["some_folder"]


class ShotEnergies(eqx.Module):
    """A result whose fields `energy` and `by_material` have a row for every shot."""

    energy: Float[np.ndarray, "shots bins"]
    by_material: dict[str, Float[np.ndarray, "shots bins"]]


def test_rows_of_zarr_stores_are_read_where_they_are_used(tmp_path, monkeypatch):
    monkeypatch.setitem(datasets.LAYOUTS, "ShotEnergies", None)
    monkeypatch.setattr(ShotEnergies, "__init__", lambda self, **fields: vars(self).update(fields))
    quantities = {"energy": ("J", "energy"), "by_material": ("J", "energy by material")}
    jl.io.keep_as_netcdf(
        ShotEnergies, "shot energies", quantities, dimensions={"shots": "shot"}, rows="shots"
    )
    energy = np.random.default_rng(0).normal(size=(1000, 250)).astype(np.float32)
    jl.io.save(
        ShotEnergies(energy=energy, by_material={"leaf": 2 * energy, "ground": -energy}),
        path := tmp_path / "a.zarr",
    )
    assert isinstance(jl.open(path).energy, np.ndarray)
    monkeypatch.setattr(groups, "_BYTES_READ_AT_ONCE", 1000)
    result = jl.open(path)
    assert isinstance(result.energy, groups.StoredArray)
    reads, oindex = [], type(result.energy._array.oindex).__getitem__
    monkeypatch.setattr(
        type(result.energy._array.oindex),
        "__getitem__",
        lambda self, i: (reads.append(i), oindex(self, i))[1],
    )
    for array, expected in ((result.energy, energy), (result.by_material["ground"], -energy)):
        assert (array.shape, array.ndim, array.dtype, len(array)) == ((1000, 250), 2, np.float32, 1000)
        mask = np.arange(1000) % 7 == 3
        for index in (3, -1, slice(5, 9), slice(None, None, -300), [4, 2, 4], mask, (3, 5), (slice(2, 5), 7)):
            reads.clear()
            np.testing.assert_array_equal(array[index], expected[index])
            assert len(reads) == 1
            rows = reads[0][-1]
            assert len(range(*rows.indices(1000)) if isinstance(rows, slice) else rows) < 150
        # What is no index of rows is NumPy's.
        for index in (..., (..., 0), None, (slice(None), slice(3))):
            np.testing.assert_array_equal(array[index], expected[index])
        np.testing.assert_array_equal(array.sum(axis=1), expected.sum(axis=1))
        np.testing.assert_array_equal(
            np.sqrt(2.0 * array**2) > 0.1 - array, np.sqrt(2.0 * expected**2) > 0.1 - expected
        )
        np.testing.assert_array_equal(jax.numpy.asarray(array), expected)
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(array))[3], expected[3])
        with pytest.raises(IndexError):
            array[1000]
        with pytest.raises(AttributeError):
            array.no_such_method()
    for chunk in (path / "energy" / "c").rglob("*"):
        if chunk.is_file():
            flip_a_bit(chunk)
    with pytest.raises(ValueError, match=r"a\.zarr: /energy: damaged"):
        result.energy[3]
