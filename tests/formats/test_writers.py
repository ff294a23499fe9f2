"""Writers keep links, permissions, devices and pipes; those of one path do not disturb one another."""

import contextlib
import errno
import functools
import os
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import jax
import numpy as np
import pytest

import inversion.demo
import jaxlidar as jl
from jaxlidar import cli
from jaxlidar.cli.shared import new_axes, save_figure
from jaxlidar.formats import files
from jaxlidar.io import FileWarning, atomic_write, read_las, write_las
from tests.formats.test_las_waveforms import small_shots

pytestmark = pytest.mark.skipif(os.name != "posix", reason="links, pipes and modes of POSIX")

GRID = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(20, 10), spacing=10.0)
VOXELS = jl.VoxelMap.from_extinction(leaf=np.ones((2, 2, 2)), voxel_size=1.0, origin=(0.0, 0.0, 0.0))
CASE = jl.io.Case(scene=jl.Scene(canopy=jl.Canopy(VOXELS, leaf=jl.Prospect(), hotspot=False)))
SHOTS = small_shots()


@functools.cache
def wave():
    return jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))


def save(path):
    wave().save(path)


def write_spectrum(path):
    assert cli.main(["prospect", "-o", str(path)]) == 0


def write_table(path):
    source = path.with_name("source.nc")
    save(source)
    assert cli.main(["convert", str(source), str(path)]) == 0


WRITERS = {
    "wave.nc": save,
    "wave.zarr": save,
    "case.toml": lambda path: jl.io.write_case(path, CASE),
    "points.las": lambda path: jl.io.write_las(path, np.zeros((2, 3))),
    "waveforms.las": lambda path: jl.io.write_las_waveforms(path, SHOTS),
    "map.tif": lambda path: jl.io.write_raster(path, {"RH98": np.arange(6.0)}, GRID.position),
    "gedi.h5": lambda path: jl.io.write_gedi_l1b(
        path, [wave()], jl.Survey.of(jl.Lidar()), origin=(14.42, 50.08), elevation=300.0
    ),
    "leaf.csv": write_spectrum,
    "wave.csv": write_table,
    "plot.png": lambda path: save_figure(new_axes(1.0, 1.0), path),
    "demo.png": lambda path: inversion.demo.save(new_axes(1.0, 1.0).get_figure(), path),
}
# Those of one file.
FILES = sorted(WRITERS.keys() - {"wave.zarr", "case.toml", "waveforms.las"})


@pytest.fixture(autouse=True)
def umask():
    """Make the umask that of most systems, and no cache of compiled programs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxlidar.cli.group.compilation_cache", contextlib.nullcontext)
        previous = os.umask(0o022)
        yield
        os.umask(previous)


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_the_table_has_every_writer():
    writers = {"write_case", "write_gedi_l1b", "write_las", "write_las_waveforms", "write_raster"}
    assert {name for name in jl.io.__all__ if name.startswith("write_")} == writers


@pytest.mark.parametrize("name", WRITERS)
def test_links_and_modes_stay(name, tmp_path):
    target, link = tmp_path / "store" / "content", tmp_path / name
    target.parent.mkdir()
    link.symlink_to(target)
    # To a missing file first, which the first call makes.
    WRITERS[name](link)
    assert link.is_symlink()
    assert target.exists()
    assert mode(target) == (0o755 if target.is_dir() else 0o644)
    changed = [target, *target.rglob("*")]
    for path in changed:
        path.chmod(0o775 if path.is_dir() else 0o664)
    before = target.stat().st_ino
    WRITERS[name](link)
    assert link.is_symlink()
    assert target.stat().st_ino != before
    for path in changed:
        assert mode(path) == (0o775 if path.is_dir() else 0o664)
    assert [path.name for path in target.parent.iterdir()] == ["content"]
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def write_to_pipe(write, pipe):
    os.mkfifo(pipe)
    contents = []
    reader = threading.Thread(target=lambda: contents.append(pipe.read_bytes()), daemon=True)
    reader.start()
    write(pipe)
    reader.join()
    assert stat.S_ISFIFO(pipe.lstat().st_mode)
    return contents[0]


@pytest.mark.parametrize("name", FILES)
def test_a_pipe_gets_the_complete_content(name, tmp_path):
    content = write_to_pipe(WRITERS[name], tmp_path / name)
    copy = tmp_path / f"copy-{name}"
    WRITERS[name](copy)
    assert abs(len(content) - copy.stat().st_size) < 0.02 * len(content)
    assert content[:4] == copy.read_bytes()[:4]


@pytest.mark.parametrize("name", FILES)
def test_a_full_device_is_an_error_and_stays_a_device(name, tmp_path):
    path = tmp_path / name
    path.symlink_to("/dev/full")
    if name in ("leaf.csv", "wave.csv"):
        with pytest.raises(AssertionError):
            WRITERS[name](path)
    else:
        with pytest.raises(OSError, match="No space left on device"):
            WRITERS[name](path)
    assert stat.S_ISCHR(Path("/dev/full").lstat().st_mode)


def test_folders_are_not_copied_to_devices_and_pipes(tmp_path):
    path = tmp_path / "wave.zarr"
    path.symlink_to("/dev/null")
    with pytest.raises(ValueError, match="it is there already and no Zarr store"):
        save(path)
    with pytest.raises(IsADirectoryError), atomic_write(path) as draft:
        draft.mkdir()


def test_standard_output_takes_a_file(tmp_path, capfd):
    os.symlink("/dev/stdout", tmp_path / "leaf.csv")
    write_spectrum(tmp_path / "leaf.csv")
    out = capfd.readouterr().out
    assert "wavelength_nm,reflectance,transmittance\n400," in out
    assert "\n2500," in out


def test_what_no_content_can_be_written_to_is_refused_before_the_block(tmp_path, monkeypatch):
    socket_path, protected = tmp_path / "socket", tmp_path / "protected"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(socket_path))
        with pytest.raises(OSError, match="no file, folder, pipe or character device"):
            atomic_write(socket_path).__enter__()
    protected.write_text("old")
    # Root may write to all files.
    monkeypatch.setattr(os, "access", lambda path, access: Path(path) != protected)
    with pytest.raises(PermissionError, match="write-protected"):
        atomic_write(protected).__enter__()
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(OSError, match="symbolic link") as caught:
        atomic_write(loop).__enter__()
    assert caught.value.errno == errno.ELOOP


def test_the_longest_name(tmp_path):
    path = tmp_path / ("n" * 252 + ".nc")
    save(path)
    assert np.array_equal(jl.open(path).reflectance, wave().reflectance)


def test_a_draft_is_private_and_an_error_leaves_all_as_it_was(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("old")
    path.chmod(0o600)

    def fail():
        with atomic_write(path) as draft:
            draft.write_text("new")
            assert mode(draft.parent) == 0o700
            assert draft.name == path.name
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_old_folder_is_put_back_when_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    path = tmp_path / "wave.zarr"
    save(path)
    rename, calls = Path.rename, []

    def failing(source, target):
        calls.append(source)
        # The second rename of the new folder, after the old one was moved aside.
        if len(calls) == 3:
            raise OSError(errno.EIO, "input/output error")
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OSError, match="input/output error"):
        save(path)
    assert len(calls) == 4
    assert np.array_equal(jl.open(path).reflectance, wave().reflectance)
    assert list(tmp_path.iterdir()) == [path]


# -- several writers ---------------------------------------------------------------------------------------


def threads_write(write, path, count=4):
    """Write one path from several threads at a time; return their errors."""
    errors, barrier = [], threading.Barrier(count)

    def run():
        try:
            barrier.wait()
            write(path)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return errors


@pytest.mark.parametrize("name", ["wave.nc", "wave.zarr"])
def test_threads_that_save_to_one_path_all_end_well(name, tmp_path):
    for _ in range(3):
        assert threads_write(save, tmp_path / name) == []
        assert np.array_equal(jl.open(tmp_path / name).reflectance, wave().reflectance)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_files_that_belong_together_are_of_one_writer(tmp_path):
    path, sizes = tmp_path / "case.toml", iter(range(1, 100))
    lock = threading.Lock()

    def write(path):
        with lock:
            size = next(sizes)
        voxels = jl.VoxelMap.from_extinction(leaf=np.full((2, 2, size), 0.1 * size), voxel_size=1.0)
        canopy = jl.Canopy(voxels, leaf=jl.Isotropic(albedo=size / 100), hotspot=False)
        jl.io.write_case(path, jl.io.Case(scene=jl.Scene(canopy=canopy)))

    for _ in range(5):
        assert threads_write(write, path) == []
        canopy = jl.io.read_case(path).scene.canopy
        assert float(canopy.leaf.albedo) == pytest.approx(canopy.voxels.shape[2] / 100)


# The module alone: importing the package takes seconds.
REPLACE_FOLDERS = """
import runpy, sys
from pathlib import Path
module, store = sys.argv[1:]
atomic_write = runpy.run_path(module)["atomic_write"]
input()
for _ in range(200):
    with atomic_write(store) as draft:
        draft.mkdir()
        (draft / "content").write_text("complete")
"""


def test_processes_that_replace_one_folder_all_end_well(tmp_path):
    arguments = [sys.executable, "-c", REPLACE_FOLDERS, files.__file__, str(tmp_path / "store")]
    processes = [subprocess.Popen(arguments, stdin=subprocess.PIPE, text=True) for _ in range(3)]
    for process in processes:
        process.stdin.write("start\n")
        process.stdin.flush()
    for process in processes:
        process.communicate()
    assert [process.returncode for process in processes] == [0, 0, 0]
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
    assert (tmp_path / "store" / "content").read_text() == "complete"


def test_intensities_that_all_round_to_zero_are_no_secret(tmp_path):
    """Amplitudes in J, as of waveforms that were simulated."""
    position, amplitude = np.zeros((2, 3)), np.array([4.8e-12, 1e-12])
    with pytest.warns(FileWarning, match=r"intensity is at most 4\.8e-12, and 0 when it is rounded"):
        write_las(tmp_path / "joule.las", position, intensity=amplitude)
    write_las(tmp_path / "counts.las", position, intensity=1e14 * amplitude)
    np.testing.assert_array_equal(read_las(tmp_path / "counts.las").intensity, [480, 100])
