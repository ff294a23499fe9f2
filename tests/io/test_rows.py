"""Results of many rows in files: written some at a time, mapped when they are read, with a checksum each."""

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


class Echoes(eqx.Module):
    time: Float[np.ndarray, " bins"]
    energy: Float[np.ndarray, "shots bins"]
    parts: dict[str, Float[np.ndarray, "shots bins"]]
    count: Int[np.ndarray, " shots"]
    info: dict[str, int] = eqx.field(static=True)


@pytest.fixture(autouse=True)
def known(monkeypatch):
    monkeypatch.setitem(datasets.LAYOUTS, "Echoes", None)
    quantities = {"time": ("ns", "time"), "energy": ("J", "energy"), "parts": ("J", "energy by part")}
    quantities |= {"count": ("1", "number of echoes")}
    jl.io.keep_as_netcdf(
        Echoes, "echoes", quantities, dimensions={"bins": "time", "shots": "shot"}, rows="shots"
    )


def echoes(shots=600, bins=7):
    random = np.random.default_rng(0)
    energy = random.normal(size=(shots, bins)).astype(np.float32)
    parts = {"leaf": 0.25 * energy, "ground": 0.75 * energy}
    return Echoes(np.arange(float(bins)), energy, parts, np.arange(shots), {"seed": 0})


def same(a, b):
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(x.dtype == y.dtype and np.array_equal(x, y) for x, y in leaves) and a.info == b.info


def add_all(rows, whole, step):
    """All rows, so many at a time, the last first."""
    for start in reversed(range(0, len(whole.count), step)):
        some = slice(start, min(start + step, len(whole.count)))
        parts = {name: a[some] for name, a in whole.parts.items()}
        rows.add(some, {"energy": whole.energy[some], "parts": parts, "count": whole.count[some]})


def frame(whole):
    """What is known before the rows are."""
    count = len(whole.count)
    energy, parts, number = jax.tree.map(
        lambda a: unwritten_rows(count, a[:1]), (whole.energy, whole.parts, whole.count)
    )
    return Echoes(whole.time, energy, parts, number, whole.info)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_written_some_rows_at_a_time_is_what_is_written_at_once(tmp_path, suffix):
    whole, path = echoes(), tmp_path / f"a{suffix}"
    jl.io.save(whole, path)
    assert same(jl.open(path), whole)
    with netcdf.by_rows(frame(whole), path) as rows:
        add_all(rows, whole, 17)
        assert same(jl.open(path), whole)
    assert same(jl.open(path), whole)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_files_are_mapped_and_not_read(tmp_path):
    shots, bins, step = 40_000, 250, 1000
    block = np.random.default_rng(0).normal(size=(step, bins)).astype(np.float32)
    size = 3 * shots * block[0].nbytes
    shape = Echoes(
        np.arange(float(bins)),
        unwritten_rows(shots, block),
        {name: unwritten_rows(shots, block) for name in ("leaf", "ground")},
        unwritten_rows(shots, np.zeros(1, int)),
        {},
    )
    tracemalloc.start()
    try:
        with netcdf.by_rows(shape, tmp_path / "large.nc") as rows:
            for start in range(0, shots, step):
                some = slice(start, start + step)
                values = {"energy": block, "parts": {"leaf": 2 * block, "ground": -block}}
                rows.add(some, values | {"count": np.arange(start, start + step)})
        large = jl.open(tmp_path / "large.nc")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (tmp_path / "large.nc").stat().st_size > size
    assert peak < 0.1 * size
    assert isinstance(large.energy, np.memmap)
    assert np.array_equal(large.parts["leaf"][-1], 2 * block[-1])


def damage(path):
    """Change a bit of the fourth row of the second part, and say where the row lies."""
    with h5py.File(path) as file:
        place = file["parts"].id.get_offset() + file["parts"][0].nbytes + 3 * file["parts"][0, 0].nbytes
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def test_a_row_that_is_damaged_is_named(tmp_path):
    jl.io.save(echoes(), path := tmp_path / "a.nc")
    damage(path)
    with pytest.raises(ValueError, match=r"a.nc: /: row 3: damaged \(its checksum is another\)"):
        jl.open(path)
    path.write_bytes(path.read_bytes()[:-5000])
    with pytest.raises(ValueError, match=r"a.nc: .*damaged"):
        jl.open(path)


def test_checksums_are_those_of_the_bytes(tmp_path):
    whole = echoes(3)
    jl.io.save(whole, tmp_path / "a.nc")
    each = [whole.energy, *whole.parts.values(), whole.count]
    with h5py.File(tmp_path / "a.nc") as file:
        found = file["row_crc32"][...]
    assert found.tolist() == [zlib.crc32(b"".join(a[i].tobytes() for a in each)) for i in range(3)]


def test_damaged_stores_are_refused_by_name(tmp_path):
    jl.io.save(echoes(), path := tmp_path / "a.zarr")
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


def test_a_folder_that_is_no_store_is_not_overwritten(tmp_path):
    (folder := tmp_path / "a.zarr").mkdir()
    (folder / "thesis.txt").write_text("years of work")
    with pytest.raises(ValueError, match=r"a.zarr: it is there already and no Zarr store; nothing is over"):
        jl.io.save(echoes(), folder)
    assert (folder / "thesis.txt").exists()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_rows_that_are_missing_or_of_another_type_leave_no_file(tmp_path, suffix):
    whole, path = echoes(), tmp_path / f"a{suffix}"
    with (
        pytest.raises(ValueError, match="300 of 600 rows are missing"),
        netcdf.by_rows(frame(whole), path) as r,
    ):
        r.add(slice(0, 300), {n: jax.tree.map(lambda a: a[:300], getattr(whole, n)) for n in r.fields})
    with (
        pytest.raises(TypeError, match="energy has rows of float64"),
        netcdf.by_rows(frame(whole), path) as r,
    ):
        r.add(slice(0, 600), {"energy": whole.energy.astype(float)})
    assert list(tmp_path.iterdir()) == []


def test_a_waveform_as_zarr(tmp_path):
    wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    case = jl.io.Case(jl.Lidar(), jl.Scene(ground=jl.Ground()), jax.random.key(0))
    wave.save(path := tmp_path / "flat.zarr", case)
    found = jl.open(path)
    assert all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(wave), jax.tree.leaves(found), strict=True)
    )
    assert found.info == wave.info
    assert np.array_equal(jl.rerun(path).reflectance, wave.reflectance)
    xarray = pytest.importorskip("xarray")
    # Without a warning: the store has consolidated metadata.
    data = xarray.open_zarr(path, decode_timedelta=False)
    assert data.reflectance.dims == ("wavelength", "time")
    assert data.energy.attrs["units"] == "J"
    assert Path(path).is_dir()


def test_rows_are_compared_in_blocks(tmp_path):
    """Also the last block, which is shorter."""
    jl.io.save(echoes(BLOCK + 5), path := tmp_path / "a.nc")
    with h5py.File(path, "r+") as file:
        file["count"][BLOCK + 4] += 1
    with pytest.raises(ValueError, match=rf"row {BLOCK + 4}: damaged"):
        jl.open(path)
