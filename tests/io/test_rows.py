"""Results of many rows in files: written in chunks, mapped when they are read, each with a checksum."""

import tracemalloc
import zlib
from pathlib import Path

import equinox as eqx
import h5py
import jax
import numpy as np
import pytest
from jaxtyping import Float, Int

import jaxlidar as jl
from jaxlidar.io import datasets, netcdf
from jaxlidar.io.rows import BLOCK, unwritten_rows

SUFFIXES = [".nc", ".zarr"]


class ShotEnergies(eqx.Module):
    """A result of which the fields `energy`, `energy_by_material` and `count` have a row for every shot."""

    time: Float[np.ndarray, " bins"]
    energy: Float[np.ndarray, "shots bins"]
    energy_by_material: dict[str, Float[np.ndarray, "shots bins"]]
    count: Int[np.ndarray, " shots"]
    info: dict[str, int] = eqx.field(static=True)


@pytest.fixture(autouse=True)
def register_class(monkeypatch):
    """Register the class of this module as a result; monkeypatch removes it when a test ends."""
    monkeypatch.setitem(datasets.LAYOUTS, "ShotEnergies", None)
    quantities = {"time": ("ns", "time"), "energy": ("J", "energy"), "count": ("1", "number of echoes")}
    quantities |= {"energy_by_material": ("J", "energy by material")}
    dimensions = {"bins": "time", "shots": "shot"}
    jl.io.keep_as_netcdf(ShotEnergies, "shot energies", quantities, dimensions=dimensions, rows="shots")


def random_result(shots=600, bins=7):
    """Return a result of random values."""
    random = np.random.default_rng(0)
    energy = random.normal(size=(shots, bins)).astype(np.float32)
    by_material = {"leaf": 0.25 * energy, "ground": 0.75 * energy}
    return ShotEnergies(np.arange(float(bins)), energy, by_material, np.arange(shots), {"seed": 0})


def same(a, b):
    """True if two results are equal."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(x.dtype == y.dtype and np.array_equal(x, y) for x, y in leaves) and a.info == b.info


def row_values(result, rows):
    """Return the values of some rows, by field."""
    by_material = {name: energy[rows] for name, energy in result.energy_by_material.items()}
    return {"energy": result.energy[rows], "energy_by_material": by_material, "count": result.count[rows]}


def without_rows(result):
    """Return a result of the same size with rows that are written later."""
    n_rows = len(result.count)
    energy, by_material, count = jax.tree.map(
        lambda a: unwritten_rows(n_rows, a[:1]), (result.energy, result.energy_by_material, result.count)
    )
    return ShotEnergies(result.time, energy, by_material, count, result.info)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_rows_that_are_written_in_chunks_equal_those_written_at_once(tmp_path, suffix):
    result, path = random_result(), tmp_path / f"a{suffix}"
    jl.io.save(result, path)
    assert same(jl.open(path), result)
    with netcdf.by_rows(without_rows(result), path) as writer:
        # In any order, here the last chunk first.
        for start in reversed(range(0, len(result.count), 17)):
            rows = slice(start, min(start + 17, len(result.count)))
            writer.add(rows, row_values(result, rows))
        # The old file is in place until the new one is complete.
        assert same(jl.open(path), result)
    assert same(jl.open(path), result)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_large_files_are_mapped_and_not_read_into_memory(tmp_path):
    shots, bins, step = 40_000, 250, 1000
    block = np.random.default_rng(0).normal(size=(step, bins)).astype(np.float32)
    size = 3 * shots * block[0].nbytes
    large = ShotEnergies(
        np.arange(float(bins)),
        unwritten_rows(shots, block),
        {name: unwritten_rows(shots, block) for name in ("leaf", "ground")},
        unwritten_rows(shots, np.zeros(1, int)),
        {},
    )
    tracemalloc.start()
    try:
        with netcdf.by_rows(large, tmp_path / "large.nc") as writer:
            for start in range(0, shots, step):
                values = {"energy": block, "energy_by_material": {"leaf": 2 * block, "ground": -block}}
                rows = slice(start, start + step)
                writer.add(rows, values | {"count": np.arange(start, start + step)})
        result = jl.open(tmp_path / "large.nc")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (tmp_path / "large.nc").stat().st_size > size
    assert peak < 0.1 * size
    assert isinstance(result.energy, np.memmap)
    assert np.array_equal(result.energy_by_material["leaf"][-1], 2 * block[-1])


def test_a_damaged_row_is_refused_by_number(tmp_path):
    jl.io.save(random_result(), path := tmp_path / "a.nc")
    with h5py.File(path) as file:
        # Row 3 of the second material.
        energies = file["energy_by_material"]
        offset = energies.id.get_offset() + energies[0].nbytes + 3 * energies[0, 0].nbytes
    data = bytearray(path.read_bytes())
    data[offset] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a.nc: /: row 3: damaged \(its checksum is another\)"):
        jl.open(path)
    path.write_bytes(path.read_bytes()[:-5000])
    with pytest.raises(ValueError, match=r"a.nc: .*damaged"):
        jl.open(path)


def test_the_checksum_of_a_row_is_that_of_the_bytes_of_its_arrays(tmp_path):
    result = random_result(3)
    jl.io.save(result, tmp_path / "a.nc")
    arrays = [result.energy, *result.energy_by_material.values(), result.count]
    with h5py.File(tmp_path / "a.nc") as file:
        checksums = file["row_crc32"][...]
    assert checksums.tolist() == [zlib.crc32(b"".join(a[i].tobytes() for a in arrays)) for i in range(3)]


def test_damaged_zarr_stores_are_refused_by_array(tmp_path):
    jl.io.save(random_result(), path := tmp_path / "a.zarr")
    chunk = path / "energy" / "c" / "1" / "0"
    data = bytearray(chunk.read_bytes())
    data[5] ^= 1
    chunk.write_bytes(data)
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


def test_a_folder_that_is_no_zarr_store_is_not_overwritten(tmp_path):
    (folder := tmp_path / "a.zarr").mkdir()
    (folder / "thesis.txt").write_text("years of work")
    with pytest.raises(ValueError, match=r"a.zarr: it is there already and no Zarr store; nothing is over"):
        jl.io.save(random_result(), folder)
    assert (folder / "thesis.txt").exists()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_missing_rows_and_rows_of_another_type_leave_no_file(tmp_path, suffix):
    result, path = random_result(), tmp_path / f"a{suffix}"
    with (
        pytest.raises(ValueError, match="300 of 600 rows are missing"),
        netcdf.by_rows(without_rows(result), path) as writer,
    ):
        writer.add(slice(0, 300), row_values(result, slice(0, 300)))
    with (
        pytest.raises(TypeError, match="energy has rows of float64"),
        netcdf.by_rows(without_rows(result), path) as writer,
    ):
        writer.add(slice(0, 600), {"energy": result.energy.astype(float)})
    assert list(tmp_path.iterdir()) == []


def test_a_waveform_is_read_from_zarr_as_it_was_written(tmp_path):
    wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    case = jl.io.Case(jl.Lidar(), jl.Scene(ground=jl.Ground()), jax.random.key(0))
    wave.save(path := tmp_path / "flat.zarr", case)
    result = jl.open(path)
    assert all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(wave), jax.tree.leaves(result), strict=True)
    )
    assert result.info == wave.info
    assert np.array_equal(jl.rerun(path).reflectance, wave.reflectance)
    xarray = pytest.importorskip("xarray")
    # xarray would warn of a store without consolidated metadata.
    data = xarray.open_zarr(path, decode_timedelta=False)
    assert data.reflectance.dims == ("wavelength", "time")
    assert data.energy.attrs["units"] == "J"
    assert Path(path).is_dir()


def test_damage_in_the_last_shorter_block_of_rows_is_detected(tmp_path):
    """Checksums are computed in blocks of rows."""
    jl.io.save(random_result(BLOCK + 5), path := tmp_path / "a.nc")
    with h5py.File(path, "r+") as file:
        file["count"][BLOCK + 4] += 1
    with pytest.raises(ValueError, match=rf"row {BLOCK + 4}: damaged"):
        jl.open(path)
