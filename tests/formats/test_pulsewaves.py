"""Reader of PulseWaves files: small files that are written here, damaged files, and recorded ones."""

import struct

import numpy as np
import pytest

from jaxlidar.io import FileWarning, read_pulsewaves

# Displacement of light in 1 ns, in m.
STEP = np.array([0.01, 0.02, -0.1482])
SCALE, OFFSET = (0.001, 0.001, 0.001), (5e5, 4e6, 0.0)


def variable_length_record(user, number, content):
    """Return the bytes of a record after the header."""
    return struct.pack("<16sI4xq64s", user, number, len(content), b"written by a test") + content


def sampling(kind, channel, *, bits=8, durations=32, segments=(0, 1), samples=(0, 5), scale=0.25, offset=2.0):
    """Return the bytes of a sampling record, of which `kind` is 1 (outgoing) or 2 (returning).

    `bits`: of a sample. `durations`: bits of the start of a segment. `segments`, `samples`: bits of the count
    that is stored with each pulse, and the count itself if these are 0.
    """
    counts = (segments[0], samples[0], segments[1], samples[1], bits, 3, 1.0, 0)
    body = struct.pack("<ffBBHIHHfI64x", scale, offset, *counts)
    return struct.pack("<I4xBBxB", 12 + len(body), kind, channel, durations) + body


def descriptor(*samplings, origin=0, extra=0, unit=1.0):
    """Return the bytes of a pulse descriptor: a header and its samplings."""
    header = struct.pack("<I4xIHHfII64x", 92, origin, extra, len(samplings), unit, 0, 1)
    return header + b"".join(samplings)


def pulse(number, waves_offset, descriptor_number, *, step=STEP):
    """Return the bytes of a pulse, with the place of its waves in the .wvs file."""
    anchor = np.array([5e5 + number, 4e6, 400.0])
    # The direction is stored by a second point, 1000 ns after the anchor.
    anchor, target = (np.round((x - OFFSET) / SCALE).astype(int) for x in (anchor, anchor + 1000 * step))
    fields = (10**6 * number, waves_offset, *anchor, *target, 0, 0, descriptor_number, 0, 0, 0)
    return struct.pack("<qq6ihhBBBB", *fields)


def pulses_header(count, start, records, *, version=(0, 3), scale=SCALE, offset=OFFSET):
    """Return the header of a .pls file."""
    head = struct.pack("<16s156x2BHqqIIII8xIi", b"PulseWavesPulse", *version, 352, start, count, 0, 0, 48, 0,
                       records, 1)  # fmt: skip
    return head + struct.pack("<2d16x6d48x", 1e-6, 4e5, *scale, *offset)


def small_files(**changes):
    """Return the bytes of a .pls and a .wvs file of three pulses, with changes of the header.

    They have one segment of 8 bits; two segments, of 16 and 32 bits, of different channels; and a number of
    segments and samples that is stored with the pulse.
    """
    outgoing_sampling = sampling(1, 3, samples=(8, 0))
    descriptors = {
        1: descriptor(outgoing_sampling, sampling(2, 1)),
        2: descriptor(
            outgoing_sampling, sampling(2, 1, bits=16), sampling(2, 0, bits=32, durations=16), extra=3
        ),
        3: descriptor(outgoing_sampling, sampling(2, 1, segments=(8, 0), samples=(16, 0)), origin=0x8FFFFFFF),
    }
    table = struct.pack("<I4xI64x", 76, 1) + struct.pack("<I4xIHBBI64x", 84, 4, 0, 8, 0, 0)
    table += np.array([0, 1, 4, 9], "<f4").tobytes()
    scanner = struct.pack("<II64s64s2f28xf80x", 248, 0, b"a scanner", b"42", 1064.0, 4.0, 0.5)
    records = [
        variable_length_record(b"PulseWaves_Spec", 200_000 + n, content) for n, content in descriptors.items()
    ]
    records += [variable_length_record(b"PulseWaves_Spec", 100_001, scanner)]
    last = struct.pack("<16sI4xq64s", b"PulseWaves_Spec", 2**32 - 1, 0, b"")
    # The header of an appended record comes after its content.
    table_record = table + struct.pack("<16sI4xq64s", b"PulseWaves_Spec", 300_003, len(table), b"")

    outgoing = struct.pack("<iB", -56, 8) + bytes([2, 2, 2, 2, 2, 50, 90, 20])
    bodies = [
        outgoing + struct.pack("<i", 4 * 700) + bytes([3, 3, 40, 9, 3]),
        b"+++" + outgoing + struct.pack("<i5H", 4 * 700, 3, 3, 300, 9, 3)
        + struct.pack("<h5I", 4 * 701, 7, 7, 70_000, 7, 7),
        outgoing + struct.pack("<BiH", 2, 4 * 700, 3) + bytes([3, 9, 3]) + struct.pack("<iH", 4 * 710, 2)
        + bytes([4, 3]),
    ]  # fmt: skip
    offsets, content = [], b"PulseWavesWaves\0" + bytes(44)
    for body in bodies:
        offsets.append(len(content))
        content += body
    start = 352 + sum(map(len, records))
    pls = pulses_header(3, start, len(records), **changes) + b"".join(records)
    pls += b"".join(pulse(n, offset, n + 1) for n, offset in enumerate(offsets))
    return pls + last + table_record, content


@pytest.fixture
def written(tmp_path):
    """A function that writes both files, each changed by a function, and returns the path of the pulses."""

    def write(pls=lambda b: b, wvs=lambda b: b, **changes):
        path = tmp_path / "small.pls"
        for suffix, change, content in zip((".pls", ".wvs"), (pls, wvs), small_files(**changes)):
            # A function returns the changed bytes, or changes them in place and returns None.
            data = bytearray(content)
            path.with_suffix(suffix).write_bytes(bytes(change(data) or data))
        return path

    return write


def set_field(format, offset, *values):
    """Return a function that overwrites numbers at an offset, which counts from the end if it is negative."""

    def change(data):
        struct.pack_into(format, data, offset if offset >= 0 else len(data) + offset, *values)

    return change


def test_fields_of_shots(written):
    shots = read_pulsewaves(written())
    assert len(shots) == 3
    first, second, third = shots
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
    # Starts of segments are 2 + 0.25 times the stored integers, -56 and 2800. The clock of the last pulse has
    # no origin, so that the time of its outgoing segment is zero at the largest sample.
    np.testing.assert_array_equal(first.pulse_time, -12.0 + np.arange(8))
    np.testing.assert_array_equal(third.pulse_time, np.arange(8) - 6.0)
    np.testing.assert_array_equal(first.time, 702.0 + np.arange(5))
    np.testing.assert_array_equal(first.waveform, [3, 3, 40, 9, 3])
    assert first.returning[0].table == 3
    np.testing.assert_array_equal(shots.tables[3], [0, 1, 4, 9])
    assert [s.samples.dtype for s in second.returning] == [np.uint16, np.uint32]
    np.testing.assert_array_equal(second.waveform, [3, 3, 300, 9, 3])
    np.testing.assert_array_equal(second.of_channel(0).waveform, [7, 7, 70_000, 7, 7])
    assert second.of_channel(0).time[0] == 703.0
    np.testing.assert_array_equal(third.waveform, [3, 9, 3, 0, 0, 0, 0, 0, 0, 0, 4, 3])
    assert shots.levels.pedestal == 2.0


def test_shots_are_a_sequence(written):
    shots = read_pulsewaves(written())
    assert [shot.index for shot in shots[1:]] == [1, 2]
    assert shots[-1].index == 2
    assert repr(shots) == "3 shots of small.pls"
    with pytest.raises(IndexError, match="shot 3: there are 3; admissible are -3 to 2"):
        _ = shots[3]


# The third pulse has a varying number of returning segments, which lies before the first of them.
THIRD_SEGMENTS = struct.pack("<BiH", 2, 4 * 700, 3)


def no_segments(data):
    at = data.index(THIRD_SEGMENTS)
    data[at] = 0


def no_returning_sampling(data):
    """Takes one of the two samplings from the descriptor of the first pulse: that of the return."""
    struct.pack_into("<H", data, DESCRIPTOR + 14, 1)


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


def test_a_missing_file_of_waves_is_refused(written):
    path = written()
    path.with_suffix(".wvs").unlink()
    with pytest.raises(FileNotFoundError, match=r"small\.wvs: no such file"):
        read_pulsewaves(path)


# Offsets of the first descriptor, after the file's header (352 bytes) and that of the record (96), and of its
# first sampling, after the descriptor's header (92).
DESCRIPTOR, SAMPLING = 352 + 96, 352 + 96 + 92


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pls": lambda b: b[:100]}, r"pls: header: the file ends after 100 bytes"),
        ({"pls": lambda b: b"PulseWavesWave" + b[14:]}, r"pls: header: no file of pulses"),
        ({"pls": lambda b: b[:-400]}, r"pls: pulse 2: the file ends, but its header names 3 pulses"),
        (
            {"pls": set_field("<q", 184, 10**15)},
            r"pls: pulse \d+: the file ends, but its header names 10{15} ",
        ),
        ({"pls": set_field("<q", 184, 0)}, r"pls: header: the file holds 0 pulses"),
        (
            {"pls": set_field("<q", 176, 10**9)},
            r"pls: header: it is 352 bytes long and pulses begin at 10{9}",
        ),
        ({"pls": set_field("<I", 200, 20)}, r"pls: header: pulses of 20 bytes; they have 48 or more"),
        ({"pls": set_field("<I", 204, 1)}, r"pls: header: pulse format 0, compression 1"),
        (
            {"pls": set_field("<I", 216, 99)},
            r"pls: header: 99 variable length records, but there is room for 4",
        ),
        ({"pls": set_field("<q", 352 + 24, -5)}, r"pls: variable length record 0: its -5 bytes"),
        (
            {"pls": set_field("<q", 352 + 24, 10**6)},
            r"pls: variable length record 0: its 10{6} bytes run into",
        ),
        ({"pls": set_field("<q", -72, 10**6)}, r"pls: appended record 300003: its 10{6} bytes run into"),
        ({"pls": set_field("<I", -352, 7)}, r"pls: appended records: there is no first one after the pulses"),
        ({"version": (9, 0)}, r"pls: header: version 9\.0 is none of"),
        ({"scale": (np.nan, 1.0, 1.0)}, r"pls: header: scale of x = nan is outside"),
        ({"offset": (0.0, 0.0, np.inf)}, r"pls: header: offset of z = inf is not finite"),
        (
            {"pls": set_field("<H", DESCRIPTOR + 14, 9)},
            r"pls: record 200001: 9 samplings, but there is room for 2",
        ),
        (
            {"pls": set_field("<f", DESCRIPTOR + 16, np.nan)},
            r"pls: record 200001: 2 samplings .* units of nan ns",
        ),
        ({"pls": set_field("<I", DESCRIPTOR + 20, 1)}, r"pls: record 200001: waves are compressed \(1\)"),
        ({"pls": set_field("<B", SAMPLING + 8, 5)}, r"pls: record 200001: sampling 0: type 5 is neither"),
        (
            {"pls": set_field("<B", SAMPLING + 11, 7)},
            r"sampling 0: duration_bits = 7 is none of \(0, 16, 32\)",
        ),
        ({"pls": set_field("<f", SAMPLING + 12, -1.0)}, r"sampling 0: scale = -1 is outside"),
        ({"pls": set_field("<f", SAMPLING + 16, np.inf)}, r"sampling 0: offset = inf is not finite"),
        ({"pls": set_field("<B", SAMPLING + 21, 0)}, r"sampling 0: its segments have 0 samples"),
        ({"pls": set_field("<H", SAMPLING + 22, 0)}, r"sampling 0: it has 0 segments"),
        ({"pls": set_field("<H", SAMPLING + 28, 12)}, r"sampling 0: bits = 12 is none of \(8, 16, 32\)"),
        ({"pls": set_field("<I", SAMPLING + 36, 1)}, r"sampling 0: samples are compressed \(1\)"),
        ({"wvs": lambda b: b[:59]}, r"wvs: header: no file of waves"),
        ({"wvs": set_field("<4s", 0, b"LASF")}, r"wvs: header: no file of waves"),
        ({"wvs": set_field("<I", 16, 1)}, r"wvs: header: waves are compressed \(1\)"),
        ({"wvs": lambda b: b[:-1]}, r"pulse 2: its waves at byte \d+ of small\.wvs: the file ends after"),
    ],
)
def test_damaged_files_are_refused_with_the_place_of_the_fault(written, change, message):
    with pytest.raises(ValueError, match=message):
        list(read_pulsewaves(written(**change)))


def set_pulse_field(number, format, offset, *values):
    """Return a function that overwrites numbers in a pulse; the header says where the first one begins."""

    def change(data):
        start = struct.unpack_from("<q", data, 176)[0] + 48 * number
        struct.pack_into(format, data, start + offset, *values)

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_pulse_field(1, "<B", 44, 9), r"pulse 1: descriptor 9 is none of \[1, 2, 3\]"),
        (
            set_pulse_field(1, "<q", 8, 10**9),
            r"pulse 1: its waves at byte 10{9} of small\.wvs: the file ends after",
        ),
        (
            set_pulse_field(1, "<q", 8, -1),
            r"pulse 1: its waves at byte -1 of small\.wvs: they lie in the header",
        ),
        (set_pulse_field(1, "<i", 36, 0), r"pulse 1: the way of light in 1 ns cannot be \["),
    ],
)
def test_a_damaged_pulse_leaves_the_others_alone(written, change, message):
    waveforms = [shot.waveform for shot in read_pulsewaves(written())]
    shots = read_pulsewaves(written(pls=change))
    for i in (0, 2):
        np.testing.assert_array_equal(shots[i].waveform, waveforms[i])
    assert shots.levels.pedestal == 2.0
    with pytest.raises(ValueError, match=rf"small\.pls: {message}"):
        _ = shots[1]


def test_directions_that_imply_a_wrong_speed_of_light_are_refused(written):
    with pytest.raises(
        ValueError, match=r"small\.pls: pulses: directions of 1\.4\d* m per ns, where light goes"
    ):
        read_pulsewaves(written(scale=(0.01, 0.01, 0.01)))


def test_coordinates_in_feet_are_recognised_by_the_speed_of_light(written):
    """The same flight in feet: the scale of 0.001 m is 0.001 / 0.3048 feet."""
    scale_in_feet = tuple(1e-3 / 0.3048 for _ in range(3))
    shot = read_pulsewaves(written(scale=scale_in_feet))[0]
    np.testing.assert_allclose(shot.metres, 0.3048)
    assert shot.zenith == pytest.approx(read_pulsewaves(written())[0].zenith)


def test_recorded_pulses_of_riegl(shared):
    shots = read_pulsewaves(shared / "airborne" / "riegl.pls")
    assert len(shots) == 2368
    sample = shots[:3] + shots[::10]
    assert all(len(s.outgoing) == 1 for s in sample)
    assert [len(s.returning) for s in sample[:3]] == [2, 1, 1]
    # Times of the outgoing pulse are relative to its largest sample.
    peaks = np.array([s.pulse_time[s.pulse_power.argmax()] for s in sample])
    assert np.abs(peaks).max() < 0.004
    assert shots[0].scanner.instrument == "Q680i"
    assert shots[0].scanner.wavelength == 1550.0
    assert sorted(shots.tables) == [1, 2]
    assert all(table.shape == (256,) and np.all(np.diff(table) >= 0) for table in shots.tables.values())
    assert all(0 < s.zenith < 31 for s in sample)


def test_recorded_pulses_of_lvis(shared):
    shots = read_pulsewaves(shared / "airborne" / "lvis_example2.pls")
    assert len(shots) == 1000
    shots = shots[::4]
    waveforms = np.stack([s.waveform for s in shots])
    assert waveforms.shape == (250, 432)
    assert {s.sampling_interval for s in shots} == {2.0}
    assert all(s.outgoing[0].samples.size == 80 for s in shots)
    # Samples are not corrected: a third of the waveforms saturates, and odd and even samples have different
    # pedestals.
    assert 0.28 < np.mean(waveforms.max(axis=1) >= 220) < 0.38
    dark = waveforms[:, :40]
    assert 0.8 < np.median(dark[:, ::2].mean(axis=1)) - np.median(dark[:, 1::2].mean(axis=1)) < 1.4
    # Positions are in degrees; converted to m, samples lie 2 ns apart.
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
