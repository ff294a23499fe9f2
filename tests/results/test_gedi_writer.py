"""Writer of GEDI level 1B files: values, positions, layout and noise of shots, and bad arguments."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxlidar as jl
from inversion import gedi_metrics
from jaxlidar.io import read_gedi_l1b, write_gedi_l1b

h5py = pytest.importorskip("h5py")
rasterio = pytest.importorskip("rasterio")

RECORD = "GEDI01_B_2019108080338_O01964_T05337_02_003_01_sub.h5"
LIDAR = jl.Lidar(altitude=4e5, pulse=jl.GaussianPulse(fwhm=15.6), divergence=0.0625, aperture=0.8)
SCENE = jl.Scene(
    ground=jl.Ground(height=2.0, reflectance=0.4, slope=3.0, aspect=90.0),
    plates=(jl.Plate(height=14.0, reflectance=0.3, coverage=0.4),),
)
# Semi-major axis (m) and squared eccentricity of the WGS-84 ellipsoid.
A, E2 = 6378137.0, 0.00669437999014
# Two ways to place a scene on the Earth: by its origin (longitude, latitude), or by a projection.
GEOGRAPHIC_PLACE = {"origin": (-72.18, 42.54), "elevation": 340.0}
PROJECTED_PLACE = {"crs": "EPSG:32633", "elevation": 340.0}
BEAMS = ["BEAM0101", "BEAM0000", "BEAM0101", "BEAM1011"]


@pytest.fixture(scope="module")
def survey():
    position = [(0.0, 0.0), (60.0, 0.0), (120.0, 30.0), (-50.0, 700.0)]
    return jl.Survey(LIDAR, position=position, zenith=[0.0, 1.0, 1.5, 0.5], azimuth=[0.0, 30.0, 200.0, 300.0])


@pytest.fixture(scope="module")
def waveforms(survey):
    return jl.simulate_many(survey, SCENE, key=jax.random.key(1), max_orders=1)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "simulated.h5"


def shots_in_survey_order(path):
    """Return the shots of a file in the order of the survey, by the last digits of their numbers."""
    return sorted(read_gedi_l1b(path), key=lambda shot: shot.shot_number % 10**8)


def test_shots_are_read_as_they_were_simulated(waveforms, survey, path):
    digitiser = {"gain": 2e4, "noise_mean": 210.0, "noise_std": 2.5}
    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE, **digitiser, beam=BEAMS, margin=0)
    assert [shot.beam for shot in read_gedi_l1b(path)] == sorted(BEAMS)
    for i, shot in enumerate(shots_in_survey_order(path)):
        assert shot.beam == BEAMS[i]
        assert shot.shot_number == 10**13 + int(shot.beam[4:], 2) * 10**11 + i + 1
        assert (shot.noise_mean, shot.noise_std, shot.degrade, shot.stale_return) == (210.0, 2.5, 0, 0)
        # Counts are proportional to energy, which falls with the square of the range: by 7e-5 over the 14 m
        # between the plate and the reference plane.
        counts = 210.0 + 2e4 * waveforms.reflectance[i, 0]
        np.testing.assert_allclose(shot.waveform, counts, rtol=1e-4)
        assert np.ptp(shot.waveform) > 100
        np.testing.assert_allclose(shot.elevation, 340.0 + np.asarray(waveforms[i].height), atol=1e-4)
        assert shot.zenith == pytest.approx(survey.zenith[i], abs=1e-5)
        assert shot.altitude == 400340.0
        pulse = jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)
        assert float(pulse.mean) == pytest.approx(0.0, abs=1e-4)
        # Samples are means over 1 ns, which adds 1/12 ns2 to the variance, and `SampledPulse` interpolates
        # linearly between them, which adds 1/6 ns2.
        assert float(pulse.std) ** 2 == pytest.approx(float(LIDAR.pulse.std) ** 2 + 1 / 12 + 1 / 6, rel=1e-4)


def test_a_list_of_waveforms_makes_the_same_file(waveforms, survey, path, tmp_path):
    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE, key=jax.random.key(2))
    write_gedi_l1b(tmp_path / "list.h5", list(waveforms), survey, **GEOGRAPHIC_PLACE, key=jax.random.key(2))
    with h5py.File(path) as file, h5py.File(tmp_path / "list.h5") as file_of_list:
        datasets = []
        file.visititems(lambda name, node: datasets.append(name) if isinstance(node, h5py.Dataset) else None)
        # One beam, of more than 50 datasets.
        assert len(datasets) > 50
        assert all(np.array_equal(file[name], file_of_list[name]) for name in datasets)


def test_waveforms_in_parts_make_the_same_file(waveforms, survey, path, tmp_path):
    """Parts of a survey may have time axes of their own: here all have the axis of the whole."""
    parts = [
        jax.tree.map(lambda a, rows=rows: a[rows] if len(a) == 4 else a, waveforms)
        for rows in (slice(3), slice(3, 4))
    ]
    assert [len(part) for part in parts] == [3, 1]
    noise = {"key": jax.random.key(2)}
    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE, **noise)
    write_gedi_l1b(tmp_path / "parts.h5", parts, survey, **GEOGRAPHIC_PLACE, **noise)
    for shot, other in zip(read_gedi_l1b(path), read_gedi_l1b(tmp_path / "parts.h5"), strict=True):
        assert np.array_equal(shot.waveform, other.waveform)
        assert np.array_equal(shot.elevation, other.elevation)
    with pytest.raises(ValueError, match="waveforms 0: they have another position"):
        write_gedi_l1b(path, parts[::-1], survey, **GEOGRAPHIC_PLACE)
    with pytest.raises(ValueError, match="3 waveforms are of a survey of 4"):
        write_gedi_l1b(path, parts[:1], survey, **GEOGRAPHIC_PLACE)


def test_waveforms_of_different_lengths_and_a_rectangular_pulse(waveforms, path):
    bins, second = slice(20, 150), waveforms[1]
    shortened = {name: getattr(second, name)[:, bins] for name in ("reflectance", "recorded")}
    waves = [waveforms[0], dataclasses.replace(second, time=second.time[bins], **shortened)]
    lidar = dataclasses.replace(LIDAR, pulse=jl.RectangularPulse(length=90.0))
    survey = jl.Survey(lidar, waveforms.position[:2], waveforms.zenith[:2])
    write_gedi_l1b(path, waves, survey, **GEOGRAPHIC_PLACE, shot_number=[7, 2**60])
    for shot, wave in zip(read_gedi_l1b(path, [7, 2**60]), waves, strict=True):
        # A margin of 200 bins on both sides is the default.
        assert shot.time.size == wave.time.size + 2 * 200
        assert shot.signal.sum() == pytest.approx(float(50_000 * wave.reflectance.sum()), rel=2e-4)
        assert shot.elevation[0] == pytest.approx(340.0 - 0.149896229 * (float(wave.time[0]) - 200), abs=1e-2)
        assert shot.pulse_power.sum() == pytest.approx(90 * shot.pulse_power.max(), rel=1e-4)


def test_background_is_part_of_the_pedestal(waveforms, survey, path):
    """Counts are the gain times the energy in units of E eta A / (pi R^2), also those of margins."""
    lidar = dataclasses.replace(LIDAR, receiver=jl.Receiver(background=1e-16), energy=0.01)
    sunlit_survey = jl.Survey(lidar, survey.position, survey.zenith, survey.azimuth)
    sunlit = dataclasses.replace(waveforms, recorded=np.full_like(waveforms.recorded, 1e-16))
    write_gedi_l1b(path, sunlit, sunlit_survey, **GEOGRAPHIC_PLACE)
    for shot, zenith in zip(shots_in_survey_order(path), np.deg2rad(survey.zenith), strict=True):
        counts = 240.0 + 50_000 * 1e-16 / (0.01 * 0.4**2 * np.cos(zenith) ** 2 / 4e5**2)
        assert shot.noise_mean == pytest.approx(counts, rel=1e-6)
        assert counts > 250.0
        np.testing.assert_allclose(shot.waveform, counts, rtol=1e-6)


def test_datasets_have_the_layout_of_the_product(waveforms, survey, path, shared):
    """Every dataset has the name, type and number of axes of the same dataset in a recorded file."""
    if not (shared / "gedi" / RECORD).is_file():
        pytest.skip("the recorded GEDI file is not beside this checkout")
    beams = ["BEAM0001", "BEAM0010", "BEAM0101", "BEAM1011"]
    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE, beam=beams)
    with h5py.File(path) as file, h5py.File(shared / "gedi" / RECORD) as product:
        assert file.attrs["short_name"] == product.attrs["short_name"]
        # Beams without shots are left out.
        assert set(file) == {*beams, "METADATA"}
        for name in beams:
            assert file[name].attrs["description"] == product[name].attrs["description"]
            for field in ("beam", "channel"):
                assert {int(product[f"{name}/{field}"][0])} >= set(file[f"{name}/{field}"][:].tolist())

        def compare(name, node):
            if isinstance(node, h5py.Dataset):
                assert (node.dtype, node.ndim) == (product[f"BEAM0101/{name}"].dtype, 1), name
            else:
                assert name in ("geolocation", "geophys_corr")

        for name in set(file) - {"METADATA"}:
            file[name].visititems(compare)


def test_records_can_be_read_as_rgedi_and_pygedi_do(waveforms, survey, path):
    """These tools read all groups, and find records by indices that start at 1 and by their lengths."""
    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE, beam=BEAMS)
    records = {}
    with h5py.File(path) as file:
        groups = [name for name in file if name.startswith("BEAM")]
        assert groups == sorted(set(BEAMS))
        for name in groups:
            group = file[name]
            numbers = group["shot_number"][:]
            assert np.array_equal(numbers, group["geolocation/shot_number"][:])
            for i, number in enumerate(numbers):
                start = int(group["rx_sample_start_index"][i] - group["rx_sample_start_index"][:].min())
                count = int(group["rx_sample_count"][i])
                record = group["rxwaveform"][start : start + count]
                signal = record.sum(dtype=float) - count * group["noise_mean_corrected"][i]
                assert group["rx_energy"][i] == pytest.approx(signal)
                records[int(number)] = record
    shots = read_gedi_l1b(path)
    assert len(shots) == len(records) == 4
    assert all(np.array_equal(shot.waveform, records[shot.shot_number]) for shot in shots)


def test_what_readers_of_the_product_open_is_there(waveforms, survey, path):
    """The relation of times, and the moments of the extended Gaussian, are those of recorded files."""
    sun = [10.0, -20.0, 30.0, 40.0]
    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE, solar_elevation=sun)
    with h5py.File(path) as file:
        group = file["BEAM0101"]
        assert group["geolocation/solar_elevation"][:].tolist() == sun
        assert np.all(group["geolocation/digital_elevation_model"][:] == 340.0)
        assert not group["geophys_corr/tide_earth"][:].any()
        seconds = group["master_int"][:] + group["master_frac"][:]
        np.testing.assert_allclose(seconds, group["delta_time"][:])
        first = group["rx_open"][:].astype(float) + group["rx_offset"][:] - group["tx_gloc"][:]
        np.testing.assert_allclose(first, 2e9 * group["geolocation/bounce_time_offset_bin0"][:], atol=0.6)
        start, count = (int(group[f"rx_sample_{name}"][1]) for name in ("start_index", "count"))
        samples = group["rxwaveform"][start - 1 : start - 1 + count]
        assert group["all_samples_sum"][1] == pytest.approx(samples.sum(dtype=float), abs=1)
        # A Gaussian pulse of 15.6 ns: its area, its width, and no tail to speak of.
        sigma = 15.6 / np.sqrt(8 * np.log(2))
        assert group["tx_egsigma"][0] == pytest.approx(sigma, rel=0.01)
        assert group["tx_egamplitude"][0] == pytest.approx(1000 * sigma * np.sqrt(2 * np.pi), rel=0.01)
        assert group["tx_eggamma"][0] > 5 / sigma
    assert [shot.solar_elevation for shot in shots_in_survey_order(path)] == sun


def test_the_info_command_describes_a_file(waveforms, survey, path, capsys):
    from jaxlidar import cli

    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE, beam=BEAMS)
    assert cli.main(["info", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "4 GEDI shots of BEAM0000, BEAM0101, BEAM1011"
    assert lines[1].startswith("latitude ")


def test_the_level_2_algorithm_detects_the_simulated_ground(waveforms, survey, path):
    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE, key=jax.random.key(3))
    metrics = gedi_metrics(shots_in_survey_order(path))
    assert np.all(np.abs(metrics.elev_lowestmode - (340.0 + waveforms.ground_height)) < 0.1)
    assert metrics.num_detectedmodes.tolist() == [2] * 4
    # The pulse spreads the echo of the plate, so that half of it appears above the plate.
    assert np.all(np.abs(metrics.rh[:, 98] - (14.0 - waveforms.ground_height)) < 3.0)


def test_positions_lie_on_the_ellipsoid(survey, waveforms, path):
    """Degrees become metres by the radii of curvature at the origin: along the meridian and across it."""
    write_gedi_l1b(path, waveforms, survey, **GEOGRAPHIC_PLACE)
    latitude = np.deg2rad(42.54)
    w = 1 - E2 * np.sin(latitude) ** 2
    metres_north, metres_east = A * (1 - E2) / w**1.5, A / np.sqrt(w) * np.cos(latitude)
    slope = np.tan(np.deg2rad(survey.zenith))[:, None]
    # Horizontal direction in which the light travels downwards.
    heading = np.stack([np.sin(np.deg2rad(survey.azimuth)), np.cos(np.deg2rad(survey.azimuth))], 1)
    with h5py.File(path) as file:
        geolocation = {name: node[:] for name, node in file["BEAM0101/geolocation"].items()}
    for name in ("bin0", "lastbin"):
        height = (geolocation[f"elevation_{name}"] - 340.0)[:, None]
        x, y = (survey.position - height * slope * heading).T
        assert np.abs(np.deg2rad(geolocation[f"longitude_{name}"] + 72.18) * metres_east - x).max() < 0.2
        assert np.abs(np.deg2rad(geolocation[f"latitude_{name}"] - 42.54) * metres_north - y).max() < 0.2
        # The offset is the time from the sensor to the bin, one way.
        drop = geolocation["altitude_instrument"] - geolocation[f"elevation_{name}"]
        distance = drop / np.cos(np.arctan(slope[:, 0]))
        offset = geolocation[f"bounce_time_offset_{name}"]
        np.testing.assert_allclose(offset * 299792458.0, distance, rtol=1e-9)
    # The azimuth of the product points from the ground to the sensor.
    azimuth = geolocation["local_beam_azimuth"]
    np.testing.assert_allclose(np.stack([np.sin(azimuth), np.cos(azimuth)], 1), -heading, atol=3e-4)
    longitude, latitude = geolocation["longitude_instrument"], geolocation["latitude_instrument"]
    degrees = np.stack([longitude + 72.18, latitude - 42.54], 1)
    sensor_offset = np.deg2rad(degrees) * [metres_east, metres_north] - survey.position
    np.testing.assert_allclose(np.hypot(*sensor_offset.T), 4e5 * slope[:, 0], rtol=5e-3, atol=0.2)


def test_azimuths_of_projected_surveys_are_relative_to_true_north(waveforms, path):
    position = waveforms.position + np.array([700_000.0, 5_550_000.0])
    survey = jl.Survey(LIDAR, position=position, zenith=waveforms.zenith, azimuth=waveforms.azimuth)
    write_gedi_l1b(path, dataclasses.replace(waveforms, position=position), survey, **PROJECTED_PLACE)
    for shot, grid_azimuth in zip(shots_in_survey_order(path), waveforms.azimuth, strict=True):
        # Transverse Mercator projection: tan(convergence) = tan(longitude - 15 degrees) sin(latitude).
        latitude, longitude = np.deg2rad([shot.latitude, shot.longitude - 15.0])
        convergence = np.rad2deg(np.arctan(np.tan(longitude) * np.sin(latitude)))
        assert convergence == pytest.approx(2.2, abs=0.1)
        difference = (shot.azimuth - grid_azimuth - convergence + 180.0) % 360.0 - 180.0
        assert difference == pytest.approx(0.0, abs=0.02)


def noise_of(shots, noise_mean):
    """Return the waveforms of shots without light, less the pedestal."""
    return np.stack([shot.waveform - noise_mean for shot in shots])


def test_noise_has_the_statistics_of_the_product(waveforms, survey, path):
    """It has the standard deviation and autocorrelation of recorded noise; shots have independent noise."""
    recorded = np.zeros((4, 1, 4000), np.float32)
    dark = dataclasses.replace(waveforms, time=np.arange(4000.0), recorded=recorded)
    write_gedi_l1b(path, dark, survey, **GEOGRAPHIC_PLACE, key=jax.random.key(5), noise_std=3.0)
    noise = noise_of(shots_in_survey_order(path), 240.0)
    assert np.abs(np.corrcoef(noise)[np.triu_indices(4, 1)]).max() < 0.15
    assert noise.std() == pytest.approx(0.407 * 3.0, rel=0.03)
    power = (noise**2).mean()
    lagged = [(noise[:, lag:] * noise[:, : noise.shape[1] - lag]).mean() / power for lag in range(1, 6)]
    # Autocorrelations that were measured in recorded shots; those of white noise would be 0.
    np.testing.assert_allclose(lagged, [0.92, 0.71, 0.45, 0.21, 0.1], atol=0.05)
    write_gedi_l1b(path, dark, survey, **GEOGRAPHIC_PLACE)
    assert not noise_of(shots_in_survey_order(path), 240.0).any()


def test_an_origin_does_not_place_a_survey_of_map_coordinates(waveforms, survey, path):
    mapped = dataclasses.replace(survey, crs="EPSG:32633")
    with pytest.raises(ValueError, match=r"origin = .* with survey.crs = 'EPSG:32633'; admissible is either"):
        write_gedi_l1b(path, waveforms, mapped, **GEOGRAPHIC_PLACE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origin": None}, r"origin = None and crs = None: give one of them"),
        ({"crs": "EPSG:32633"}, "give one of them"),
        ({"origin": (14.0, 95.0)}, r"latitude of origin = 95 .*\[-90, 90\]"),
        ({"origin": None, "crs": "EPSG:4326"}, "crs = 'EPSG:4326' is not in metres"),
        ({"origin": None, "crs": "EPSG:2263"}, "crs = 'EPSG:2263' is not in metres"),
        ({"origin": None, "crs": "nowhere"}, "crs = 'nowhere' is not known"),
        ({"elevation": [1.0, 2.0]}, r"elevation has shape \(2,\).*\(4,\)"),
        ({"elevation": np.nan}, "elevation = nan"),
        ({"beam": "BEAM1111"}, "beam = 'BEAM1111' .*'BEAM1011'"),
        ({"beam": ["BEAM0101"]}, r"beam has shape \(1,\)"),
        ({"gain": 0.0}, "gain = 0"),
        ({"gain": 1e12}, r"gain: shot 0 has .* counts; admissible are up to 1e\+09"),
        ({"margin": -1}, "margin = -1"),
        ({"noise_std": -1.0}, "noise_std = -1"),
        ({"shot_number": [1, 2, 2, 3]}, "shot_number = 2 is that of 2 shots"),
        ({"shot_number": np.array([1.0, 2.0, 3.0, 4.0])}, "shot_number has the type float64"),
    ],
)
def test_bad_arguments_are_refused_and_the_old_file_remains(waveforms, survey, path, change, message):
    path.write_text("old")
    with pytest.raises(ValueError, match=message):
        write_gedi_l1b(path, waveforms, survey, **{**GEOGRAPHIC_PLACE, **change})
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    assert path.read_text() == "old"


def test_waveforms_that_the_product_cannot_hold_are_refused(waveforms, survey, path):
    def assert_refused(message, waves=waveforms, survey=survey, error=ValueError):
        with pytest.raises(error, match=message):
            write_gedi_l1b(path, waves, survey, **GEOGRAPHIC_PLACE)

    def changed(**fields):
        return dataclasses.replace(waveforms, **fields)

    assert_refused(r"4 waveforms are of a survey of 2 shots", survey=survey[:2])
    assert_refused("another position", survey=jl.Survey(LIDAR, position=waveforms.position + 1.0))
    assert_refused(r"samples are 2 ns apart; admissible is 1 ns", changed(time=2 * waveforms.time))
    assert_refused("2 wavelengths; admissible is one", changed(wavelength=np.array([532.0, 1064.0])))
    assert_refused("70000 bins; admissible are 2 to 65135", changed(time=np.arange(70_000.0)))
    recorded = waveforms.recorded.copy()
    recorded[2, 0, 3] = np.nan
    assert_refused("recorded of shot 2 = nan", changed(recorded=recorded))
    assert_refused("waveforms 1 is .* admissible is a Waveform", [waveforms[0], 1, 2, 3], error=TypeError)
    assert not list(path.parent.iterdir())


@pytest.mark.parametrize("from_file", [False, True])
@pytest.mark.parametrize("one_by_one", [False, True])
def test_waveforms_of_another_survey_are_refused(waveforms, survey, path, tmp_path, from_file, one_by_one):
    """By what they know of their lidar, in memory and from files."""

    def stored(waves, name):
        waves.save(tmp_path / f"{name}.nc")
        return jl.open(tmp_path / f"{name}.nc")

    waves = list(waveforms) if one_by_one else waveforms
    if from_file:
        waves = [stored(w, f"{i}") for i, w in enumerate(waves)] if one_by_one else stored(waveforms, "all")

    def refused(says, zenith=survey.zenith, azimuth=survey.azimuth, **changes):
        another = jl.Survey(dataclasses.replace(LIDAR, **changes), survey.position, zenith, azimuth)
        with pytest.raises(ValueError, match=says):
            write_gedi_l1b(path, waves, another, **GEOGRAPHIC_PLACE)
        assert not path.exists()

    refused("of altitude 400000 m, that of the survey has 401000 m", altitude=401_000.0)
    refused("of wavelength 1064 nm, that of the survey has 1065 nm", wavelength=1065.0)
    tilted = np.array([0.0, 1.0, 1.5, 1.5])
    if one_by_one:
        refused(r"waveforms 3: its heights are those of the zenith 0\.5\d* degrees, .* has 1\.5", tilted)
    else:
        refused(r"shot 3 has the zenith 0\.5 degrees, that of the survey 1\.5 degrees", tilted)
        turned = survey.azimuth + np.array([90.0, 0.0, 10.0, 0.0])
        refused("shot 2 has the azimuth 200 degrees, that of the survey 210 degrees", azimuth=turned)
    # The azimuth of a vertical beam, and whole turns, change nothing.
    same = jl.Survey(
        LIDAR, survey.position, survey.zenith, survey.azimuth + np.array([90.0, 360.0, 0.0, -360.0])
    )
    write_gedi_l1b(path, waves, same, **GEOGRAPHIC_PLACE)
    assert len(read_gedi_l1b(path)) == 4


def test_a_single_waveform_of_another_lidar_is_refused(path):
    wave = jl.simulate(LIDAR, SCENE, key=jax.random.key(0), max_orders=1)
    low = jl.Survey.of(dataclasses.replace(LIDAR, altitude=3e5))
    with pytest.raises(
        ValueError, match="waveforms 0: they are of a lidar of altitude 400000 m, that of the"
    ):
        write_gedi_l1b(path, [wave], low, **GEOGRAPHIC_PLACE)
    # What does not have its altitude, as in files of earlier versions, is written.
    bare = dataclasses.replace(wave, info={})
    write_gedi_l1b(path, [bare], low, **GEOGRAPHIC_PLACE)
    assert read_gedi_l1b(path)[0].altitude == 300340.0
