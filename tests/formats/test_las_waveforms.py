"""LAS with waveform packets: written files are read bit for bit, damaged ones are refused; recorded ones."""

import dataclasses
import struct
import sys

import laspy
import numpy as np
import pytest

from jaxlidar.formats.airborne import Returns
from jaxlidar.io import (
    AirborneShot,
    Segment,
    read_las,
    read_las_waveforms,
    read_pulsewaves,
    write_las,
    write_las_waveforms,
)
from tests.helpers import slow_unless

# A NaN whose bits signal an error: NumPy warns where it is cast.
SIGNALLING_NAN = np.array(0x7F800001, np.uint32).view(np.float32)
# Displacement of light in 1 ns, in m.
DIRECTION = np.array([0.015625, -0.03125, -0.1455])


def returns_at(anchor, *times):
    """Return the points of a shot at some times, with positions in whole mm."""
    time, n = np.array(times), len(times)
    number = np.arange(n)
    position = np.round(anchor + time[:, None] * DIRECTION, 3)
    return Returns(position, time, 100 * number + 7, number + 1, np.full(n, n), 2 + number)


def small_shots():
    """Return four shots: of 8 bits; of 16 bits with a gain; of two segments and three returns; of 32 bits."""
    random = np.random.default_rng(0)
    # For each shot: type, start and number of samples of its segments; times of its points; options.
    shot_parameters = [
        ([(np.uint8, 0.0, 20)], [7.25], {}),
        ([(np.uint16, 0.0, 30)], [4.5, 20.5], {"gain": 0.0125, "offset": -0.5}),
        ([(np.uint8, 0.0, 20), (np.uint8, 95.0, 20)], [3.0, 9.0, 101.0], {}),
        ([(np.uint32, 0.0, 10)], [2.0], {"step": 0.5}),
    ]
    shots = []
    for i, (segments, times, options) in enumerate(shot_parameters):
        anchor = np.array([5e5 + 3 * i, 4e6, 300.0])
        returning = tuple(
            Segment(random.integers(0, np.iinfo(dtype).max, n, dtype), start, **options)
            for dtype, start, n in segments
        )
        fields = {"anchor": anchor, "direction": DIRECTION, "returning": returning}
        shots.append(AirborneShot(i, **fields, gps_time=4e5 + i, returns=returns_at(anchor, *times)))
    return shots


def small_files(folder):
    """Return the bytes of the .las and of the .wdp file of the small shots."""
    write_las_waveforms(folder / "small.las", small_shots())
    return [(folder / f"small.{suffix}").read_bytes() for suffix in ("las", "wdp")]


@pytest.fixture
def small(tmp_path):
    """Path of a .las file of the small shots, with its .wdp file beside it."""
    write_las_waveforms(tmp_path / "small.las", small_shots())
    return tmp_path / "small.las"


@pytest.mark.parametrize("point_format", [4, 9, 10])
def test_compressed_points_give_the_same_shots(tmp_path, point_format):
    pytest.importorskip("lazrs")
    laspy = pytest.importorskip("laspy")
    write_las_waveforms(tmp_path / "plain.las", small_shots(), point_format=point_format)
    laspy.read(tmp_path / "plain.las").write(tmp_path / "packed.laz", do_compress=True)
    packets = tmp_path / "packed.wdp"
    packets.write_bytes((tmp_path / "plain.wdp").read_bytes())
    plain, packed = (read_las_waveforms(tmp_path / name) for name in ("plain.las", "packed.laz"))
    assert_same(packed, list(plain))
    damaged = bytearray((tmp_path / "packed.laz").read_bytes())
    damaged[-20:] = bytes(20)
    (tmp_path / "packed.laz").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"packed\.laz: "):
        read_las_waveforms(tmp_path / "packed.laz")


def assert_same(shots, expected_shots, position_tolerance=1e-9):
    """Assert that samples, digitiser and times are equal bit for bit, and positions to some m.

    The start of a segment follows from positions, along which light needs 1 ns for more than 0.14 m.
    """
    assert len(shots) == len(expected_shots)
    for shot, expected in zip(shots, expected_shots):
        assert shot.gps_time == expected.gps_time
        assert len(shot.returning) == len(expected.returning)
        for a, b in zip(shot.returning, expected.returning):
            assert a.samples.dtype == b.samples.dtype
            np.testing.assert_array_equal(a.samples, b.samples)
            assert (a.step, a.gain, a.offset) == (b.step, b.gain, b.offset)
            np.testing.assert_allclose(a.start, b.start, atol=position_tolerance / 0.14)
        np.testing.assert_allclose(shot.position, expected.position, rtol=0, atol=position_tolerance)
        for name in ("number", "count", "intensity", "classification"):
            np.testing.assert_array_equal(getattr(shot.returns, name), getattr(expected.returns, name))
        returns, expected_returns = shot.returns.position, expected.returns.position
        np.testing.assert_allclose(returns, expected_returns, rtol=0, atol=position_tolerance)


@pytest.mark.parametrize("point_format", [4, 5, 9, 10])
def test_shots_are_read_as_they_were_written(tmp_path, point_format):
    """And the shots that were read make the same files, byte for byte."""
    path, path_of_copy = tmp_path / "a.las", tmp_path / "b.las"
    write_las_waveforms(path, small_shots(), point_format=point_format)
    shots = read_las_waveforms(path)
    # The files hold positions in whole mm.
    assert_same(shots, small_shots(), position_tolerance=2e-3)
    np.testing.assert_array_equal(shots.gps_time, 4e5 + np.arange(4))
    np.testing.assert_array_equal(shots.anchor, [s.anchor for s in shots])
    np.testing.assert_array_equal(shots.direction, [s.direction for s in shots])
    write_las_waveforms(path_of_copy, shots, point_format=point_format)
    assert_same(read_las_waveforms(path_of_copy), shots, position_tolerance=0)
    for suffix in (".las", ".wdp"):
        assert path.with_suffix(suffix).read_bytes() == path_of_copy.with_suffix(suffix).read_bytes()
    assert laspy.read(path).header.global_encoding.waveform_data_packets_external


def two_beams():
    """Two shots at one GPS time, whose packets lie one after another on one line."""
    shot = small_shots()[0]
    later = dataclasses.replace(shot, anchor=shot.anchor + 100.0 * DIRECTION, returns=None, index=1)
    return [dataclasses.replace(shot, returns=None), dataclasses.replace(later, scanner_channel=2)]


@pytest.mark.parametrize("point_format", [9, 10])
def test_two_scanner_channels_at_one_gps_time_are_two_shots(tmp_path, point_format):
    path, again = tmp_path / "a.las", tmp_path / "b.las"
    write_las_waveforms(path, two_beams(), point_format=point_format)
    shots = read_las_waveforms(path)
    assert [shot.scanner_channel for shot in shots] == [0, 2]
    for shot, expected in zip(shots, two_beams(), strict=True):
        np.testing.assert_array_equal(shot.waveform, expected.waveform)
        np.testing.assert_allclose(shot.anchor, expected.anchor, rtol=0, atol=2e-3)
    write_las_waveforms(again, shots, point_format=point_format)
    assert_same(read_las_waveforms(again), shots, position_tolerance=0)
    # In one channel they are segments of one shot.
    write_las_waveforms(path, [dataclasses.replace(s, scanner_channel=1) for s in two_beams()])
    (shot,) = read_las_waveforms(path)
    assert (shot.scanner_channel, len(shot.returning)) == (1, 2)


def test_formats_without_scanner_channels_refuse_them(tmp_path):
    with pytest.raises(ValueError, match=r"scanner_channel = 2 is outside the admissible range \[0, 0\]"):
        write_las_waveforms(tmp_path / "a.las", two_beams(), point_format=4)


def test_names_of_both_files_may_be_in_upper_case(tmp_path):
    write_las_waveforms(tmp_path / "A.LAS", small_shots())
    assert (tmp_path / "A.WDP").exists()
    assert len(read_las_waveforms(tmp_path / "A.LAS")) == 4


def test_segments_without_returns_get_synthetic_points(tmp_path):
    shots_without_returns = [dataclasses.replace(shot, returns=None) for shot in small_shots()]
    write_las_waveforms(tmp_path / "a.las", shots_without_returns)
    shots = read_las_waveforms(tmp_path / "a.las")
    assert [len(s.returns.number) for s in shots] == [1, 1, 2, 1]
    assert np.all(laspy.read(tmp_path / "a.las").synthetic)
    for shot, expected in zip(shots, shots_without_returns):
        np.testing.assert_array_equal(shot.waveform, expected.waveform)
        np.testing.assert_allclose(shot.position, expected.position, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(shots[2].returns.number, [1, 2])


def test_packets_may_lie_in_the_las_file_itself(small):
    """The header names the byte where the packets begin, here after the points."""
    las, wdp = bytearray(small.read_bytes()), small.with_suffix(".wdp").read_bytes()
    struct.pack_into("<H", las, 6, 2)
    struct.pack_into("<Q", las, 227, len(las))
    path = small.with_name("internal.las")
    path.write_bytes(bytes(las) + wdp)
    assert_same(read_las_waveforms(path), read_las_waveforms(small), position_tolerance=0)


@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("first_returns_only", [False, True])
def test_vectors_may_point_along_or_against_the_light(small, is_reversed, first_returns_only):
    """Two points of one packet determine the sign. Where no packet has two, light is assumed to go down."""
    cloud = laspy.read(small)
    selected = cloud.return_number == 1 if first_returns_only else np.full(len(cloud.points), True)
    cloud.points = cloud.points[selected]
    if is_reversed:
        for axis in "xyz":
            cloud[f"{axis}_t"] = -np.asarray(cloud[f"{axis}_t"])
    # The file is mapped: expected values must be copied before it is overwritten.
    expected = read_las_waveforms(small)
    anchor, direction = expected.anchor, expected.direction
    cloud.write(small)
    shots = read_las_waveforms(small)
    np.testing.assert_allclose(shots.anchor, anchor, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(shots.direction, direction)


def test_points_without_a_packet_are_counted_or_refused(small):
    cloud = laspy.read(small)
    index = np.asarray(cloud.wavepacket_index).copy()
    index[0] = 0
    cloud.wavepacket_index = index
    cloud.write(small)
    shots = read_las_waveforms(small)
    assert shots.dropped == {"without a packet": 1}
    assert len(shots) == 3
    cloud.wavepacket_index = 0 * index
    cloud.write(small)
    with pytest.raises(ValueError, match=r"small\.las: record 0: neither this point nor another"):
        read_las_waveforms(small)


def set_field(name, value, row=1):
    """Return a function that changes one field of a point."""

    def change(path):
        cloud = laspy.read(path)
        values = np.asarray(cloud[name]).copy()
        values[row] = value
        cloud[name] = values
        cloud.write(path)

    return change


def set_layout(offset, format, value):
    """Return a function that changes layout 2, which describes the packet of the second shot."""

    def change(path):
        content = bytearray(path.read_bytes())
        start = content.index(struct.pack("<HH", 101, 26)) + 36
        struct.pack_into(format, content, start + offset, value)
        path.write_bytes(content)

    return change


def set_packets(change):
    """Return a function that changes the bytes of the .wdp file."""

    def change_file(path):
        packets = path.with_suffix(".wdp")
        packets.write_bytes(change(packets.read_bytes()))

    return change_file


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_field("wavepacket_index", 77), r"record 1: layout 77: none of \[1, 2, 3\]"),
        (set_field("wavepacket_size", 61), "record 1: its packet has 61 bytes; layout 2 has 60"),
        (set_field("wavepacket_offset", 3), "record 1: its packet of 60 bytes at byte 3 does not lie within"),
        (set_field("wavepacket_offset", 10**6), "record 1: its packet of 60 bytes at byte 1000000 does not"),
        (set_field("wavepacket_offset", 2**64 - 1), "record 1: its packet of 60 bytes at byte 1844"),
        (set_field("return_point_wave_location", np.nan), "record 1: its place in space, its vector or"),
        (set_field("x_t", SIGNALLING_NAN), "record 1: its place in space, its vector or"),
        (set_field("x_t", np.inf), "record 1: its place in space, its vector or"),
        (set_field("z_t", 1.0), "record 1: its place in space, its vector or .*makes no sense"),
        (
            set_packets(lambda b: b[:-1]),
            "record 6: its packet of 40 bytes at byte .* does not lie within the",
        ),
        (
            set_packets(lambda b: b[:50]),
            r"small\.wdp: packets: their record begins at 0, but the file ends after 50",
        ),
        (set_packets(lambda b: b""), r"small\.wdp: packets: .* the file ends after 0 bytes"),
        (set_packets(lambda b: b"PulseWaves" + b[10:]), r"small\.wdp: packets: the record at byte 0 is "),
        (set_layout(0, "<B", 12), "record 1: layout 2: 30 samples of 12 bits every 1000 ps"),
        (set_layout(1, "<B", 1), r"record 1: layout 2: packets are compressed \(1\): they are not read"),
        (set_layout(2, "<I", 0), "record 1: layout 2: 0 samples of 16 bits"),
        (set_layout(6, "<I", 0), "record 1: layout 2: 30 samples of 16 bits every 0 ps"),
        (set_layout(10, "<d", np.nan), "record 1: layout 2: gain nan, offset -0.5"),
        (set_layout(18, "<d", np.inf), "record 1: layout 2: gain 0.0125, offset inf"),
    ],
)
def test_damaged_files_are_refused_with_the_place_of_the_fault(small, change, message):
    change(small)
    with pytest.raises(ValueError, match=message):
        list(read_las_waveforms(small))


def test_files_without_packets_are_refused(small, tmp_path):
    packets = small.with_suffix(".wdp")
    packets.rename(tmp_path / "other.wdp")
    with pytest.raises(FileNotFoundError, match=r"small\.wdp: no such file"):
        read_las_waveforms(small)
    write_las(tmp_path / "points.las", np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"points\.las: header: point format 6 has no packets"):
        read_las_waveforms(tmp_path / "points.las")


def test_shots_that_the_format_cannot_hold_are_refused(tmp_path):
    shot = small_shots()[0]

    def assert_refused(message, *shots, **options):
        with pytest.raises(ValueError, match=message):
            write_las_waveforms(tmp_path / "a.las", shots, **options)
        assert not list(tmp_path.iterdir())

    def with_segments(*segments, **changes):
        return dataclasses.replace(shot, returning=segments, returns=None, **changes)

    segment = shot.returning[0]
    assert_refused("shots: there is none")
    assert_refused(r"point_format = 6 has no packets; those of \(4, 5, 9, 10\)", shot, point_format=6)
    assert_refused("shot 0: samples every 0.3333", with_segments(segment._replace(step=1 / 3)))
    assert_refused("shot 0: a sample is 0.5", with_segments(segment._replace(samples=np.array([0.5]))))
    assert_refused("shot 0: a sample is -3", with_segments(segment._replace(samples=np.array([4, -3]))))
    two_channels = segment._replace(channel=1, start=500.0), segment
    assert_refused(r"shot 0: segments of the channels \[0, 1\]", with_segments(*two_channels))
    # The two packets of a shot are recognised by their GPS time.
    two_segments = segment, segment._replace(start=500.0)
    assert_refused("shot 0: 2 segments without a GPS time", with_segments(*two_segments, gps_time=None))
    assert_refused("degrees and metres", shot, dataclasses.replace(shot, metres=np.array([9e4, 1e5, 1.0])))
    # Every number of samples needs a layout of its own.
    lengths = (with_segments(segment._replace(samples=np.zeros(n + 1, np.uint8))) for n in range(256))
    assert_refused("shot 0: one layout of packets more than 255", *lengths)
    ninth_return = dataclasses.replace(shot, returns=shot.returns._replace(number=np.array([9])))
    assert_refused(
        r"return_number = 9 is outside the admissible range \[0, 7\]", ninth_return, point_format=4
    )
    with pytest.raises(ValueError, match=r"path = .*a\.laz: its name does not end in \.las"):
        write_las_waveforms(tmp_path / "a.laz", [shot])


def test_a_failed_write_leaves_the_old_files(small):
    before = [small.with_suffix(s).read_bytes() for s in (".las", ".wdp")]

    def shots():
        yield small_shots()[0]
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="gone"):
        write_las_waveforms(small, shots())
    assert [small.with_suffix(s).read_bytes() for s in (".las", ".wdp")] == before
    assert len(list(small.parent.iterdir())) == 2


def test_missing_laspy_names_the_extra_to_install(small, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    for call in (
        lambda: read_las_waveforms(small),
        lambda: write_las(small, np.zeros((1, 3))),
        lambda: write_las_waveforms(small, small_shots()),
    ):
        with pytest.raises(ImportError, match=r"jaxlidar\[io\]"):
            call()


def test_points_without_waveforms_are_read_as_they_were_written(tmp_path):
    random = np.random.default_rng(1)
    position = np.round(np.array([5e5, 4e6, 200.0]) + random.uniform(-50, 50, (40, 3)), 3)
    fields = {
        "intensity": random.integers(0, 65536, 40),
        "return_number": random.integers(1, 16, 40),
        "number_of_returns": np.full(40, 15),
        "gps_time": 4e5 + random.uniform(size=40),
        "classification": random.choice([0, 2, 5], 40),
    }
    path = tmp_path / "points.las"
    write_las(path, position, **fields)
    cloud = read_las(path)
    np.testing.assert_allclose(cloud.position, position, rtol=0, atol=1e-9)
    for name in ("intensity", "return_number", "number_of_returns", "classification"):
        np.testing.assert_array_equal(getattr(cloud, name), fields[name])
    np.testing.assert_array_equal(np.asarray(laspy.read(path).gps_time), fields["gps_time"])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"position": np.zeros((0, 3))}, "position holds no point"),
        ({"position": np.zeros((2, 2))}, r"position has shape \(2, 2\)"),
        ({"position": np.full((2, 3), np.nan)}, "position = nan is outside"),
        ({"position": np.array([[0.0, 0, 0], [0, 0, 1e8]])}, r"position spans .*; admissible is 2\^31 steps"),
        (
            {"intensity": np.array([0, 70_000])},
            r"intensity = 70000 is outside the admissible range \[0, 65535\]",
        ),
        ({"return_number": np.array([1, 16])}, r"return_number = 16 is outside"),
        ({"return_number": np.array([1, 1.5])}, "return_number has values that are not whole"),
        ({"gps_time": np.array([0, np.nan])}, "gps_time = nan is outside"),
        ({"classification": np.array([-1, 0])}, "classification = -1 is outside"),
        ({"classification": np.array([0])}, r"classification has shape \(1,\)"),
    ],
)
def test_points_that_the_format_cannot_hold_are_refused(tmp_path, fields, message):
    with pytest.raises(ValueError, match=message):
        write_las(tmp_path / "a.las", **({"position": np.zeros((2, 3))} | fields))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("interval", slow_unless([8], [8, 1]))
def test_recorded_packets_agree_with_the_same_pulses_as_pulsewaves(shared, interval):
    """The samples are equal, and the anchor and direction of either file lead to the points."""
    shots = read_las_waveforms(shared / "airborne" / "riegl.las")
    pulses = read_pulsewaves(shared / "airborne" / "riegl.pls")
    assert len(shots) == len(pulses) == 2368
    by_time = {round(1e6 * time): i for i, time in enumerate(pulses.gps_time)}
    assert sorted(by_time) == [round(1e6 * time) for time in shots.gps_time]
    # Distances of the points from the beams, by the geometry of the LAS file and by that of PulseWaves.
    n_segments, n_points, las_distances, pulsewaves_distances = 0, 0, [], []
    for shot in shots[::interval]:
        pulse = pulses[by_time[round(1e6 * shot.gps_time)]].of_channel(1)
        starts = []
        for segment in shot.returning:
            # A LAS file has only packets with points: three pulses have segments without any.
            matches = [s for s in pulse.returning if np.array_equal(s.samples, segment.samples)]
            assert len(matches) == 1
            starts.append(matches[0].start)
            n_segments += 1
        shift = starts[0] - shot.returning[0].start
        np.testing.assert_allclose(starts, [s.start + shift for s in shot.returning], rtol=0, atol=0.02)
        times = shot.returns.time[:, None]
        las_distances.append(shot.anchor + times * shot.direction - shot.returns.position)
        pulsewaves_distances.append(pulse.anchor + (shift + times) * shot.direction - shot.returns.position)
        np.testing.assert_allclose(shot.direction, pulse.direction, rtol=0, atol=2e-6)
        n_points += shot.returns.number.size
    if interval == 1:
        assert (n_segments, n_points) == (2375, 2535)
    # Positions of points and anchors are rounded to mm.
    assert np.abs(np.concatenate(las_distances)).max() < 1.9e-3
    assert np.abs(np.concatenate(pulsewaves_distances)).max() < 1.7e-3
    assert np.quantile(np.abs(np.concatenate(pulsewaves_distances)), 0.98) < 1.4e-3


def test_recorded_shots_are_read_as_they_were_written(shared, tmp_path):
    shots = read_las_waveforms(shared / "airborne" / "riegl.las")[::10]
    write_las_waveforms(tmp_path / "a.las", shots)
    assert_same(read_las_waveforms(tmp_path / "a.las"), shots)
    lvis = read_pulsewaves(shared / "airborne" / "lvis_example2.pls")[::50]
    write_las_waveforms(tmp_path / "b.las", lvis)
    for shot, expected in zip(read_las_waveforms(tmp_path / "b.las"), lvis, strict=True):
        np.testing.assert_array_equal(shot.waveform, expected.waveform)
        assert np.abs((shot.position - expected.position) * expected.metres).max() < 2e-3
