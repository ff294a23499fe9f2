"""Reader of NEON waveforms: a small file that is written here, damaged files, and a recorded sample."""

import io
import zipfile

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import read_neon

STEP = np.array([0.01, 0.02, -0.1482])
COLUMNS = ["index", "x", "y", "z", "dx", "dy", "dz", "or", "fr", *(f"V{i}" for i in range(9, 17))]


def _pulse(samples, centre, height):
    """Return a Gaussian echo on a pedestal of 200 counts."""
    return 200 + height * np.exp(-0.5 * ((np.arange(samples) - centre) / 5) ** 2)


def _arrays():
    """Return the arrays of a file of three shots, of 60, 70 and 50 samples, the second with a gap.

    The echo of shot i lies at sample 30 + i.
    """
    ret, outgoing = np.zeros((3, 80)), np.zeros((3, 64))
    geo = np.zeros((3, len(COLUMNS)))
    for i, count in enumerate((60, 70, 50)):
        ret[i, :count] = _pulse(count, 30 + i, 300)
        outgoing[i, :55] = _pulse(55, 22, 500)
        bin0 = np.array([7e5 + i, 4e6, 300.0])
        first = bin0 + STEP * (30 + i)
        geo[i] = [i + 1, *first, *STEP, 22 - 5.9, 30 + i - 5.9, *bin0, *STEP, 22, 0]
    ret[1, 55:60] = 0
    impulse, impulse_outgoing = np.zeros(64), np.zeros(64)
    impulse[:60], impulse_outgoing[:60] = _pulse(60, 25, 900), _pulse(60, 20, 400)
    return {
        "ret": ret,
        "outgoing": outgoing,
        "system_impulse": impulse,
        "impulse_outgoing": impulse_outgoing,
        "geo": geo,
        "geo_cols": np.array(COLUMNS),
    }


def write_small(path, **arrays):
    """Write the small file, with some arrays replaced, and return its path."""
    np.savez_compressed(path, **{**_arrays(), **arrays})
    return path


@pytest.fixture(scope="module")
def recorded():
    """What the reader returns for the recorded sample."""
    from tests.conftest import SHARED

    path = SHARED / "neon" / "neon_harvard_250.npz"
    if not path.is_file():
        pytest.skip("NEON's recorded sample is not beside this checkout")
    return read_neon(path)


def test_fields_of_shots_and_of_the_system_impulse(tmp_path):
    shots, impulse, dropped = read_neon(write_small(tmp_path / "small.npz"))
    assert dropped == {"without a return": 0, "without a pulse": 0}
    assert [(s.index, s.waveform.size) for s in shots] == [(1, 60), (2, 70), (3, 50)]
    shot = shots[1]
    np.testing.assert_array_equal(np.flatnonzero(~shot.recorded), np.arange(55, 60))
    assert shot.noise_mean == pytest.approx(200, abs=0.1)
    assert shot.noise_std < 0.1
    assert shot.signal[31] == pytest.approx(300, abs=0.1)
    np.testing.assert_array_equal(shot.signal[55:60], 0)
    np.testing.assert_allclose(shot.position[10], np.array([7e5 + 1, 4e6, 300]) + 10 * STEP, rtol=1e-12)
    np.testing.assert_allclose(shot.elevation, 300 - 0.1482 * np.arange(70))
    assert shot.zenith == pytest.approx(np.rad2deg(np.arctan2(np.hypot(0.01, 0.02), 0.1482)))
    assert shot.azimuth == pytest.approx(np.rad2deg(np.arctan2(0.01, 0.02)))
    pulse = jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)
    assert float(pulse.mean) == pytest.approx(0, abs=0.02)
    assert float(pulse.std) == pytest.approx(5, rel=0.01)
    assert impulse.time[impulse.power.argmax()] == impulse.pulse_time[impulse.pulse_power.argmax()] == 0
    assert impulse.power.max() == pytest.approx(900, abs=0.1)


def test_times_and_positions_refer_to_the_reference_elevation(tmp_path):
    """Time zero is where the beam meets this elevation, which may lie between two samples."""
    shot = read_neon(write_small(tmp_path / "small.npz")).shots[0]
    reference = 300 - 20.5 * 0.1482
    np.testing.assert_allclose(shot.time_from(reference), np.arange(60) - 20.5, atol=1e-9)
    np.testing.assert_allclose(shot.position_at(reference), [7e5 + 0.205, 4e6 + 0.41], rtol=1e-12)


def test_a_simulated_echo_returns_at_the_elevation_of_the_ground(tmp_path):
    """The time axis of a shot agrees with that of a simulation with the shot's pulse and angles."""
    shot = read_neon(write_small(tmp_path / "small.npz")).shots[0]
    lidar = jl.Lidar(
        pulse=jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power),
        zenith=shot.zenith,
        azimuth=shot.azimuth,
        divergence=0.0,
    )
    wave = jl.simulate(
        lidar, jl.Scene(ground=jl.Ground(reflectance=0.3, height=1.5)), max_orders=1, key=jax.random.key(0)
    )
    time = shot.time_from(295.0)
    echo = np.interp(time, np.asarray(wave.time), np.asarray(wave.reflectance[0]))
    # Light in air is slower by 3e-4, and the echo lies half a sample at most from its sample.
    assert shot.elevation[echo.argmax()] == pytest.approx(296.5, abs=0.08)


def test_shots_without_a_return_or_a_pulse_are_dropped_and_counted(tmp_path):
    arrays = _arrays()
    arrays["ret"][0, 3:] = 0
    arrays["outgoing"][2] = 0
    shots, _, dropped = read_neon(write_small(tmp_path / "a.npz", **arrays))
    assert [s.index for s in shots] == [2]
    assert dropped == {"without a return": 1, "without a pulse": 1}
    with pytest.raises(ValueError, match=r"b\.npz: ret, outgoing: no shot"):
        read_neon(write_small(tmp_path / "b.npz", ret=np.zeros((3, 80))))
    with pytest.raises(ValueError, match=r"c\.npz: ret, outgoing: no shot"):
        read_neon(
            write_small(
                tmp_path / "c.npz", ret=np.zeros((0, 80)), outgoing=np.zeros((0, 64)), geo=np.zeros((0, 17))
            )
        )


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.npz"):
        read_neon(tmp_path / "none.npz")
    text = tmp_path / "text.npz"
    text.write_text("no archive")
    with pytest.raises(ValueError, match=r"text\.npz: no \.npz file"):
        read_neon(text)
    with zipfile.ZipFile(tmp_path / "foreign.npz", "w") as archive:
        archive.writestr("readme.txt", "no array")
    with pytest.raises(ValueError, match=r"foreign\.npz"):
        read_neon(tmp_path / "foreign.npz")
    pickled = io.BytesIO()
    np.savez(pickled, ret=np.array([{}], dtype=object))
    (tmp_path / "objects.npz").write_bytes(pickled.getvalue())
    with pytest.raises(ValueError, match=r"objects\.npz: ret: damaged"):
        read_neon(tmp_path / "objects.npz")


def test_damaged_bytes_raise_no_error_but_one_that_names_the_file(tmp_path):
    """At random places, in the first local header and in the end of the archive's directory."""
    content = write_small(tmp_path / "small.npz").read_bytes()
    size, damaged = len(content), tmp_path / "damaged.npz"
    rng, n_refusals = np.random.default_rng(0), 0
    for offset in [*rng.integers(0, size, 60), *range(0, 40), *range(size - 60, size)]:
        changed = bytearray(content)
        changed[offset] ^= 0x5A
        damaged.write_bytes(changed)
        try:
            read_neon(damaged)
        except ValueError as error:
            assert "damaged.npz" in str(error)  # noqa: PT017
            n_refusals += 1
    # Some bytes are padding, or repeat what the archive's directory has, and are never read.
    assert n_refusals > 50
    for truncated_size in (0, 10, size // 2, size - 1):
        damaged.write_bytes(content[:truncated_size])
        with pytest.raises(ValueError, match=r"damaged\.npz"):
            read_neon(damaged)


def _set_element(index, value):
    """Return a function that changes one element of an array."""

    def change(array):
        array = array.copy()
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        *((key, None, f"{key}: no such array; there are ") for key in _arrays()),
        *((key, lambda a: a[..., None], f"{key}: shape .* dimensions belong") for key in _arrays()),
        ("ret", _set_element((1, 5), np.nan), r"ret: element \(1, 5\) is nan"),
        ("ret", _set_element((1, 5), -1.0), r"ret: element \(1, 5\) is -1"),
        ("ret", lambda a: a.astype(str), "ret: type <U.* where numbers belong"),
        ("outgoing", _set_element((0, 0), np.inf), r"outgoing: element \(0, 0\) is inf"),
        ("outgoing", lambda a: a[:2], "outgoing: 2 shots, but ret has 3"),
        ("system_impulse", _set_element(3, np.nan), r"system_impulse: element \(3,\) is nan"),
        ("impulse_outgoing", lambda a: 0 * a, "impulse_outgoing: fewer than 8 samples"),
        ("geo", lambda a: a[:, :-1], r"geo: shape \(3, 16\), but ret and geo_cols have \(3, 17\)"),
        ("geo", _set_element((2, 11), np.nan), r"geo: element \(2, 11\) is nan"),
        ("geo", _set_element((1, 6), 0.1482), "geo: shot 2: dz = 0.1482 m does not lead down"),
        ("geo", _set_element((1, 6), -0.3), "geo: shot 2: dx, dy, dz: 0.3"),
        ("geo", _set_element((2, 15), 64), "geo: shot 3: V15 = 64"),
        ("geo", _set_element((2, 15), -1), "geo: shot 3: V15 = -1"),
        ("geo_cols", _set_element(6, "dw"), "geo_cols: no column dz"),
        ("ret", _set_element((1, 5), 1e10), r"ret: element \(1, 5\) is 1e\+10; counts"),
        ("ret", lambda a: a[:, :0], r"ret: shape \(3, 0\) has no columns"),
        ("system_impulse", lambda a: 0 * a + 200.1, "system_impulse: a pulse without energy.* 200.1 counts"),
        ("geo", _set_element((2, 15), 21.5), "geo: shot 3: V15 = 21.5"),
        ("geo", _set_element((2, 0), 2.5), "geo: row 2: index = 2.5 is no whole number"),
        (
            "geo",
            _set_element((1, 9), 1e12),
            r"geo: shot 2: V9, V10, V11, V16: the return lies beyond 1e\+09 m",
        ),
    ],
)
def test_damaged_arrays_are_refused_by_name(tmp_path, key, change, message):
    arrays = _arrays()
    array = arrays.pop(key)
    if change is not None:
        arrays[key] = change(array)
    np.savez(tmp_path / "small.npz", **arrays)
    with pytest.raises(ValueError, match=r"small\.npz: " + message):
        read_neon(tmp_path / "small.npz")


def _replace_member(path, name, content, compression=zipfile.ZIP_DEFLATED):
    """Write the small file with one member of the archive replaced or added, and return its path."""
    small = write_small(path).read_bytes()
    with zipfile.ZipFile(io.BytesIO(small)) as old, zipfile.ZipFile(path, "w", compression) as new:
        for member in old.namelist():
            new.writestr(member, content if member == name else old.read(member))
        if name not in old.namelist():
            new.writestr(name, content)
    return path


def _npy(header, data=b""):
    """Return the bytes of an .npy file with any header."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + data


@pytest.mark.parametrize(
    ("shape", "dtype", "message"),
    [
        ((10**9,), "<f8", "float64 of shape .* takes 8000000000 bytes; there are 64"),
        ((2**62, 4), "<f8", "takes .* bytes; there are 64"),
        ((9,), "<f8", "takes 72 bytes; there are 64"),
        ((7,), "<f8", "takes 56 bytes; there are 64"),
        ((10**9,), "<U0", "there are 64"),
        ((8,), "|O", "it holds Python objects"),
        ((8,), "no type", "not a valid dtype"),
    ],
)
def test_a_header_that_declares_another_size_is_refused_before_allocation(tmp_path, shape, dtype, message):
    header = repr({"descr": dtype, "fortran_order": False, "shape": shape})
    path = _replace_member(tmp_path / "a.npz", "system_impulse.npy", _npy(header, bytes(64)))
    with pytest.raises(ValueError, match=rf"a\.npz: system_impulse: damaged \(.*{message}"):
        read_neon(path)


def test_an_archive_that_unpacks_to_a_thousand_times_its_size_is_refused(tmp_path):
    zeros = np.zeros((3, 2**21))
    path = _replace_member(tmp_path / "bomb.npz", "ret.npy", _npy("{}") + zeros.tobytes())
    assert path.stat().st_size < 2**17
    with pytest.raises(ValueError, match=r"bomb\.npz: ret: 50331\d+ bytes are declared in a file of"):
        read_neon(path)


def test_unused_arrays_are_not_read(tmp_path):
    path = _replace_member(tmp_path / "notes.npz", "notes.npy", b"no array at all")
    assert len(read_neon(path).shots) == 3


def test_other_compressions_than_that_of_numpy_are_refused(tmp_path):
    path = _replace_member(tmp_path / "lzma.npz", "notes.npy", b"", zipfile.ZIP_LZMA)
    with pytest.raises(ValueError, match=r"lzma\.npz: ret: packed by method 14"):
        read_neon(path)


def test_recorded_shots_are_plausible(recorded):
    shots, _, dropped = recorded
    assert len(shots) == 250
    assert sum(dropped.values()) == 0
    assert [s.index for s in shots] == list(range(1, 251))
    assert {s.pulse_time.size for s in shots} == {100}
    assert sorted(np.count_nonzero(~s.recorded) for s in shots)[-5:] == [0, 8, 8, 12, 20]
    for shot in shots:
        assert 68 <= shot.waveform.size <= 208
        assert 4 < shot.zenith < 9
        assert shot.signal.max() > 20 * shot.noise_std
        assert 300 < shot.elevation[-1] < shot.elevation[0] < 350
        above_half = shot.pulse_time[shot.pulse_power > shot.pulse_power.max() / 2]
        assert 13 <= above_half[-1] - above_half[0] <= 17
    # Pedestal and noise of the samples before the first return.
    assert shots[0].noise_mean == pytest.approx(210, abs=2)
    assert 4 < shots[0].noise_std < 7


def test_first_returns_lie_at_the_elevations_of_the_product(recorded, shared):
    """The product times first returns at half of their maximum.

    This is the time at which the pulse rises to half if it is reflected at the elevation of the return.
    """
    geo = np.load(shared / "neon" / "neon_harvard_250.npz")["geo"]
    errors = []
    for shot, row in zip(recorded.shots, geo):
        peak = shot.pulse_power.max()
        rise = np.argmax(shot.pulse_power > peak / 2)
        before, after = shot.pulse_power[rise - 1 : rise + 1]
        half = shot.pulse_time[rise - 1] + (peak / 2 - before) / (after - before)
        # Columns 3 and 8 of the table: the elevation z and the time fr of the first return.
        expected = -shot.time_from(row[3])[0] + half
        errors.append(expected - row[8])
    assert abs(np.median(errors)) < 0.1
    assert np.quantile(np.abs(errors), 0.95) < 0.3


def test_the_system_impulse_is_its_outgoing_pulse_blurred_by_the_receiver(recorded):
    """A blur of 1.9 ns fits it, with a free shift and amplitude, and other blurs do not."""
    impulse = recorded.impulse
    pulse = jl.SampledPulse(time=impulse.pulse_time, power=impulse.pulse_power)
    power = jax.jit(lambda t, jitter: pulse.power(t, jitter))
    near, fine_time = np.abs(impulse.time) < 30, np.arange(-40.0, 40.0, 0.5)

    def misfit(jitter):
        residuals, blurred = [], np.asarray(power(fine_time, jitter))
        for shift in np.arange(-1.0, 3.0, 0.1):
            shape = np.interp(impulse.time[near] + shift, fine_time, blurred)
            scale = shape @ impulse.power[near] / (shape @ shape)
            residuals.append(np.std(impulse.power[near] - scale * shape) / impulse.power.max())
        return min(residuals)

    assert misfit(1.9) < 0.01
    assert misfit(1.9) < 0.5 * min(misfit(0.5), misfit(4.0))
