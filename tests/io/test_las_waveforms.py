"""LAS with waveform packets: what is written is read to the bit, damaged files, and recorded ones."""

import dataclasses
import struct
import sys

import laspy
import numpy as np
import pytest

from jaxlidar.io import (
    AirborneShot,
    Returns,
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
WAY = np.array([0.015625, -0.03125, -0.1455])


def returns_at(anchor, *times):
    time, n = np.array(times), len(times)
    number = np.arange(n)
    place = np.round(anchor + time[:, None] * WAY, 3)
    return Returns(place, time, 100 * number + 7, number + 1, np.full(n, n), 2 + number)


def small_shots():
    """One of 8 bits; one of 16 with a gain; one of two segments and three returns; one of 32 bits."""
    random = np.random.default_rng(0)
    kinds = [
        ([(np.uint8, 0.0, 20)], [7.25], {}),
        ([(np.uint16, 0.0, 30)], [4.5, 20.5], {"gain": 0.0125, "offset": -0.5}),
        ([(np.uint8, 0.0, 20), (np.uint8, 95.0, 20)], [3.0, 9.0, 101.0], {}),
        ([(np.uint32, 0.0, 10)], [2.0], {"step": 0.5}),
    ]
    shots = []
    for i, (segments, times, how) in enumerate(kinds):
        anchor = np.array([5e5 + 3 * i, 4e6, 300.0])
        returning = tuple(
            Segment(random.integers(0, np.iinfo(kind).max, n, kind), start, **how)
            for kind, start, n in segments
        )
        own = {"anchor": anchor, "direction": WAY, "returning": returning}
        shots.append(AirborneShot(i, **own, gps_time=4e5 + i, returns=returns_at(anchor, *times)))
    return shots


def small_files(folder):
    """The small shots as bytes of a .las and a .wdp file."""
    write_las_waveforms(folder / "small.las", small_shots())
    return [(folder / f"small.{kind}").read_bytes() for kind in ("las", "wdp")]


@pytest.fixture
def small(tmp_path):
    write_las_waveforms(tmp_path / "small.las", small_shots())
    return tmp_path / "small.las"


def assert_same(found, expected, places=1e-9):
    """Samples, digitiser and times to the bit, places to so many m."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected):
        assert one.gps_time == other.gps_time
        assert len(one.returning) == len(other.returning)
        for a, b in zip(one.returning, other.returning):
            assert a.samples.dtype == b.samples.dtype
            np.testing.assert_array_equal(a.samples, b.samples)
            assert (a.step, a.gain, a.offset) == (b.step, b.gain, b.offset)
            np.testing.assert_allclose(a.start, b.start, atol=places / 0.14)
        np.testing.assert_allclose(one.position, other.position, rtol=0, atol=places)
        for name in ("number", "count", "intensity", "classification"):
            np.testing.assert_array_equal(getattr(one.returns, name), getattr(other.returns, name))
        np.testing.assert_allclose(one.returns.position, other.returns.position, rtol=0, atol=places)


@pytest.mark.parametrize("point_format", [4, 5, 9, 10])
def test_what_is_written_is_read(tmp_path, point_format):
    path, again = tmp_path / "a.las", tmp_path / "b.las"
    write_las_waveforms(path, small_shots(), point_format=point_format)
    shots = read_las_waveforms(path)
    # Points are kept to mm.
    assert_same(shots, small_shots(), places=2e-3)
    np.testing.assert_array_equal(shots.gps_time, 4e5 + np.arange(4))
    np.testing.assert_array_equal(shots.anchor, [s.anchor for s in shots])
    np.testing.assert_array_equal(shots.direction, [s.direction for s in shots])
    write_las_waveforms(again, shots, point_format=point_format)
    assert_same(read_las_waveforms(again), shots, places=0)
    for suffix in (".las", ".wdp"):
        assert path.with_suffix(suffix).read_bytes() == again.with_suffix(suffix).read_bytes()
    assert laspy.read(path).header.global_encoding.waveform_data_packets_external


def two_beams():
    """Two shots at one GPS time, whose packets lie one after another on one line."""
    shot = small_shots()[0]
    later = dataclasses.replace(shot, anchor=shot.anchor + 100.0 * WAY, returns=None, index=1)
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
    assert_same(read_las_waveforms(again), shots, places=0)
    # In one channel they are segments of one shot.
    write_las_waveforms(path, [dataclasses.replace(s, scanner_channel=1) for s in two_beams()])
    (shot,) = read_las_waveforms(path)
    assert (shot.scanner_channel, len(shot.returning)) == (1, 2)


def test_formats_without_scanner_channels_refuse_them(tmp_path):
    with pytest.raises(ValueError, match=r"scanner_channel = 2 is outside the admissible range \[0, 0\]"):
        write_las_waveforms(tmp_path / "a.las", two_beams(), point_format=4)


def test_upper_case(tmp_path):
    write_las_waveforms(tmp_path / "A.LAS", small_shots())
    assert (tmp_path / "A.WDP").exists()
    assert len(read_las_waveforms(tmp_path / "A.LAS")) == 4


def test_segments_without_returns_get_points(tmp_path):
    bare = [dataclasses.replace(shot, returns=None) for shot in small_shots()]
    write_las_waveforms(tmp_path / "a.las", bare)
    shots = read_las_waveforms(tmp_path / "a.las")
    assert [len(s.returns.number) for s in shots] == [1, 1, 2, 1]
    assert np.all(laspy.read(tmp_path / "a.las").synthetic)
    for shot, own in zip(shots, bare):
        np.testing.assert_array_equal(shot.waveform, own.waveform)
        np.testing.assert_allclose(shot.position, own.position, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(shots[2].returns.number, [1, 2])


def test_packets_within_the_file(small):
    """The same packets after the points, as the record that they are in a .wdp file."""
    las, wdp = bytearray(small.read_bytes()), small.with_suffix(".wdp").read_bytes()
    struct.pack_into("<H", las, 6, 2)
    struct.pack_into("<Q", las, 227, len(las))
    inside = small.with_name("inside.las")
    inside.write_bytes(bytes(las) + wdp)
    assert_same(read_las_waveforms(inside), read_las_waveforms(small), places=0)


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("single", [False, True])
def test_vectors_along_or_against_the_light(small, flipped, single):
    """The sign of vectors is told by points of one packet; without two in one, light goes down."""
    cloud = laspy.read(small)
    chosen = cloud.return_number == 1 if single else np.full(len(cloud.points), True)
    cloud.points = cloud.points[chosen]
    if flipped:
        for axis in "xyz":
            cloud[f"{axis}_t"] = -np.asarray(cloud[f"{axis}_t"])
    # The file is mapped: what is expected is read before it changes.
    expected = read_las_waveforms(small)
    anchor, direction = expected.anchor, expected.direction
    cloud.write(small)
    shots = read_las_waveforms(small)
    np.testing.assert_allclose(shots.anchor, anchor, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(shots.direction, direction)


def test_points_without_a_packet(small):
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
    def change(path):
        cloud = laspy.read(path)
        values = np.asarray(cloud[name]).copy()
        values[row] = value
        cloud[name] = values
        cloud.write(path)

    return change


def set_layout(at, kind, value):
    """Changes the layout of the second shot's packet, number 2."""

    def change(path):
        content = bytearray(path.read_bytes())
        struct.pack_into(kind, content, content.index(struct.pack("<HH", 101, 26)) + 36 + at, value)
        path.write_bytes(content)

    return change


def wdp(change):
    def apply(path):
        packets = path.with_suffix(".wdp")
        packets.write_bytes(change(packets.read_bytes()))

    return apply


@pytest.mark.parametrize(
    ("change", "says"),
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
        (wdp(lambda b: b[:-1]), "record 6: its packet of 40 bytes at byte .* does not lie within the"),
        (wdp(lambda b: b[:50]), r"small\.wdp: packets: their record begins at 0, but the file ends after 50"),
        (wdp(lambda b: b""), r"small\.wdp: packets: .* the file ends after 0 bytes"),
        (wdp(lambda b: b"PulseWaves" + b[10:]), r"small\.wdp: packets: the record at byte 0 is "),
        (set_layout(0, "<B", 12), "record 1: layout 2: 30 samples of 12 bits every 1000 ps"),
        (set_layout(1, "<B", 1), r"record 1: layout 2: packets are compressed \(1\): they are not read"),
        (set_layout(2, "<I", 0), "record 1: layout 2: 0 samples of 16 bits"),
        (set_layout(6, "<I", 0), "record 1: layout 2: 30 samples of 16 bits every 0 ps"),
        (set_layout(10, "<d", np.nan), "record 1: layout 2: gain nan, offset -0.5"),
        (set_layout(18, "<d", np.inf), "record 1: layout 2: gain 0.0125, offset inf"),
    ],
)
def test_damage_is_named(small, change, says):
    change(small)
    with pytest.raises(ValueError, match=says):
        list(read_las_waveforms(small))


def test_other_files_are_refused(small, tmp_path):
    packets = small.with_suffix(".wdp")
    packets.rename(tmp_path / "other.wdp")
    with pytest.raises(FileNotFoundError, match=r"small\.wdp: no such file"):
        read_las_waveforms(small)
    write_las(tmp_path / "points.las", np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"points\.las: header: point format 6 has no packets"):
        read_las_waveforms(tmp_path / "points.las")


def test_what_the_format_cannot_hold(tmp_path):
    shot = small_shots()[0]

    def refused(match, *shots, **how):
        with pytest.raises(ValueError, match=match):
            write_las_waveforms(tmp_path / "a.las", shots, **how)
        assert not list(tmp_path.iterdir())

    def with_segments(*segments, **changes):
        return dataclasses.replace(shot, returning=segments, returns=None, **changes)

    first = shot.returning[0]
    refused("shots: there is none")
    refused(r"point_format = 6 has no packets; those of \(4, 5, 9, 10\)", shot, point_format=6)
    refused("shot 0: samples every 0.3333", with_segments(first._replace(step=1 / 3)))
    refused("shot 0: a sample is 0.5", with_segments(first._replace(samples=np.array([0.5]))))
    refused("shot 0: a sample is -3", with_segments(first._replace(samples=np.array([4, -3]))))
    both = first._replace(channel=1, start=500.0), first
    refused(r"shot 0: segments of the channels \[0, 1\]", with_segments(*both))
    far = first, first._replace(start=500.0)
    refused("shot 0: 2 segments without a GPS time", with_segments(*far, gps_time=None))
    refused("degrees and metres", shot, dataclasses.replace(shot, metres=np.array([9e4, 1e5, 1.0])))
    layouts = (with_segments(first._replace(samples=np.zeros(n + 1, np.uint8))) for n in range(256))
    refused("shot 0: one layout of packets more than 255", *layouts)
    many = shot.returns._replace(number=np.array([9]))
    refused(r"return_number = 9 is outside the admissible range \[0, 7\]",
            dataclasses.replace(shot, returns=many), point_format=4)  # fmt: skip
    with pytest.raises(ValueError, match=r"path = .*a\.laz: its name does not end in \.las"):
        write_las_waveforms(tmp_path / "a.laz", [shot])


def test_a_failed_write_leaves_what_was_there(small):
    before = [small.with_suffix(s).read_bytes() for s in (".las", ".wdp")]

    def shots():
        yield small_shots()[0]
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="gone"):
        write_las_waveforms(small, shots())
    assert [small.with_suffix(s).read_bytes() for s in (".las", ".wdp")] == before
    assert len(list(small.parent.iterdir())) == 2


def test_without_laspy(small, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    for call in (
        lambda: read_las_waveforms(small),
        lambda: write_las(small, np.zeros((1, 3))),
        lambda: write_las_waveforms(small, small_shots()),
    ):
        with pytest.raises(ImportError, match=r"jaxlidar\[io\]"):
            call()


def test_points(tmp_path):
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
    ("fields", "says"),
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
def test_points_that_the_format_cannot_hold(tmp_path, fields, says):
    with pytest.raises(ValueError, match=says):
        write_las(tmp_path / "a.las", **({"position": np.zeros((2, 3))} | fields))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("every", slow_unless([8], [8, 1]))
def test_recorded_packets_agree_with_the_same_pulses(shared, every):
    """Sample by sample, and in place: anchor and direction meet the points."""
    shots = read_las_waveforms(shared / "airborne" / "riegl.las")
    pulses = read_pulsewaves(shared / "airborne" / "riegl.pls")
    assert len(shots) == len(pulses) == 2368
    by_time = {round(1e6 * time): i for i, time in enumerate(pulses.gps_time)}
    assert sorted(by_time) == [round(1e6 * time) for time in shots.gps_time]
    segments, points, own, other = 0, 0, [], []
    for shot in shots[::every]:
        pulse = pulses[by_time[round(1e6 * shot.gps_time)]].of_channel(1)
        starts = []
        for segment in shot.returning:
            # Packets are found by their points: three pulses have segments without one.
            same = [s for s in pulse.returning if np.array_equal(s.samples, segment.samples)]
            assert len(same) == 1
            starts.append(same[0].start)
            segments += 1
        shift = starts[0] - shot.returning[0].start
        np.testing.assert_allclose(starts, [s.start + shift for s in shot.returning], rtol=0, atol=0.02)
        times = shot.returns.time[:, None]
        own.append(shot.anchor + times * shot.direction - shot.returns.position)
        other.append(pulse.anchor + (shift + times) * shot.direction - shot.returns.position)
        np.testing.assert_allclose(shot.direction, pulse.direction, rtol=0, atol=2e-6)
        points += shot.returns.number.size
    if every == 1:
        assert (segments, points) == (2375, 2535)
    # Points of one packet agree to their rounding, and so do pulses' anchors along the points' directions.
    assert np.abs(np.concatenate(own)).max() < 1.9e-3
    assert np.abs(np.concatenate(other)).max() < 1.7e-3
    assert np.quantile(np.abs(np.concatenate(other)), 0.98) < 1.4e-3


def test_recorded_shots_are_written_and_read_again(shared, tmp_path):
    shots = read_las_waveforms(shared / "airborne" / "riegl.las")[::10]
    write_las_waveforms(tmp_path / "a.las", shots)
    assert_same(read_las_waveforms(tmp_path / "a.las"), shots)
    lvis = read_pulsewaves(shared / "airborne" / "lvis_example2.pls")[::50]
    write_las_waveforms(tmp_path / "b.las", lvis)
    for one, other in zip(read_las_waveforms(tmp_path / "b.las"), lvis, strict=True):
        np.testing.assert_array_equal(one.waveform, other.waveform)
        assert np.abs((one.position - other.position) * other.metres).max() < 2e-3
