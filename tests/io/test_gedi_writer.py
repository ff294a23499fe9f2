"""Simulated shots in the layout of GEDI's level 1B: what is read back, where it lies, what tools find."""

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
# Of the WGS-84 ellipsoid.
A, E2 = 6378137.0, 0.00669437999014
HERE = {"origin": (-72.18, 42.54), "elevation": 340.0}
ELSEWHERE = {"crs": "EPSG:32633", "elevation": 340.0}
BEAM_OF = ["BEAM0101", "BEAM0000", "BEAM0101", "BEAM1011"]


@pytest.fixture(scope="module")
def survey():
    place = [(0.0, 0.0), (60.0, 0.0), (120.0, 30.0), (-50.0, 700.0)]
    return jl.Survey(LIDAR, position=place, zenith=[0.0, 1.0, 1.5, 0.5], azimuth=[0.0, 30.0, 200.0, 300.0])


@pytest.fixture(scope="module")
def many(survey):
    return jl.simulate_many(survey, SCENE, key=jax.random.key(1), max_orders=1)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "simulated.h5"


def by_shot(path):
    """The shots of a file in the order of the survey: by the last digits of their numbers."""
    return sorted(read_gedi_l1b(path), key=lambda shot: shot.shot_number % 10**8)


def test_what_is_read_is_what_was_simulated(many, survey, path):
    light = {"gain": 2e4, "noise_mean": 210.0, "noise_std": 2.5}
    write_gedi_l1b(path, many, survey, **HERE, **light, beam=BEAM_OF, margin=0)
    assert [shot.beam for shot in read_gedi_l1b(path)] == sorted(BEAM_OF)
    for i, shot in enumerate(by_shot(path)):
        assert shot.beam == BEAM_OF[i]
        assert shot.shot_number == 10**13 + int(shot.beam[4:], 2) * 10**11 + i + 1
        assert (shot.noise_mean, shot.noise_std, shot.degrade, shot.stale_return) == (210.0, 2.5, 0, 0)
        # Between light from 14 m above and the reference plane, energies differ by 7e-5.
        counts = 210.0 + 2e4 * many.reflectance[i, 0]
        np.testing.assert_allclose(shot.waveform, counts, rtol=1e-4)
        assert np.ptp(shot.waveform) > 100
        np.testing.assert_allclose(shot.elevation, 340.0 + np.asarray(many[i].height), atol=1e-4)
        assert shot.zenith == pytest.approx(survey.zenith[i], abs=1e-5)
        assert shot.altitude == 400340.0
        pulse = jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)
        assert float(pulse.mean) == pytest.approx(0.0, abs=1e-4)
        # Samples are energies of 1 ns, and lines join them: 1/12 and 1/6 ns2 more.
        assert float(pulse.std) ** 2 == pytest.approx(float(LIDAR.pulse.std) ** 2 + 1 / 12 + 1 / 6, rel=1e-4)


def test_the_same_from_single_waveforms_to_the_bit(many, survey, path, tmp_path):
    write_gedi_l1b(path, many, survey, **HERE, key=jax.random.key(2))
    write_gedi_l1b(tmp_path / "list.h5", list(many), survey, **HERE, key=jax.random.key(2))
    with h5py.File(path) as one, h5py.File(tmp_path / "list.h5") as other:
        sets = []
        one.visititems(lambda name, node: sets.append(name) if isinstance(node, h5py.Dataset) else None)
        assert len(sets) > 8 * 30
        assert all(np.array_equal(one[name], other[name]) for name in sets)


def test_waveforms_of_different_lengths_and_pulses_of_any_kind(many, path):
    some, last = slice(20, 150), many[1]
    cut = {name: getattr(last, name)[:, some] for name in ("reflectance", "recorded")}
    waves = [many[0], dataclasses.replace(last, time=last.time[some], **cut)]
    lidar = dataclasses.replace(LIDAR, pulse=jl.RectangularPulse(length=90.0))
    survey = jl.Survey(lidar, many.position[:2], many.zenith[:2])
    write_gedi_l1b(path, waves, survey, **HERE, shot_number=[7, 2**60])
    for shot, wave in zip(read_gedi_l1b(path, [7, 2**60]), waves, strict=True):
        assert shot.time.size == wave.time.size + 2 * 200
        assert shot.signal.sum() == pytest.approx(float(50_000 * wave.reflectance.sum()), rel=2e-4)
        assert shot.elevation[0] == pytest.approx(340.0 - 0.149896229 * (float(wave.time[0]) - 200), abs=1e-2)
        assert shot.pulse_power.sum() == pytest.approx(90 * shot.pulse_power.max(), rel=1e-4)


def test_background_is_part_of_the_pedestal(many, survey, path):
    """Energies relate to E eta A / (pi R^2) of a Lambertian target; margins have background as well."""
    lit = dataclasses.replace(LIDAR, receiver=jl.Receiver(background=1e-16), energy=0.01)
    of = jl.Survey(lit, survey.position, survey.zenith, survey.azimuth)
    waves = dataclasses.replace(many, recorded=np.full_like(many.recorded, 1e-16))
    write_gedi_l1b(path, waves, of, **HERE)
    for shot, zenith in zip(by_shot(path), np.deg2rad(survey.zenith), strict=True):
        counts = 240.0 + 50_000 * 1e-16 / (0.01 * 0.4**2 * np.cos(zenith) ** 2 / 4e5**2)
        assert shot.noise_mean == pytest.approx(counts, rel=1e-6)
        assert counts > 250.0
        np.testing.assert_allclose(shot.waveform, counts, rtol=1e-6)


def test_datasets_are_the_products(many, survey, path, shared):
    """Every dataset has the name, type and number of axes that it has in a recorded file."""
    if not (shared / "gedi" / RECORD).is_file():
        pytest.skip("the recorded GEDI file is not beside this checkout")
    write_gedi_l1b(path, many, survey, **HERE)
    with h5py.File(path) as file, h5py.File(shared / "gedi" / RECORD) as real:
        assert file.attrs["short_name"] == real.attrs["short_name"]
        assert set(file) == {*real, "BEAM0000"}
        for name in set(real) - {"METADATA"}:
            assert file[name].attrs["description"] == real[name].attrs["description"]
            for field in ("beam", "channel"):
                assert {int(real[f"{name}/{field}"][0])} >= set(file[f"{name}/{field}"][:].tolist())

        def compare(name, node):
            if isinstance(node, h5py.Dataset):
                assert (node.dtype, node.ndim) == (real[f"BEAM0101/{name}"].dtype, 1), name
            else:
                assert name == "geolocation"

        for name in set(file) - {"METADATA"}:
            file[name].visititems(compare)


def test_tools_find_records_and_elevations(many, survey, path):
    """As rGEDI and pyGEDI do: all eight groups, indices from 1, elevations from both ends and the count."""
    write_gedi_l1b(path, many, survey, **HERE, beam=BEAM_OF)
    found = {}
    with h5py.File(path) as file:
        for name in ("0000", "0001", "0010", "0011", "0101", "0110", "1000", "1011"):
            group = file[f"BEAM{name}"]
            numbers = group["shot_number"][:]
            assert np.array_equal(numbers, group["geolocation/shot_number"][:])
            for i, number in enumerate(numbers):
                start = int(group["rx_sample_start_index"][i] - group["rx_sample_start_index"][:].min())
                count = int(group["rx_sample_count"][i])
                record = group["rxwaveform"][start : start + count]
                above = record.sum(dtype=float) - count * group["noise_mean_corrected"][i]
                assert group["rx_energy"][i] == pytest.approx(above)
                found[int(number)] = record
    shots = read_gedi_l1b(path)
    assert len(shots) == len(found) == 4
    assert all(np.array_equal(shot.waveform, found[shot.shot_number]) for shot in shots)


def test_the_command_tells_what_a_file_has(many, survey, path, capsys):
    from jaxlidar import cli

    write_gedi_l1b(path, many, survey, **HERE, beam=BEAM_OF)
    assert cli.main(["info", str(path)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "4 GEDI shots of BEAM0000, BEAM0101, BEAM1011"
    assert said[1].startswith("latitude ")


def test_level_2_finds_the_simulated_ground(many, survey, path):
    write_gedi_l1b(path, many, survey, **HERE, key=jax.random.key(3))
    found = gedi_metrics(by_shot(path))
    assert np.all(np.abs(found.elev_lowestmode - (340.0 + many.ground_height)) < 0.1)
    assert found.num_detectedmodes.tolist() == [2] * 4
    # Half of the light of the plate comes from above it, spread by the pulse.
    assert np.all(np.abs(found.rh[:, 98] - (14.0 - many.ground_height)) < 3.0)


def test_places_on_the_ellipsoid(survey, many, path):
    """Near the origin: metres by the radii of curvature; the light comes from where the sensor is."""
    write_gedi_l1b(path, many, survey, **HERE)
    phi = np.deg2rad(42.54)
    bend = 1 - E2 * np.sin(phi) ** 2
    north, east = A * (1 - E2) / bend**1.5, A / np.sqrt(bend) * np.cos(phi)
    slope = np.tan(np.deg2rad(survey.zenith))[:, None]
    down = np.stack([np.sin(np.deg2rad(survey.azimuth)), np.cos(np.deg2rad(survey.azimuth))], 1)
    with h5py.File(path) as file:
        place = {name: node[:] for name, node in file["BEAM0101/geolocation"].items()}
    for name in ("bin0", "lastbin"):
        x, y = (survey.position - (place[f"elevation_{name}"] - 340.0)[:, None] * slope * down).T
        assert np.abs(np.deg2rad(place[f"longitude_{name}"] + 72.18) * east - x).max() < 0.2
        assert np.abs(np.deg2rad(place[f"latitude_{name}"] - 42.54) * north - y).max() < 0.2
        # To the bounce and no farther: half the way there and back.
        drop = (place["altitude_instrument"] - place[f"elevation_{name}"]) / np.cos(np.arctan(slope[:, 0]))
        np.testing.assert_allclose(place[f"bounce_time_offset_{name}"] * 299792458.0, drop, rtol=1e-9)
    towards = np.stack([np.sin(place["local_beam_azimuth"]), np.cos(place["local_beam_azimuth"])], 1)
    np.testing.assert_allclose(towards, -down, atol=3e-4)
    shift = np.stack([place["longitude_instrument"] + 72.18, place["latitude_instrument"] - 42.54], 1)
    away = np.hypot(*(np.deg2rad(shift) * [east, north] - survey.position).T)
    np.testing.assert_allclose(away, 4e5 * slope[:, 0], rtol=5e-3, atol=0.2)


def test_projected_positions_and_the_grids_north(many, path):
    place = many.position + np.array([700_000.0, 5_550_000.0])
    survey = jl.Survey(LIDAR, position=place, zenith=many.zenith, azimuth=many.azimuth)
    write_gedi_l1b(path, dataclasses.replace(many, position=place), survey, **ELSEWHERE)
    for shot, given in zip(by_shot(path), many.azimuth, strict=True):
        # Of the transverse Mercator projection: tan(convergence) = tan(longitude - 15) sin(latitude).
        phi, lam = np.deg2rad([shot.latitude, shot.longitude - 15.0])
        turned = np.rad2deg(np.arctan(np.tan(lam) * np.sin(phi)))
        assert turned == pytest.approx(2.2, abs=0.1)
        assert (shot.azimuth - given - turned + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.02)


def noise_of(shots, noise_mean):
    return np.stack([shot.waveform - noise_mean for shot in shots])


def test_noise_is_that_of_the_product(many, survey, path):
    """Standard deviation and correlation of recorded noise; another shot has other noise."""
    many = dataclasses.replace(many, time=np.arange(4000.0), recorded=np.zeros((4, 1, 4000), np.float32))
    write_gedi_l1b(path, many, survey, **HERE, key=jax.random.key(5), noise_std=3.0)
    noise = noise_of(by_shot(path), 240.0)
    assert np.abs(np.corrcoef(noise)[np.triu_indices(4, 1)]).max() < 0.15
    assert noise.std() == pytest.approx(0.407 * 3.0, rel=0.03)
    power = (noise**2).mean()
    lagged = [(noise[:, lag:] * noise[:, : noise.shape[1] - lag]).mean() / power for lag in range(1, 6)]
    # Measured of recorded shots, and white noise is far from it.
    np.testing.assert_allclose(lagged, [0.92, 0.71, 0.45, 0.21, 0.1], atol=0.05)
    write_gedi_l1b(path, many, survey, **HERE)
    assert not noise_of(by_shot(path), 240.0).any()


@pytest.mark.parametrize(
    ("change", "says"),
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
def test_refusals(many, survey, path, change, says):
    path.write_text("old")
    with pytest.raises(ValueError, match=says):
        write_gedi_l1b(path, many, survey, **{**HERE, **change})
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    assert path.read_text() == "old"


def test_waveforms_that_are_not_the_products_are_refused(many, survey, path):
    def refused(says, waves=many, of=survey, error=ValueError):
        with pytest.raises(error, match=says):
            write_gedi_l1b(path, waves, of, **HERE)

    refused(r"4 waveforms are of a survey of 2 shots", of=survey[:2])
    refused("another position", of=jl.Survey(LIDAR, position=many.position + 1.0))
    refused(r"samples are 2 ns apart; admissible is 1 ns", dataclasses.replace(many, time=2 * many.time))
    two = dataclasses.replace(many, wavelength=np.array([532.0, 1064.0]))
    refused("2 wavelengths; admissible is one", two)
    long = dataclasses.replace(many, time=np.arange(70_000.0))
    refused("70000 bins; admissible are 2 to 65135", long)
    lost = many.recorded.copy()
    lost[2, 0, 3] = np.nan
    refused("recorded of shot 2 = nan", dataclasses.replace(many, recorded=lost))
    refused("waveforms 1 is .* admissible is a Waveform", [many[0], 1, 2, 3], error=TypeError)
    assert not list(path.parent.iterdir())


@pytest.mark.parametrize("from_file", [False, True])
@pytest.mark.parametrize("one_by_one", [False, True])
def test_waveforms_of_another_survey_are_refused(many, survey, path, tmp_path, from_file, one_by_one):
    """By what they know of their lidar, in memory and from files."""

    def stored(waves, name):
        waves.save(tmp_path / f"{name}.nc")
        return jl.open(tmp_path / f"{name}.nc")

    waves = list(many) if one_by_one else many
    if from_file:
        waves = [stored(w, f"{i}") for i, w in enumerate(waves)] if one_by_one else stored(many, "many")

    def refused(says, zenith=survey.zenith, azimuth=survey.azimuth, **changes):
        another = jl.Survey(dataclasses.replace(LIDAR, **changes), survey.position, zenith, azimuth)
        with pytest.raises(ValueError, match=says):
            write_gedi_l1b(path, waves, another, **HERE)
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
    write_gedi_l1b(path, waves, same, **HERE)
    assert len(read_gedi_l1b(path)) == 4


def test_a_single_waveform_of_another_lidar_is_refused(path):
    wave = jl.simulate(LIDAR, SCENE, key=jax.random.key(0), max_orders=1)
    low = jl.Survey.of(dataclasses.replace(LIDAR, altitude=3e5))
    with pytest.raises(
        ValueError, match="waveforms 0: they are of a lidar of altitude 400000 m, that of the"
    ):
        write_gedi_l1b(path, [wave], low, **HERE)
    # What does not have its altitude, as in files of earlier versions, is written.
    bare = dataclasses.replace(wave, info={})
    write_gedi_l1b(path, [bare], low, **HERE)
    assert read_gedi_l1b(path)[0].altitude == 300340.0
