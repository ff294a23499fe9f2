"""`AirborneShot`, the record that all readers of airborne waveforms return, and stacks of several."""

import dataclasses
import pickle

import jax
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.io import AirborneShot, Segment, stack_shots

# Displacement of light in 1 ns and a point on the beam, in m.
DIRECTION = np.array([0.02, 0.01, -0.1482])
ANCHOR = np.array([5e5, 4e6, 300.0])


def shot_of(*returning, **changes):
    """Return shot 7 with some returning segments."""
    fields = {"anchor": ANCHOR, "direction": DIRECTION, "returning": returning}
    return AirborneShot(7, **(fields | changes))


def echo(start, *samples, **changes):
    """Return a segment of 8-bit samples that begins at the time `start` in ns."""
    return Segment(np.array(samples, np.uint8), start, **changes)


def test_samples_of_one_segment_have_times_and_positions():
    shot = shot_of(echo(10.25, 3, 4, 90, 5, step=2.0), noise_mean=3.0)
    np.testing.assert_array_equal(shot.time, [10.25, 12.25, 14.25, 16.25])
    np.testing.assert_array_equal(shot.waveform, [3, 4, 90, 5])
    np.testing.assert_array_equal(shot.signal, [0, 1, 87, 2])
    assert shot.recorded.all()
    np.testing.assert_allclose(shot.position[2], ANCHOR + 14.25 * DIRECTION, rtol=1e-14)
    assert shot.zenith == pytest.approx(np.rad2deg(np.arctan2(np.hypot(0.02, 0.01), 0.1482)))
    assert shot.azimuth == pytest.approx(np.rad2deg(np.arctan2(0.02, 0.01)))
    np.testing.assert_allclose(shot.time_from(shot.elevation[2]), [-4, -2, 0, 2], atol=1e-9)
    np.testing.assert_allclose(shot.position_at(shot.elevation[2]), shot.position[2, :2], rtol=1e-14)


def test_samples_between_two_segments_are_marked_as_not_recorded():
    """Segments are sorted by time. The second one keeps its start, which is no multiple of the interval."""
    shot = shot_of(echo(105.003, 7, 8), echo(100.0, 1, 2, 3), noise_mean=1.0)
    np.testing.assert_array_equal(shot.recorded, [1, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(shot.waveform, [1, 2, 3, 0, 0, 7, 8])
    np.testing.assert_array_equal(shot.signal, [0, 1, 2, 0, 0, 6, 7])
    np.testing.assert_allclose(shot.time[[0, 2, 5, 6]], [100, 102, 105.003, 106.003], rtol=1e-14)
    assert np.all(np.diff(shot.time) > 0)
    # A segment that begins within half a sample of the end of the one before leaves no gap.
    assert shot_of(echo(0.4, 1, 2), echo(2.0, 3)).recorded.all()


def test_segments_of_different_channels_are_not_joined():
    shot = shot_of(echo(5.0, 1, 9, channel=1), echo(6.4, 2, 4, channel=0))
    np.testing.assert_array_equal(shot.waveform, [1, 9])
    np.testing.assert_array_equal(shot.of_channel(0).waveform, [2, 4])
    with pytest.raises(ValueError, match=r"shot 7: channel = 2 is none of \[0, 1\]"):
        shot.of_channel(2)


def test_gain_and_offset_of_the_digitiser_are_applied():
    shot = shot_of(echo(0.0, 0, 100, gain=0.5, offset=-3.0))
    np.testing.assert_array_equal(shot.waveform, [-3.0, 47.0])


def test_the_outgoing_pulse_has_times_and_power_above_the_pedestal():
    outgoing = Segment(np.array([12, 11, 10, 60, 90, 40, 10, 9]), -4.0)
    shot = shot_of(echo(0.0, 1), outgoing=(outgoing,), pedestal=10.0)
    np.testing.assert_array_equal(shot.pulse_time, np.arange(-4.0, 4.0))
    np.testing.assert_array_equal(shot.pulse_power, [0, 0, 0, 50, 80, 30, 0, 0])
    shifted = dataclasses.replace(shot, pulse_zero=1.0)
    np.testing.assert_array_equal(shifted.pulse_time, np.arange(-5.0, 3.0))
    with pytest.raises(ValueError, match="shot 7: no outgoing pulse"):
        _ = shot_of(echo(0.0, 1)).pulse_power
    with pytest.raises(ValueError, match="shot 7: outgoing: a pulse without energy"):
        _ = dataclasses.replace(shot, pedestal=90.0).pulse_power


def test_a_simulated_echo_returns_at_the_elevation_of_its_target():
    """The echo of a target at the elevation of sample 25 is largest in sample 25."""
    outgoing = Segment(np.array([0, 30, 80, 30, 0]), -2.0)
    shot = shot_of(Segment(np.zeros(60, int), 40.0), outgoing=(outgoing,))
    lidar = jl.Lidar(
        pulse=jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power),
        zenith=shot.zenith,
        azimuth=shot.azimuth,
        divergence=0.0,
    )
    reference = float(shot.elevation[35])
    scene = jl.Scene(ground=jl.Ground(height=float(shot.elevation[25]) - reference))
    wave = jl.simulate(lidar, scene, max_orders=1, key=jax.random.key(0))
    samples = np.interp(shot.time_from(reference), np.asarray(wave.time), np.asarray(wave.reflectance[0]))
    assert samples.argmax() == 25


def test_directions_in_degrees_are_converted_to_metres():
    """`metres` holds the metres per unit of each axis."""
    metres = np.array([88_000.0, 111_000.0, 1.0])
    shot = shot_of(echo(0.0, 1), direction=DIRECTION / metres, metres=metres)
    assert shot.zenith == pytest.approx(shot_of(echo(0.0, 1)).zenith)
    assert shot.azimuth == pytest.approx(shot_of(echo(0.0, 1)).azimuth)
    assert shot.is_geographic
    assert not shot_of(echo(0.0, 1)).is_geographic


@pytest.mark.parametrize(
    ("segments", "message"),
    [
        ([], "no returning segment"),
        ([echo(0.0)], "a segment of 0 samples"),
        ([echo(np.nan, 1)], "from nan ns"),
        ([echo(0.0, 1, step=0.0)], "every 0 ns"),
        ([echo(0.0, 1, gain=np.inf)], "gain inf"),
        ([echo(0.0, 1, 2, 3), echo(2.0, 4)], "segments of channel 0 overlap"),
        ([echo(0.0, 1), echo(5.0, 1, step=2.0)], "segments of channel 0 have different steps"),
        ([echo(0.0, 1), echo(1e9, 1)], r"1000000001 samples from the first to the last; at most 1000000"),
    ],
)
def test_inconsistent_segments_are_refused(segments, message):
    with pytest.raises(ValueError, match=f"shot 7: .*{message}"):
        shot_of(*segments)


def test_a_shot_can_be_pickled():
    shot = pickle.loads(pickle.dumps(shot_of(echo(0.0, 1, 2), noise_std=0.5)))
    np.testing.assert_array_equal(shot.waveform, [1, 2])


def test_stacked_shots_share_their_times():
    shots = [shot_of(echo(40.0, 3, 9, 3), noise_mean=3.0), shot_of(echo(1.0, 5, 8), echo(6.0, 7))]
    stack = stack_shots(shots)
    np.testing.assert_array_equal(stack.time, np.arange(6))
    np.testing.assert_array_equal(stack.signal, [[0, 6, 0, 0, 0, 0], [5, 8, 0, 0, 0, 7]])
    np.testing.assert_array_equal(stack.recorded, [[1, 1, 1, 0, 0, 0], [1, 1, 0, 0, 0, 1]])
    with pytest.raises(ValueError, match=r"sampling intervals \[1\.0, 2\.0\] ns; admissible is one"):
        stack_shots([shots[0], shot_of(echo(0.0, 1, step=2.0))])
    with pytest.raises(ValueError, match="shots is empty; admissible are one or more"):
        stack_shots([])
