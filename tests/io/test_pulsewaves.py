"""PulseWaves' reader: small files written here, damaged ones, and recorded ones."""

import struct

import numpy as np
import pytest

from jaxlidar.io import FileWarning, read_pulsewaves

STEP = np.array([0.01, 0.02, -0.1482])
SCALE, OFFSET = (0.001, 0.001, 0.001), (5e5, 4e6, 0.0)
KINDS = {8: "<u1", 16: "<u2", 32: "<u4"}


def record(user, number, content):
    return struct.pack("<16sI4xq64s", user, number, len(content), b"written by a test") + content


def sampling(kind, channel, *, bits=8, durations=32, segments=(0, 1), samples=(0, 5), scale=0.25, offset=2.0):
    """`segments` and `samples` are bits and fixed number."""
    numbers = (segments[0], samples[0], segments[1], samples[1], bits, 3, 1.0, 0)
    rest = struct.pack("<ffBBHIHHfI64x", scale, offset, *numbers)
    return struct.pack("<I4xBBxB", 12 + len(rest), kind, channel, durations) + rest


def descriptor(*samplings, origin=0, extra=0, unit=1.0):
    own = struct.pack("<I4xIHHfII64x", 92, origin, extra, len(samplings), unit, 0, 1)
    return own + b"".join(samplings)


def pulse(number, waves, kind, *, step=STEP):
    anchor = np.array([5e5 + number, 4e6, 400.0])
    places = [np.round((x - OFFSET) / SCALE).astype(int) for x in (anchor, anchor + 1000 * step)]
    return struct.pack("<qq6ihhBBBB", 10**6 * number, waves, *places[0], *places[1], 0, 0, kind, 0, 0, 0)


def pulses(count, start, records, *, version=(0, 3), scale=SCALE, offset=OFFSET):
    head = struct.pack("<16s156x2BHqqIIII8xIi", b"PulseWavesPulse", *version, 352, start, count, 0, 0, 48, 0,
                       records, 1)  # fmt: skip
    return head + struct.pack("<2d16x6d48x", 1e-6, 4e5, *scale, *offset)


def small_files(**changes):
    """Three pulses: one segment; two segments of 16 bits of two channels; and a varying number of them."""
    sent = sampling(1, 3, samples=(8, 0))
    kinds = {
        1: descriptor(sent, sampling(2, 1)),
        2: descriptor(sent, sampling(2, 1, bits=16), sampling(2, 0, bits=32, durations=16), extra=3),
        3: descriptor(sent, sampling(2, 1, segments=(8, 0), samples=(16, 0)), origin=0x8FFFFFFF),
    }
    table = struct.pack("<I4xI64x", 76, 1) + struct.pack("<I4xIHBBI64x", 84, 4, 0, 8, 0, 0)
    table += np.array([0, 1, 4, 9], "<f4").tobytes()
    scanner = struct.pack("<II64s64s2f28xf80x", 248, 0, b"a scanner", b"42", 1064.0, 4.0, 0.5)
    records = [record(b"PulseWaves_Spec", 200_000 + n, content) for n, content in kinds.items()]
    records += [record(b"PulseWaves_Spec", 100_001, scanner)]
    last = struct.pack("<16sI4xq64s", b"PulseWaves_Spec", 2**32 - 1, 0, b"")
    # An appended record comes after its content.
    foot = table + struct.pack("<16sI4xq64s", b"PulseWaves_Spec", 300_003, len(table), b"")

    outgoing = struct.pack("<iB", -56, 8) + bytes([2, 2, 2, 2, 2, 50, 90, 20])
    bodies = [
        outgoing + struct.pack("<i", 4 * 700) + bytes([3, 3, 40, 9, 3]),
        b"+++" + outgoing + struct.pack("<i5H", 4 * 700, 3, 3, 300, 9, 3)
        + struct.pack("<h5I", 4 * 701, 7, 7, 70_000, 7, 7),
        outgoing + struct.pack("<BiH", 2, 4 * 700, 3) + bytes([3, 9, 3]) + struct.pack("<iH", 4 * 710, 2)
        + bytes([4, 3]),
    ]  # fmt: skip
    at, content = [], b"PulseWavesWaves\0" + bytes(44)
    for body in bodies:
        at.append(len(content))
        content += body
    start = 352 + sum(map(len, records))
    pls = pulses(3, start, len(records), **changes) + b"".join(records)
    pls += b"".join(pulse(n, place, n + 1) for n, place in enumerate(at))
    return pls + last + foot, content


@pytest.fixture
def written(tmp_path):
    """Writes both files, changed, and gives the path of the pulses."""

    def write(pls=lambda b: b, wvs=lambda b: b, **changes):
        path = tmp_path / "small.pls"
        for suffix, change, content in zip((".pls", ".wvs"), (pls, wvs), small_files(**changes)):
            data = bytearray(content)
            path.with_suffix(suffix).write_bytes(bytes(change(data) or data))
        return path

    return write


def packed(kind, at, *values):
    def change(data):
        struct.pack_into(kind, data, at if at >= 0 else len(data) + at, *values)

    return change


def test_small_files(written):
    shots = read_pulsewaves(written())
    assert len(shots) == 3
    one, two, three = shots
    for n, shot in enumerate(shots):
        assert shot.index == n
        np.testing.assert_allclose(shot.anchor, [5e5 + n, 4e6, 400.0], rtol=1e-15)
        np.testing.assert_allclose(shot.direction, STEP, atol=1e-9)
        assert shot.gps_time == 4e5 + n
        assert shot.scanner[:2] == ("a scanner", "42")
        assert shot.scanner[2:] == (1064.0, 4.0, 0.5)
        np.testing.assert_array_equal(shot.pulse_power, [0, 0, 0, 0, 0, 48, 88, 18])
    np.testing.assert_array_equal(shots.anchor, [shot.anchor for shot in shots])
    np.testing.assert_array_equal(shots.direction, [shot.direction for shot in shots])
    np.testing.assert_array_equal(shots.gps_time, [shot.gps_time for shot in shots])
    # Durations are 2 + 0.25 times what is stored; the clock of the pulse is known but for the last one.
    np.testing.assert_array_equal(one.pulse_time, -12.0 + np.arange(8))
    np.testing.assert_array_equal(three.pulse_time, np.arange(8) - 6.0)
    np.testing.assert_array_equal(one.time, 702.0 + np.arange(5))
    np.testing.assert_array_equal(one.waveform, [3, 3, 40, 9, 3])
    assert one.returning[0].table == 3
    np.testing.assert_array_equal(shots.tables[3], [0, 1, 4, 9])
    assert [s.samples.dtype for s in two.returning] == [np.uint16, np.uint32]
    np.testing.assert_array_equal(two.waveform, [3, 3, 300, 9, 3])
    np.testing.assert_array_equal(two.of_channel(0).waveform, [7, 7, 70_000, 7, 7])
    assert two.of_channel(0).time[0] == 703.0
    np.testing.assert_array_equal(three.waveform, [3, 9, 3, 0, 0, 0, 0, 0, 0, 0, 4, 3])
    assert shots.levels.pedestal == 2.0


def test_a_sequence(written):
    shots = read_pulsewaves(written())
    assert [shot.index for shot in shots[1:]] == [1, 2]
    assert shots[-1].index == 2
    assert repr(shots) == "3 shots of small.pls"
    with pytest.raises(IndexError):
        _ = shots[3]


# The third pulse has a varying number of returning segments, which lies before the first of them.
THIRD_SEGMENTS = struct.pack("<BiH", 2, 4 * 700, 3)


def no_segments(data):
    at = data.index(THIRD_SEGMENTS)
    data[at] = 0


def no_returning_sampling(data):
    """Takes one of the two samplings from the descriptor of the first pulse: that of the return."""
    struct.pack_into("<H", data, FIRST + 14, 1)


@pytest.mark.parametrize(
    ("changes", "numbers"),
    [({"wvs": no_segments}, [0, 1]), ({"pls": no_returning_sampling}, [1, 2])],
)
def test_pulses_without_a_return_are_skipped_and_counted(written, changes, numbers):
    (missing,) = {0, 1, 2} - set(numbers)
    path = written(**changes)
    says = rf"small\.pls: pulse {missing}: it has no returning segment: 1 of 3 pulses skipped"
    with pytest.warns(FileWarning, match=says):
        shots = read_pulsewaves(path)
    assert shots.dropped == {"without a return": 1}
    assert [shot.index for shot in shots] == numbers
    np.testing.assert_array_equal(shots.gps_time, 4e5 + np.array(numbers))
    np.testing.assert_allclose(shots.anchor[:, 0], 5e5 + np.array(numbers), rtol=1e-12)
    assert shots.direction.shape == (2, 3)


def test_a_file_without_any_return(written):
    def no_return_at_all(data):
        no_returning_sampling(data)
        for n in (1, 2):
            struct.pack_into("<B", data, struct.unpack_from("<q", data, 176)[0] + 48 * n + 44, 1)

    with pytest.raises(ValueError, match=r"small\.pls: pulse 0: neither this pulse nor another has a return"):
        read_pulsewaves(written(pls=no_return_at_all))


def test_without_waves(written):
    path = written()
    path.with_suffix(".wvs").unlink()
    with pytest.raises(FileNotFoundError, match=r"small\.wvs: no such file"):
        read_pulsewaves(path)


# The first record describes pulses of kind 1; the first of its samplings begins 96 + 92 bytes later.
FIRST, SAMPLE = 352 + 96, 352 + 96 + 92


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"pls": lambda b: b[:100]}, r"pls: header: the file ends after 100 bytes"),
        ({"pls": lambda b: b"PulseWavesWave" + b[14:]}, r"pls: header: no file of pulses"),
        ({"pls": lambda b: b[:-400]}, r"pls: pulse 2: the file ends, but its header names 3 pulses"),
        ({"pls": packed("<q", 184, 10**15)}, r"pls: pulse \d+: the file ends, but its header names 10{15} "),
        ({"pls": packed("<q", 184, 0)}, r"pls: header: the file holds 0 pulses"),
        ({"pls": packed("<q", 176, 10**9)}, r"pls: header: it is 352 bytes long and pulses begin at 10{9}"),
        ({"pls": packed("<I", 200, 20)}, r"pls: header: pulses of 20 bytes; they have 48 or more"),
        ({"pls": packed("<I", 204, 1)}, r"pls: header: pulse format 0, compression 1"),
        ({"pls": packed("<I", 216, 99)}, r"pls: header: 99 variable length records, but there is room for 4"),
        ({"pls": packed("<q", 352 + 24, -5)}, r"pls: variable length record 0: its -5 bytes"),
        ({"pls": packed("<q", 352 + 24, 10**6)}, r"pls: variable length record 0: its 10{6} bytes run into"),
        ({"pls": packed("<q", -72, 10**6)}, r"pls: appended record 300003: its 10{6} bytes run into"),
        ({"pls": packed("<I", -352, 7)}, r"pls: appended records: there is no first one after the pulses"),
        ({"version": (9, 0)}, r"pls: header: version 9\.0 is none of"),
        ({"scale": (np.nan, 1.0, 1.0)}, r"pls: header: scale of x = nan is outside"),
        ({"offset": (0.0, 0.0, np.inf)}, r"pls: header: offset of z = inf is not finite"),
        ({"pls": packed("<H", FIRST + 14, 9)}, r"pls: record 200001: 9 samplings, but there is room for 2"),
        ({"pls": packed("<f", FIRST + 16, np.nan)}, r"pls: record 200001: 2 samplings .* units of nan ns"),
        ({"pls": packed("<I", FIRST + 20, 1)}, r"pls: record 200001: waves are compressed \(1\)"),
        ({"pls": packed("<B", SAMPLE + 8, 5)}, r"pls: record 200001: sampling 0: type 5 is neither"),
        ({"pls": packed("<B", SAMPLE + 11, 7)}, r"sampling 0: duration_bits = 7 is none of \(0, 16, 32\)"),
        ({"pls": packed("<f", SAMPLE + 12, -1.0)}, r"sampling 0: scale = -1 is outside"),
        ({"pls": packed("<f", SAMPLE + 16, np.inf)}, r"sampling 0: offset = inf is not finite"),
        ({"pls": packed("<B", SAMPLE + 21, 0)}, r"sampling 0: its segments have 0 samples"),
        ({"pls": packed("<H", SAMPLE + 22, 0)}, r"sampling 0: it has 0 segments"),
        ({"pls": packed("<H", SAMPLE + 28, 12)}, r"sampling 0: bits = 12 is none of \(8, 16, 32\)"),
        ({"pls": packed("<I", SAMPLE + 36, 1)}, r"sampling 0: samples are compressed \(1\)"),
        ({"wvs": lambda b: b[:59]}, r"wvs: header: no file of waves"),
        ({"wvs": packed("<4s", 0, b"LASF")}, r"wvs: header: no file of waves"),
        ({"wvs": packed("<I", 16, 1)}, r"wvs: header: waves are compressed \(1\)"),
        ({"wvs": lambda b: b[:-1]}, r"pulse 2: its waves at byte \d+ of small\.wvs: the file ends after"),
    ],
)
def test_damage_is_named(written, change, says):
    with pytest.raises(ValueError, match=says):
        list(read_pulsewaves(written(**change)))


def at_pulse(number, kind, at, *values):
    """A change within a pulse: those begin 96 + 96 + 160 + 144 bytes before the end."""

    def change(data):
        start = struct.unpack_from("<q", data, 176)[0] + 48 * number
        struct.pack_into(kind, data, start + at, *values)

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (at_pulse(1, "<B", 44, 9), r"pulse 1: descriptor 9 is none of \[1, 2, 3\]"),
        (at_pulse(1, "<q", 8, 10**9), r"pulse 1: its waves at byte 10{9} of small\.wvs: the file ends after"),
        (at_pulse(1, "<q", 8, -1), r"pulse 1: its waves at byte -1 of small\.wvs: they lie in the header"),
        (at_pulse(1, "<i", 36, 0), r"pulse 1: the way of light in 1 ns cannot be \["),
    ],
)
def test_a_damaged_pulse_leaves_the_others_alone(written, change, says):
    waveforms = [shot.waveform for shot in read_pulsewaves(written())]
    shots = read_pulsewaves(written(pls=change))
    for i in (0, 2):
        np.testing.assert_array_equal(shots[i].waveform, waveforms[i])
    assert shots.levels.pedestal == 2.0
    with pytest.raises(ValueError, match=rf"small\.pls: {says}"):
        _ = shots[1]


def test_directions_in_no_known_unit(written):
    with pytest.raises(
        ValueError, match=r"small\.pls: pulses: directions of 1\.4\d* m per ns, where light goes"
    ):
        read_pulsewaves(written(scale=(0.01, 0.01, 0.01)))


def test_feet(written):
    """A scale of 1/0.3048 mm gives the same flight in feet."""
    feet = tuple(1e-3 / 0.3048 for _ in range(3))
    shot = read_pulsewaves(written(scale=feet))[0]
    np.testing.assert_allclose(shot.metres, 0.3048)
    assert shot.zenith == pytest.approx(read_pulsewaves(written())[0].zenith)


def test_recorded_pulses_of_riegl(shared):
    shots = read_pulsewaves(shared / "airborne" / "riegl.pls")
    assert len(shots) == 2368
    some = shots[:3] + shots[::10]
    assert all(len(s.outgoing) == 1 for s in some)
    assert [len(s.returning) for s in some[:3]] == [2, 1, 1]
    # The outgoing pulse is timed from its largest sample.
    peaks = np.array([s.pulse_time[s.pulse_power.argmax()] for s in some])
    assert np.abs(peaks).max() < 0.004
    assert shots[0].scanner.instrument == "Q680i"
    assert shots[0].scanner.wavelength == 1550.0
    assert sorted(shots.tables) == [1, 2]
    assert all(table.shape == (256,) and np.all(np.diff(table) >= 0) for table in shots.tables.values())
    assert all(0 < s.zenith < 31 for s in some)


def test_recorded_pulses_of_lvis(shared):
    shots = read_pulsewaves(shared / "airborne" / "lvis_example2.pls")
    assert len(shots) == 1000
    shots = shots[::4]
    waveforms = np.stack([s.waveform for s in shots])
    assert waveforms.shape == (250, 432)
    assert {s.sampling_interval for s in shots} == {2.0}
    assert all(s.outgoing[0].samples.size == 80 for s in shots)
    # Raw samples: a third saturates, and odd and even ones have pedestals of their own.
    assert 0.28 < np.mean(waveforms.max(axis=1) >= 220) < 0.38
    quiet = waveforms[:, :40]
    assert 0.8 < np.median(quiet[:, ::2].mean(axis=1)) - np.median(quiet[:, 1::2].mean(axis=1)) < 1.4
    # Degrees: samples lie 2 ns, 0.2998 m, apart nevertheless.
    steps = [np.linalg.norm((s.position[1] - s.position[0]) * s.metres) for s in shots]
    np.testing.assert_allclose(steps, 0.29979, rtol=1e-3)
    assert all(s.is_geographic and s.zenith < 9 for s in shots)


def test_recorded_pulses_without_a_return(shared):
    path = shared / "airborne" / "test.pls"
    with pytest.warns(FileWarning, match=r"test\.pls: pulse 3: .*: 1 of 15 pulses skipped"):
        shots = read_pulsewaves(path)
    assert [shot.index for shot in shots] == [n for n in range(15) if n != 3]
    assert shots.dropped == {"without a return": 1}
    # The pulse record names the first returning sample, in units of 1 ns.
    for shot, first in zip(shots, shots.pulses["first"][shots.pulse_numbers], strict=True):
        assert shot.returning[0].time[0] == pytest.approx(first, abs=1.0)
