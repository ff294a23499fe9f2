"""Ground and canopy from photon events, against the scene that the events are drawn from."""

import itertools
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion.metrics import photons
from jaxlidar._constants import PLANCK_TIMES_LIGHT
from jaxlidar.formats.icesat2 import PhotonTrack
from jaxlidar.sensors.photon_counter import PhotonEvents
from tests.helpers import slow_unless

# An even canopy, m above ground.
BASE, TOP = 5.0, 15.0
# Height of the ground at the middle of the track, 100 m from its start, m.
GROUND = 3.0
SHOTS = 286
DISTANCE = 0.7 * np.arange(SHOTS)


def track(slope, ground=2.0, canopy=2.0, footprint=0.0, base=BASE, top=TOP):
    """Waveforms along 200 m, as far as `record` reads them, of sloping ground and a canopy.

    `slope`: degrees. `ground`, `canopy`: mean number of photons of each per pulse. `footprint`: radius in m
    (one standard deviation) over which a slope spreads the ground's echo. `base`, `top`: of the canopy, m.
    """
    height = np.arange(60.0, -30.0, -0.1)
    above = height - GROUND - np.tan(np.deg2rad(slope)) * (DISTANCE[:, None] - 100.0)
    width = np.hypot(0.15, footprint * np.tan(np.deg2rad(slope)))
    echo = np.exp(-0.5 * (above / width) ** 2)
    layer = ((above > base) & (above < top)).astype(float)
    targets = ((ground, echo), (canopy, layer))
    photons = sum(n * shape / shape.sum(axis=1, keepdims=True) for n, shape in targets)
    return SimpleNamespace(
        time=-2.0 * height / jl.SPEED_OF_LIGHT,
        wavelength=np.array([532.0]),
        energy=photons[:, None] * PLANCK_TIMES_LIGHT / 532.0,
        zenith=np.zeros(SHOTS),
        position=np.zeros((SHOTS, 2)),
    )


def events_of(wave, rate, seed=0):
    counter = jl.PhotonCounter(background_rate=rate, window=(-1000.0, 1000.0))
    return counter.count(wave, key=jax.random.key(seed))


def errors(slope, rate):
    """Errors of ground and of canopy, over segments and draws, and the purity and recall of signal."""
    ground, canopy, classification = [], [], []
    wave = track(slope)
    for seed in range(4):
        events = events_of(wave, rate, seed)
        heights = inversion.photon_ground_and_canopy(events, DISTANCE)
        ground.append(heights.ground - GROUND - np.tan(np.deg2rad(slope)) * (heights.distance - 100.0))
        canopy.append(heights.canopy - (BASE + 0.98 * (TOP - BASE)))
        is_signal = heights.label > 0
        classification.append((events.signal[is_signal].mean(), is_signal[events.signal].mean()))
    return np.concatenate(ground), np.concatenate(canopy), np.mean(classification, axis=0)


def rms(x):
    return np.sqrt(np.mean(x**2))


@pytest.mark.parametrize(
    ("rate", "slope"),
    slow_unless([(1e5, 0.0), (5e6, 15.0)], itertools.product([1e5, 1e6, 5e6], [0.0, 15.0])),
)
def test_ground_and_canopy_are_found_by_night_and_by_day(slope, rate):
    ground, canopy, (purity, recall) = errors(slope, rate)
    assert abs(ground.mean()) < 0.05
    assert rms(ground) < 0.15
    # The few photons of the canopy's top are lost with the noise: by day, heights read low.
    assert abs(canopy.mean()) < 0.5
    assert rms(canopy) < 1.0
    assert purity > 0.8
    assert recall > 0.95


def test_without_the_noise_filter_the_canopy_is_missed(monkeypatch):
    """Negative control: if all photons pass for signal, background by day is taken for canopy."""
    monkeypatch.setattr(photons, "_count_neighbours", lambda x, z: np.full(x.size, np.inf))
    _, canopy, (purity, _) = errors(0.0, 5e6)
    # Noise fills the window of 300 m: percentiles of it are far above the canopy.
    assert not np.any(np.abs(canopy) < 5.0)
    assert purity < 0.6


@pytest.mark.parametrize("slope", [10.0, 20.0])
def test_a_bare_slope_has_no_canopy_and_its_ground_is_the_middle_of_the_echo(slope, monkeypatch):
    events = events_of(track(slope, ground=3.0, canopy=0.0, footprint=2.75), 2e6)

    def error_and_canopies():
        heights = inversion.photon_ground_and_canopy(events, DISTANCE)
        truth = GROUND + np.tan(np.deg2rad(slope)) * (heights.distance - 100.0)
        return np.abs(heights.ground - truth), np.isfinite(heights.canopy).mean(), heights.quality == "good"

    error, canopies, is_good = error_and_canopies()
    assert np.median(error) < 0.2
    assert np.all(error[is_good] < 0.7)
    # On 20 degrees, plants that add a tenth to the echo's variance are a metre high: no ground is good.
    assert is_good.mean() > 0.5 or slope == 20.0
    assert canopies <= 0.1
    # Negative control: the echo of level ground leaves the upper half to plants that are not there.
    monkeypatch.setattr(photons, "_ECHO_WIDTHS", (0.3,))
    error, canopies, _ = error_and_canopies()
    assert np.median(error) > 0.5
    assert canopies > 0.3


def test_low_plants_that_hide_their_ground_are_doubtful(monkeypatch):
    """Plants of 1.1 to 1.7 m above a ground that returns a tenth of the light, by night and by day."""
    plants, bare = track(0.0, 0.1, 0.9, base=1.1, top=1.7), track(0.0, 1.0, 0.0)

    def errors_of_good_ones(wave):
        errors = []
        for rate in (1e5, 1e6):
            heights = inversion.photon_ground_and_canopy(events_of(wave, rate), DISTANCE)
            errors.append((heights.ground - GROUND)[heights.quality == "good"])
        return np.concatenate(errors)

    assert np.all(np.abs(errors_of_good_ones(plants)) < 1.0)
    assert errors_of_good_ones(bare).size >= 18
    # Negative control.
    monkeypatch.setattr(photons, "_HIDDEN_ODDS", np.inf)
    assert np.mean(errors_of_good_ones(plants) > 1.0) > 0.5


def test_a_hidden_ground_is_looked_for_with_all_neighbours_at_ends_of_a_track_too():
    """Light from below plants in four segments of twelve, none at the ends."""
    number = np.repeat(np.arange(4, 8), 3)

    def odds(n_segments, number):
        near, background, half_height = (np.full(n_segments, x) for x in (15.0, 0.01, 0.75))
        steps = np.full(number.size, 0.5)
        return photons._odds_of_hidden_ground(steps, number, near, background, half_height)

    of_track = odds(12, number)
    assert np.all(of_track[:4] == of_track[4])
    assert np.all(of_track[-4:] == of_track[-5])
    assert np.all(of_track > photons._HIDDEN_ODDS)
    # Without any light from below there is no ground.
    assert np.all(odds(12, number[:0]) < 0.1)


def test_the_background_is_estimated_from_the_record():
    for rate in (1e5, 1e6, 5e6):
        events = events_of(track(10.0), rate)
        with_true_rate, with_estimate = (
            inversion.photon_ground_and_canopy(events, DISTANCE, background_rate=r).label > 0
            for r in (rate, None)
        )
        assert np.mean(with_true_rate == with_estimate) > 0.97
    # Negative control: a wrong rate lets the noise pass.
    without_background = inversion.photon_ground_and_canopy(events, DISTANCE, background_rate=0.0)
    assert (without_background.label[~events.signal] > 0).mean() > 0.6


def test_too_few_photons_are_nan():
    bare = inversion.photon_ground_and_canopy(events_of(track(0.0, canopy=0.0), 1e5), DISTANCE)
    assert np.all(np.abs(bare.ground - GROUND) < 0.1)
    assert np.all(np.isnan(bare.canopy))
    assert set(bare.label) <= {0, 1, 3}
    dark = events_of(track(0.0, 0.0, 0.0), 0.0)
    noise = events_of(track(0.0, 0.0, 0.0), 2e6)
    for events in (dark, noise):
        heights = inversion.photon_ground_and_canopy(events, DISTANCE)
        assert np.isnan(heights.ground).mean() > 0.8
        assert heights.label.shape == (len(events),)
    # Half of the track without photons has no ground, and does not affect the other half.
    wave = track(0.0)
    wave.energy[SHOTS // 2 :] = 0.0
    half = inversion.photon_ground_and_canopy(events_of(wave, 1e5), DISTANCE)
    assert np.all(np.abs(half.ground[:4] - GROUND) < 0.2)
    assert np.all(np.isnan(half.ground[6:]))
    assert np.all(np.isnan(half.slope) == np.isnan(half.ground))


def test_segments_and_percentiles():
    events = events_of(track(0.0), 1e5)
    coarse = inversion.photon_ground_and_canopy(events, DISTANCE, segment=100.0, percentile=50.0)
    np.testing.assert_allclose(coarse.distance, [50.0, 150.0])
    np.testing.assert_allclose(coarse.canopy, 10.0, atol=0.7)
    repeated = inversion.photon_ground_and_canopy(events, DISTANCE, segment=100.0, percentile=50.0)
    for a, b in zip(coarse, repeated, strict=True):
        np.testing.assert_array_equal(a, b)


def test_percentiles_are_those_of_numpy():
    random = np.random.default_rng(0)
    z, number = random.normal(size=200), random.integers(0, 7, 200)
    percentiles, _ = photons._percentiles(z, number, 9, 98.0, 2)
    for i in range(7):
        np.testing.assert_allclose(percentiles[i], np.percentile(z[number == i], 98.0))
    assert np.all(np.isnan(percentiles[7:]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"distance": DISTANCE[1:]}, r"distance has shape \(285,\); admissible is one for each of the 286"),
        ({"distance": np.zeros(SHOTS)}, "which do not all lie at one place"),
        ({"distance": None}, "distance is None; admissible for PhotonEvents"),
        ({"segment": 0.0}, r"segment = 0 .*\(0, inf\)"),
        ({"percentile": 101.0}, r"percentile = 101 .*\[0, 100\]"),
        ({"background_rate": -1.0}, "background_rate = -1"),
        ({"least": 1}, "least = 1"),
    ],
)
def test_inadmissible_arguments_are_refused(arguments, message):
    events = events_of(track(0.0), 0.0)
    with pytest.raises(ValueError, match=message):
        inversion.photon_ground_and_canopy(events, **{"distance": DISTANCE, **arguments})


def bent_ground(x):
    return 3.0 + 6.0 * np.sin(x / 25.0)


def test_the_ground_bends_and_may_lie_under_a_tall_canopy():
    """A dense canopy 5 to 15 m above a ground that returns a tenth of a photon in each pulse, by day."""
    height = np.arange(80.0, -40.0, -0.1)
    above = height - bent_ground(DISTANCE)[:, None]
    echo = np.exp(-0.5 * (above / 0.15) ** 2)
    layer = ((above > BASE) & (above < TOP)).astype(float)
    photons_per_pulse = sum(n * s / s.sum(axis=1, keepdims=True) for n, s in ((0.5, echo), (1.5, layer)))
    wave = SimpleNamespace(
        time=-2.0 * height / jl.SPEED_OF_LIGHT,
        wavelength=np.array([532.0]),
        energy=photons_per_pulse[:, None] * PLANCK_TIMES_LIGHT / 532.0,
        zenith=np.zeros(SHOTS),
        position=np.zeros((SHOTS, 2)),
    )
    heights = inversion.photon_ground_and_canopy(events_of(wave, 2e6), DISTANCE)
    error = heights.ground - bent_ground(heights.distance)
    assert np.median(np.abs(error)) < 0.2
    assert np.max(np.abs(error[heights.quality == "good"])) < 2.0
    assert np.isfinite(heights.canopy).mean() >= 0.8
    assert len(str(heights).splitlines()) == 11


def test_standard_errors_hold_and_few_photons_are_doubtful():
    errors_in_sigmas = []
    for seed in range(4):
        events = events_of(track(0.0, ground=0.3, canopy=0.0), 2e6, seed)
        heights = inversion.photon_ground_and_canopy(events, DISTANCE)
        has_ground = np.isfinite(heights.ground)
        errors_in_sigmas.append(((heights.ground - GROUND) / heights.ground_stderr)[has_ground])
    assert np.mean(np.abs(np.concatenate(errors_in_sigmas)) < 2.0) > 0.9
    # About two photons of signal in 5 m: many segments still have a ground.
    assert np.concatenate(errors_in_sigmas).size > 20
    # Without any ground, the lower edge of the canopy may count as ground, but not as a good one.
    blocked = inversion.photon_ground_and_canopy(events_of(track(0.0, 0.0, 4.0), 2e6), DISTANCE)
    assert np.all(np.isnan(blocked.ground) | (blocked.ground > GROUND - 1.0))


def test_a_recorded_track_agrees_with_the_product(shared):
    if not (shared / "icesat2").is_dir():
        pytest.skip("the recorded track is not beside this checkout")
    track = jl.io.read_atl03(shared / "icesat2" / "atl03_half.h5")
    product = jl.io.read_atl08(shared / "icesat2" / "atl08_half.h5", segment=20.0)
    heights = inversion.photon_ground_and_canopy(track)
    np.testing.assert_array_equal(heights.segment_id, product["segment_id"])
    ground, canopy = heights.ground - product["ground"], heights.canopy - product["canopy"]
    assert np.nanmedian(np.abs(ground)) < 0.5
    assert np.nanmax(np.abs(ground)) < 2.0
    has_canopy = np.isfinite(product["canopy"])
    assert np.isfinite(heights.canopy[has_canopy]).mean() >= 0.8
    # Ours are without the spread by slope, and three of the product's seven are those of single photons.
    assert np.nanmedian(np.abs(canopy)) < 2.0
    assert heights.label.shape == (len(track),)
    # Canopy is not made of background: few of its photons are those that the product calls noise.
    assert np.mean(track.confidence[heights.label == 2] <= 0) < 0.35
    coarse = inversion.photon_ground_and_canopy(track, segment=100.0)
    assert len(coarse.distance) == 5
    with pytest.raises(ValueError, match="distance is given; admissible for a PhotonTrack is None"):
        inversion.photon_ground_and_canopy(track, track.distance)


def test_short_tracks_and_tracks_without_photons_have_rows_too():
    none = np.zeros(0)
    numbers = {name: none.astype(int) for name in ("pulse", "confidence", "quality", "segment")}
    columns = dict.fromkeys(("distance", "height", "latitude", "longitude", "time", "background_rate"), none)
    rows = dict.fromkeys(
        ("segment_start", "segment_latitude", "segment_longitude", "solar_elevation"), np.zeros(1)
    )
    empty = PhotonTrack(
        beam="gt1r",
        segment_id=np.array([7]),
        segment_length=np.array([20.0]),
        **numbers,
        **columns,
        **rows,
    )
    heights = inversion.photon_ground_and_canopy(empty)
    assert heights.quality.tolist() == ["bad"]
    assert np.isnan(heights.ground[0])
    assert len(heights.label) == 0
    short = inversion.photon_ground_and_canopy(events_of(track(0.0), 1e6), DISTANCE, segment=150.0)
    assert short.quality.tolist() == ["good", "good"]


def sparse_events(random, rate, per_segment, half_window):
    """Events of level ground that returns so few photons in 20 m, under background in events per second."""
    density = 1e-9 * rate * 2.0 / jl.SPEED_OF_LIGHT
    noise = random.poisson(density * 2.0 * half_window, SHOTS)
    signal = random.poisson(per_segment * 0.7 / 20.0, SHOTS)
    heights = random.uniform(-half_window, half_window, noise.sum())
    height = np.r_[heights, GROUND + 0.15 * random.normal(size=signal.sum())]
    shot = np.r_[np.repeat(np.arange(SHOTS), noise), np.repeat(np.arange(SHOTS), signal)]
    order = np.lexsort((-height, shot))
    zeros = np.zeros(order.size, int)
    return PhotonEvents(
        time=-2.0 * height[order] / jl.SPEED_OF_LIGHT,
        height=height[order],
        shot=shot[order],
        pulse=zeros,
        pixel=zeros,
        wavelength=np.full(order.size, 532.0),
        signal=order >= noise.sum(),
        lost=np.zeros((SHOTS, 1), int),
        window=np.tile([-half_window, half_window], (SHOTS, 1)),
        pulses=1,
    )


# Events of background per second, photons of ground in 20 m, and half of the window in m.
SPARSE = {
    "background alone": (5e6, 0.0, 50.0),
    "one photon, by night": (2e4, 1.0, 250.0),
    "one photon": (5e6, 1.0, 50.0),
    "two photons, by night": (2e4, 2.0, 250.0),
    "two photons": (5e6, 2.0, 50.0),
}


def errors_of_good_ones(case, draws):
    """Errors of the ground of the good segments, over draws."""
    errors = []
    for seed in range(draws):
        events = sparse_events(np.random.default_rng(seed), *SPARSE[case])
        heights = inversion.photon_ground_and_canopy(events, DISTANCE)
        errors.append((heights.ground - GROUND)[heights.quality == "good"])
    return np.concatenate(errors)


@pytest.mark.parametrize("case", slow_unless(["background alone"], SPARSE))
def test_a_ground_of_few_photons_that_is_far_off_is_never_good(case):
    assert np.all(np.abs(errors_of_good_ones(case, 40)) < 2.0)


def test_a_ground_of_enough_photons_is_good(monkeypatch):
    """So that the test above does not pass by calling every ground doubtful."""
    monkeypatch.setitem(SPARSE, "ten photons, by night", (2e4, 10.0, 250.0))
    draws = 10
    errors = errors_of_good_ones("ten photons, by night", draws)
    n_segments = len(
        inversion.photon_ground_and_canopy(
            sparse_events(np.random.default_rng(0), *SPARSE["ten photons, by night"]), DISTANCE
        ).quality
    )
    assert errors.size > 0.5 * draws * n_segments
    assert np.all(np.abs(errors) < 2.0)


def test_without_the_number_of_places_a_ground_far_off_is_good(monkeypatch):
    """Negative control: as if the ground had been sought at one place, and fewer photons been asked for."""
    monkeypatch.setattr(photons, "_FALSE_GROUND", 0.05)
    assert np.all(np.abs(errors_of_good_ones("background alone", 20)) < 2.0)
    monkeypatch.setattr(photons, "_FALSE_GOOD", np.inf)
    # Two other rules are off: background below such a ground may be light from a deeper one, and so few
    # photons do not tell the width of an echo.
    monkeypatch.setattr(photons, "_HIDDEN_ODDS", np.inf)
    monkeypatch.setattr(photons, "_FOOT_SIGMAS", 0.0)
    assert np.any(np.abs(errors_of_good_ones("background alone", 20)) > 20.0)
