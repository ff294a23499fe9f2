"""Results as netCDF: exact round trips, units, cases that can be run again, damage, and old files."""

import builtins
import dataclasses
import json
from importlib import metadata

import equinox as eqx
import jax
import numpy as np
import pytest
from jaxtyping import Float

import inversion
import jaxlidar as jl
from jaxlidar.io import datasets
from tests.helpers import slow_unless

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
        correlation=jax.numpy.eye(n),
        scene=case.scene,
        waveform=wave,
        residuals=wave.reflectance,
        reduced_chi2=jax.numpy.asarray(1.1),
        second_minimum=jax.numpy.asarray(np.inf),
        independent_samples=jax.numpy.asarray(12.5),
        averaging=jax.numpy.asarray(rng.random((n, n))),
        strength={"scene/leaf": jax.numpy.asarray(0.7)},
        bounds={name: jax.numpy.stack([v, v + 1.0]) for name, v in values.items()},
        converged=True,
        status="converged: it ended at a minimum",
        steps=7,
        history=(3.0, 1.0 / 3.0, np.inf),
        labels=tuple(f"label {i}" for i in range(n)),
    )


@pytest.fixture(scope="module")
def fits():
    rng = np.random.default_rng(1)
    return inversion.Retrievals(
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


@pytest.mark.parametrize("name", ["wave", "fit", "fits"])
def test_results_are_read_as_they_were_written(name, request, tmp_path):
    result = request.getfixturevalue(name)
    jl.io.save(result, tmp_path / "a.nc")
    assert same(jl.open(tmp_path / "a.nc"), result)
    changed = eqx.tree_at(lambda r: jax.tree.leaves(r)[0], result, replace_fn=lambda x: x + 1)
    assert not same(jl.open(tmp_path / "a.nc"), changed)


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


@pytest.mark.parametrize("name", slow_unless(["wave"], ["wave", "fits"]))
def test_damaged_files_are_refused_by_name(name, request, tmp_path):
    """A file with one changed byte is refused, unless the result is unchanged."""
    result, path = request.getfixturevalue(name), tmp_path / "a.nc"
    jl.io.save(result, path)
    content, n_refusals = path.read_bytes(), 0
    rng = np.random.default_rng(5)
    for offset in rng.integers(0, len(content), 60):
        byte = bytes([content[offset] ^ rng.integers(1, 256)])
        path.write_bytes(content[:offset] + byte + content[offset + 1 :])
        try:
            result_of_damaged_file = jl.open(path)
        except ValueError as error:
            assert str(error).startswith(str(path))  # noqa: PT017
            n_refusals += 1
        else:
            assert same(result_of_damaged_file, result), offset
    assert n_refusals > 5
    for size in (0, 7, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        with pytest.raises(ValueError, match=r"a.nc: "):
            jl.open(path)


@pytest.mark.parametrize("at", [0, 24])
def test_a_damaged_heap_of_names_is_refused(wave, tmp_path, at):
    """HDF5 would stay for ever at an object of number 0 and size 0: the first, or one behind it."""
    path = tmp_path / "a.nc"
    jl.io.save(wave, path)
    content = bytearray(path.read_bytes())
    start = content.index(b"GCOL") + 16 + at
    content[start : start + 48] = bytes(48)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.nc: damaged \(the heap at byte"):
        jl.open(path)


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


def test_missing_h5netcdf_names_the_extra_to_install(wave, tmp_path, monkeypatch):
    original_import = builtins.__import__

    def import_without_h5netcdf(name, *args, **kwargs):
        if name == "h5netcdf":
            raise ImportError(name)
        return original_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", import_without_h5netcdf)
    with pytest.raises(ImportError, match=r"pip install 'jaxlidar\[io\]'"):
        wave.save(tmp_path / "a.nc")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_file(wave, tmp_path):
    path = tmp_path / "a.nc"
    wave.save(path)
    with pytest.raises(TypeError, match="a set is nothing that a file can hold"):
        with_info(wave, {"seeds": {1, 2}}).save(path)
    assert same(jl.open(path), wave)
    assert list(tmp_path.iterdir()) == [path]


def test_damaged_text_is_refused(wave, tmp_path):
    path = tmp_path / "a.nc"
    wave.save(path)
    with h5py.File(path, "r+") as file:
        file["component"][0] = "fist"
    with pytest.raises(ValueError, match=r"a.nc: /: damaged \(the checksum of its texts is another\)"):
        jl.open(path)
