"""What recorders add to waveforms, planted and found again: offsets, smoothing, noise of a pulse."""

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Recorder, Unknown
from inversion.fit.retrieval import scale_of
from inversion.receiver.recorder import Terms

TIME = np.arange(-40.0, 61.0)
HEIGHT = Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
START = jl.Scene(ground=jl.Ground(height=0.1, reflectance=0.5))
SHOTS = 24
LAG = np.arange(-15.0, 26.0)
POWER = np.where(LAG < 0, np.exp(-0.5 * (LAG / 2.0) ** 2), np.exp(-0.5 * (LAG / 3.5) ** 2))


def shape(pulse, jitter=0.0):
    """A lidar's plan, for the highest ground: flat ground is a few rays."""
    lidar = jl.Lidar(pulse=pulse, jitter=jitter)
    highest = jl.Scene(ground=jl.Ground(height=2.0, reflectance=0.5))
    return jl.plan(
        lidar, highest, max_orders=1, window=(-40.0, 60.0), bin_width=1.0, n_rays=16, footprint="fixed"
    )


def echoes(pulse, heights, jitter=0.0):
    """Clean records of flat ground, of peak one or nearly."""
    shares = np.diff(np.asarray(pulse.cumulative(np.append(TIME - 0.5, TIME[-1] + 0.5), jitter)))
    clean = []
    for height in heights:
        edges = np.append(TIME - 0.5, TIME[-1] + 0.5) + height / 0.149896229
        clean.append(np.diff(np.asarray(pulse.cumulative(edges, jitter))))
    return np.stack(clean) / shares.max()


def fits_of(records, pulses, noise, recorder, near=None, **more):
    """Fits that start near the heights, as echoes tell them."""
    lidars = [jl.Lidar(pulse=pulse) for pulse in pulses]
    more["start"] = {"height": np.broadcast_to(0.0 if near is None else near, len(records)) + 0.05}
    settings = {"scale": (0.01, 1e3), "key": jax.random.key(0), "time": TIME, "plan": shape(pulses[0])}
    return inversion.retrieve_many(
        records[:, None],
        lidars if len(lidars) > 1 else lidars[0],
        START,
        [HEIGHT],
        noise=noise,
        recorder=recorder,
        **settings,
        **more,
    )


def within(z, sigmas=4.5):
    """Whether numbers have mean 0 and variance 1."""
    n = z.size
    return abs(z.mean()) < sigmas / np.sqrt(n) and abs(z.var() - 1.0) < sigmas * np.sqrt(2.0 / n)


@pytest.fixture(scope="module")
def interleaved():
    """Records of a slow receiver with two digitisers, their truths, and the pulse."""
    random, pulse = np.random.default_rng(3), jl.SampledPulse(LAG, POWER)
    height, amplitude = random.uniform(-0.5, 0.5, SHOTS), random.uniform(0.5, 2.0, SHOTS)
    offsets = random.normal(size=(SHOTS, 2)) * 0.1
    clean = amplitude[:, None] * echoes(pulse, height, jitter=1.5)
    records = clean + offsets[:, np.arange(TIME.size) % 2] + 0.01 * random.normal(size=clean.shape)
    return records, pulse, height, offsets


def test_offsets_and_width_are_found_with_errors_as_stated(interleaved):
    records, pulse, height, offsets = interleaved
    recorder = Recorder(width=(0.2, 5.0), offset=(-1.0, 1.0), interleaved=2)
    fits = fits_of(records, [pulse], 0.01, recorder, height)
    assert fits.labels == ("height", "receiver width", "offset[0]", "offset[1]", "scale")
    assert np.all(fits.converged)
    truths = {"height": height, "receiver width": np.full(SHOTS, 1.5), "offset": offsets}
    for name, truth in truths.items():
        assert within(((fits.values[name] - truth) / fits.stderr[name]).ravel()), name
    spread = np.sqrt(2.0 / (TIME.size - 5) / SHOTS)
    assert abs(fits.reduced_chi2.mean() - 1.0) < 4.5 * spread
    # One baseline for both digitisers is refused by the same measure, and so is none.
    for wrong in (Recorder(width=(0.2, 5.0), offset=(-1.0, 1.0)), Recorder(width=(0.2, 5.0))):
        assert fits_of(records, [pulse], 0.01, wrong, height).reduced_chi2.mean() > 1.0 + 45 * spread
    record = recorder.recorded(fits.fitted[0, 0], {name: v[0] for name, v in fits.values.items()})
    chi2 = np.sum(((record - records[0]) / 0.01) ** 2) / (TIME.size - 5)
    assert chi2 == pytest.approx(fits.reduced_chi2[0], rel=1e-3)


def test_an_impulse_is_a_width_of_its_own_shape(interleaved):
    """The same receiver, given as an impulse: nothing is left for a width."""
    records, pulse, height, _ = interleaved
    lag = np.arange(-8.0, 9.0)
    recorder = Recorder(impulse=np.exp(-0.5 * (lag / 1.5) ** 2), offset=(-1.0, 1.0), interleaved=2)
    fits = fits_of(records, [pulse], 0.01, recorder, height)
    assert within((fits.values["height"] - height) / fits.stderr["height"])
    assert abs(fits.reduced_chi2.mean() - 1.0) < 4.5 * np.sqrt(2.0 / (TIME.size - 4) / SHOTS)


@pytest.mark.parametrize(
    "jitter", [0.0, pytest.param(1.5, marks=pytest.mark.slow)], ids=["fast", "slow receiver"]
)
def test_noise_of_the_recorded_pulse_is_noise_of_the_fit(jitter):
    """Of hard ground, seen by a fast receiver, which repeats the pulse's noise, and a slow one, which smooths
    it: reduced chi-squared is one, and height and scale have the errors stated."""
    random = np.random.default_rng(11)
    lag = np.arange(-12.0, 13.0)
    fine = jl.SampledPulse(lag, np.cos(np.pi * lag / 24.0) ** 2)
    height, amplitude = random.uniform(-0.5, 0.5, SHOTS), random.uniform(0.5, 1.0, SHOTS)
    clean = amplitude[:, None] * echoes(fine, height, jitter)
    records = clean + 0.002 * random.normal(size=clean.shape)
    sent = np.diff(np.asarray(fine.cumulative(np.append(lag - 0.5, lag[-1] + 0.5))))
    sent = np.maximum(sent / sent.max() + 0.005 * random.normal(size=(SHOTS, lag.size)), 0.0)
    sent[:, [0, -1]] = 0.0
    pulses = [inversion.recorded_pulse(lag, s, finer=2) for s in sent]
    response = np.exp(-0.5 * (np.arange(-8.0, 9.0) / jitter) ** 2) if jitter else None
    fits = fits_of(records, pulses, 0.002, Recorder(impulse=response, pulse_noise=0.005), height)
    assert np.all(fits.converged)
    assert within((fits.values["height"] - height) / fits.stderr["height"])
    spread = np.sqrt(2.0 / (TIME.size - 2) / SHOTS)
    assert abs(fits.reduced_chi2.mean() - 1.0) < 4.5 * spread
    without = fits_of(records, pulses, 0.002, Recorder(impulse=response), height)
    assert without.reduced_chi2.mean() > fits.reduced_chi2.mean() + 3 * spread
    assert not within((without.values["height"] - height) / without.stderr["height"])


def test_derivatives_are_those_of_differences():
    random = np.random.default_rng(0)
    recorder = Recorder(width=(0.2, 5.0), impulse=[0.2, 1.0, -0.1], offset=(-1.0, 1.0), interleaved=3)
    terms = Terms(recorder, [scale_of((0.1, 10.0), [])], jl.Lidar(), 50)
    own = np.array([1.3, 0.1, -0.2, 0.05, 2.0])
    total, slope = random.normal(size=(2, 50)), random.normal(size=(2, 50, 1))
    found = terms(total, slope, own).jacobian
    step = 1e-5
    for i in range(own.size):
        ahead, behind = (own + sign * step * np.eye(own.size)[i] for sign in (1.0, -1.0))
        difference = (terms(total, slope, ahead).total - terms(total, slope, behind).total) / (2.0 * step)
        np.testing.assert_allclose(found[..., 1 + i], difference, atol=1e-8)
    ahead, behind = (terms(total + sign * step * slope[..., 0], slope, own).total for sign in (1.0, -1.0))
    np.testing.assert_allclose(found[..., 0], (ahead - behind) / (2.0 * step), atol=1e-8)


def test_light_smoothed_out_of_the_window_does_not_come_back():
    total = np.zeros((1, 40))
    total[0, -1] = 1.0
    terms = Terms(Recorder(width=(0.1, 9.0)), [], jl.Lidar(), 40)
    assert np.all(np.abs(terms(total, np.zeros((1, 40, 0)), np.array([3.0])).total[0, :20]) < 1e-6)


@pytest.mark.slow
def test_one_fit_is_as_of_many(interleaved):
    records, pulse, height, _ = interleaved
    recorder = Recorder(width=(0.2, 5.0), offset=(-1.0, 1.0), interleaved=2, pulse_noise=0.005)
    many = fits_of(records[:1], [pulse], 0.01, recorder, height[0])
    settings = {"time": TIME, "plan": shape(pulse), "key": jax.random.fold_in(jax.random.key(0), 0)}
    one = inversion.retrieve(
        records[0],
        jl.Lidar(pulse=pulse),
        jl.Scene(ground=jl.Ground(height=float(height[0]) + 0.05, reflectance=0.5)),
        [HEIGHT],
        noise=0.01,
        scale=(0.01, 1e3),
        recorder=recorder,
        **settings,
    )
    for name, value in one.values.items():
        np.testing.assert_allclose(many.values[name][0], value, rtol=1e-3, atol=1e-4)


def test_checkpoints_know_their_recorder(interleaved, tmp_path):
    records, pulse, *_ = interleaved
    path = tmp_path / "fits.sqlite"
    recorder = Recorder(offset=(-1.0, 1.0))
    first = fits_of(records[:2], [pulse], 0.01, recorder, path=path)
    again = fits_of(records[:2], [pulse], 0.01, recorder, path=path)
    np.testing.assert_array_equal(first.values["offset"], again.values["offset"])
    with pytest.raises(ValueError, match="recorder"):
        fits_of(records[:2], [pulse], 0.01, Recorder(offset=(-1.0, 1.0), pulse_noise=0.1), path=path)


def test_a_receiver_is_found_from_hard_targets():
    """A response with an undershoot, from noisy echoes at random places."""
    random = np.random.default_rng(2)
    true = np.array([0.3, 0.1, 0.3, -0.1, 0.0, 0.4])
    places = 20.0 + random.uniform(0.0, 1.0, 40)
    wide = np.arange(-3.0, 3.0)
    records = []
    for place in places:
        parts = [
            w * np.exp(-0.5 * ((np.arange(70.0) - place - lag) / 1.7) ** 2) for lag, w in zip(wide, true)
        ]
        records.append(sum(parts) + 0.3 + 0.003 * random.normal(size=70))
    pulse = np.exp(-0.5 * (np.arange(-9.0, 10.0) / 1.7) ** 2)
    noise = [np.full(70, 0.003)] * 40
    found = inversion.receiver_impulse([pulse] * 40, records, noise=noise, before=4, after=4)
    assert found.shape == (9,)
    assert found.sum() == pytest.approx(1.0)
    # Pulses smooth the response; so smoothed, the two agree but for a delay, and one pulse alone does not.
    sample, one = np.arange(27.0), np.convolve(pulse, np.append(true, [0.0, 0.0, 0.0]))

    def away(response):
        echo = np.convolve(pulse, response)
        delays = np.arange(-2.0, 2.0, 0.02)
        return min(np.max(np.abs(np.interp(sample - d, sample, one) - echo)) for d in delays)

    assert away(found) < 0.06
    assert away(np.eye(9)[4]) > 0.1


def test_a_recorded_pulse_is_recorded_as_it_was():
    time = np.arange(-8.0, 9.0)
    power = np.exp(-0.5 * (time / 1.7) ** 2)
    edges = np.append(time - 0.5, time[-1] + 0.5)

    def away(pulse):
        shares = np.diff(np.asarray(pulse.cumulative(edges)))
        return np.max(np.abs(shares / shares.sum() * power.sum() - power))

    assert away(inversion.recorded_pulse(time, power)) < 1e-3
    # What sampling does a second time.
    assert away(jl.SampledPulse(time, power)) > 0.03


def test_amplitudes_of_tables_in_decibels():
    """A straight line from a pedestal of two counts, in decibels: noise about the pedestal keeps its mean."""
    decibels = np.where(np.arange(100) < 4, -2e37, 10 * np.log10(np.maximum(np.arange(100) - 2, 1) / 7))
    found = inversion.amplitudes(np.array([0, 2, 9, 99]), decibels, noise=0.7, decibels=True)
    np.testing.assert_allclose(found.values, [-2 / 7, 0.0, 1.0, 97 / 7], atol=1e-9)
    np.testing.assert_allclose(found.noise, [0.1, 0.1, 0.1, np.inf])
    assert inversion.amplitudes(np.array([3, 9]), noise=1.0, saturation=9).noise.tolist() == [1.0, np.inf]


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"width": (-1.0, 2.0)}, "width"),
        ({"width": (2.0, 1.0)}, "not low < high"),
        ({"offset": 3.0}, "not a pair"),
        ({"interleaved": 2}, "offset = None"),
        ({"interleaved": 0, "offset": (0.0, 1.0)}, "interleaved = 0"),
        ({"impulse": [1.0, 2.0]}, "odd number"),
        ({"correlation": 1.0}, "correlation"),
        ({"impulse": [1.0, -2.0, 1.0]}, "sum of impulse"),
        ({"pulse_noise": -0.1}, "pulse_noise = -0.1"),
    ],
)
def test_bad_recorders_are_refused(settings, says):
    with pytest.raises(ValueError, match=says):
        Recorder(**settings)


def test_other_bad_input_is_refused():
    with pytest.raises(ValueError, match="increases"):
        inversion.amplitudes([1], [0.0, 2.0, 1.0], noise=1.0)
    with pytest.raises(ValueError, match="counts = 5"):
        inversion.amplitudes([5], [0.0, 2.0, 3.0], noise=1.0)
    with pytest.raises(ValueError, match="as many"):
        inversion.receiver_impulse([], [], noise=[])
    with pytest.raises(ValueError, match="uneven steps"):
        inversion.recorded_pulse([0.0, 1.0, 3.0], [0.0, 1.0, 0.0])
    taken = Unknown("ground.height", bounds=(-2.0, 2.0), name="offset")
    with pytest.raises(ValueError, match="taken by the recorder"):
        inversion.retrieve(
            np.zeros(TIME.size),
            jl.Lidar(),
            START,
            [taken],
            noise=1.0,
            time=TIME,
            key=jax.random.key(0),
            recorder=Recorder(offset=(-1.0, 1.0)),
        )


def test_correlated_noise_is_noise_of_the_fit():
    """Standard errors and chi-squared are as stated; taken as independent they are not."""
    random, pulse, rho = np.random.default_rng(11), jl.SampledPulse(LAG, POWER), 0.6
    height = random.uniform(-0.5, 0.5, SHOTS)
    root = np.linalg.cholesky(rho ** np.abs(np.subtract.outer(TIME, TIME)))
    records = echoes(pulse, height) + 0.02 * random.normal(size=(SHOTS, TIME.size)) @ root.T
    settings = {"offset": (-1.0, 1.0)}
    fits = fits_of(records, [pulse], 0.02, Recorder(correlation=rho, **settings), height)
    assert np.all(fits.converged)
    for name, truth in (("height", height), ("offset", np.zeros(SHOTS))):
        assert within((fits.values[name] - truth) / fits.stderr[name]), name
    assert fits.reduced_chi2.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / (TIME.size * SHOTS)))
    without = fits_of(records, [pulse], 0.02, Recorder(**settings), height)
    assert not within(without.values["offset"] / without.stderr["offset"])


def shots_of_a_compressed_digitiser(random, count=60):
    """Counts of pulses and of a slow receiver's echoes, both compressed above 110 counts, and the light."""
    lag, tail = np.arange(-12.0, 13.0), np.array([0.1, 0.7, 0.3, -0.1, 0.02])
    pulses, found = [], []
    for strength in random.uniform(60.0, 190.0, count):
        at = random.uniform(-0.5, 0.5, 2)
        pulse = 150.0 * np.exp(-0.5 * ((lag - at[0]) / 1.7) ** 2)
        light = np.convolve(np.exp(-0.5 * ((np.arange(-30.0, 31.0) - at[1]) / 1.7) ** 2), tail, "same")
        pulses.append(np.round(compressed(pulse + 3.0) + 0.3 * random.normal(size=pulse.size).clip(-2, 2)))
        own = compressed(strength * light / light.max() + 3.0)
        found.append(np.maximum(np.round(own + 0.5 * random.normal(size=own.size)), 0.0))
    return [np.maximum(p, 0.0) for p in pulses], found


def compressed(light):
    return np.where(light > 110.0, 110.0 + 0.7 * (light - 110.0), light)


def test_a_corrected_table_undoes_what_the_table_does_not_know():
    """Within 2 % of the light, where the table as it is is off by more than 10 %."""
    table, more = np.arange(256.0), {"noise": 0.5, "knots": [100.0, 115.0, 130.0, 145.0, 160.0]}
    pulses, found = shots_of_a_compressed_digitiser(np.random.default_rng(4))
    corrected = inversion.corrected_table(table, pulses, found, **more)
    light = np.linspace(50.0, 180.0, 50)
    read = np.interp(compressed(light), table, corrected)
    np.testing.assert_allclose(read, light, rtol=0.02)
    assert np.max(np.abs(compressed(light) / light - 1.0)) > 0.1
    assert np.all(np.diff(corrected) > 0)


def test_bad_tables_are_refused():
    counts = [np.arange(20.0)]
    more = {"noise": 0.5, "knots": [10.0, 20.0]}
    for changes, says in (
        ({"pulses": []}, "pulses and echoes are 0 and 1"),
        ({"knots": [20.0, 10.0]}, "knots"),
        ({"noise": 0.0}, "noise"),
        ({"echoes": [np.array([300.0])]}, "echoes"),
    ):
        given = {"pulses": counts, "echoes": counts, **more, **changes}
        with pytest.raises(ValueError, match=says):
            inversion.corrected_table(np.arange(256.0), **given)
