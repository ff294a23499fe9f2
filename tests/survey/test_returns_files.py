"""Discrete returns and waveforms as LAS and LAZ, read back by laspy: every number is the simulation's."""

import subprocess
import sys

import equinox as eqx
import jax
import laspy
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar import cli

# A zone of UTM, in metres.
CRS = "EPSG:32633"
SCENE = jl.Scene(
    plates=[jl.Plate(height=7.03, reflectance=0.4, coverage=0.5)],
    ground=jl.Ground(height=1.02, reflectance=0.3),
)
LINE = {"start": (5e5, 5.2e6), "end": (5e5, 5.2e6 + 20.0), "speed": 40.0, "pulse_rate": 20.0}


def simulate(gps_time=3.2e8, shots=slice(None)):
    lidar = jl.Lidar(altitude=500.0, pulse=jl.GaussianPulse(fwhm=4.0))
    survey = jl.Survey.scan(lidar, jl.Oscillating(20.0, 3.0), **LINE, gps_time=gps_time, flight_line=7)
    return jl.simulate_many(survey[shots], SCENE, key=jax.random.key(0), max_orders=1)


@pytest.fixture(scope="module")
def waveforms():
    return simulate()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_points_have_the_numbers_of_the_returns(tmp_path, waveforms, suffix):
    path = tmp_path / f"strip{suffix}"
    returns = waveforms.to_las(path, crs=CRS)
    cloud = laspy.read(path)
    header = cloud.header
    assert (header.version.major, header.version.minor, header.point_format.id) == (1, 4, 6)
    assert header.are_points_compressed == (suffix == ".laz")
    assert header.global_encoding.wkt
    # 3.2e8 s are no seconds of a week.
    assert header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    (wkt,) = [vlr.string for vlr in header.vlrs if vlr.record_id == 2112]
    assert "UTM zone 33N" in wkt
    np.testing.assert_allclose(cloud.xyz, returns.position, atol=0.5001e-3)
    np.testing.assert_array_equal(cloud.return_number, returns.number)
    np.testing.assert_array_equal(cloud.number_of_returns, returns.n_returns)
    np.testing.assert_array_equal(cloud.gps_time, returns.gps_time)
    np.testing.assert_allclose(0.006 * cloud.scan_angle, returns.scan_angle, atol=0.0031)
    np.testing.assert_array_equal(cloud.point_source_id, 7)
    np.testing.assert_array_equal(cloud.classification, np.tile([1, 2], len(waveforms)))
    np.testing.assert_array_equal(cloud.intensity, np.round(65535 * returns.reflectance))
    extra = {"width": "width", "reflectance": "reflectance", "amplitude": "amplitude"}
    for name, field in (*extra.items(), ("ground share", "ground_share")):
        np.testing.assert_array_equal(cloud[name], getattr(returns, field).astype(np.float32))
    # The package's own reader and command agree.
    own = jl.io.read_las(path)
    np.testing.assert_allclose(own.position, cloud.xyz, atol=1e-9)
    assert list(own.extra) == list(cloud.point_format.extra_dimension_names)
    for name, values in own.extra.items():
        np.testing.assert_array_equal(values, cloud[name])


def test_seconds_of_a_week_are_flagged_as_such(tmp_path):
    simulate(gps_time=1000.0).to_las(tmp_path / "a.las")
    cloud = laspy.read(tmp_path / "a.las")
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME
    assert cloud.gps_time[0] == 1000.0


def test_surveys_without_a_track_have_no_time_and_zenith_angles(tmp_path):
    survey = jl.Survey(jl.Lidar(altitude=500.0), [(0, 0), (10, 0)], zenith=[0.0, 12.0])
    jl.simulate_many(survey, SCENE, key=jax.random.key(0), max_orders=1).to_las(tmp_path / "a.las")
    cloud = laspy.read(tmp_path / "a.las")
    assert set(np.asarray(cloud.gps_time)) == {0.0}
    np.testing.assert_allclose(0.006 * cloud.scan_angle, [0, 0, 12, 12], atol=0.003)


@pytest.mark.parametrize("point_format", [4, 9])
def test_packets_have_the_samples_of_the_records(tmp_path, waveforms, point_format):
    path = tmp_path / "strip.las"
    returns = waveforms.to_las_waveforms(path, crs=CRS, point_format=point_format)
    cloud = laspy.read(path)
    assert cloud.header.global_encoding.wkt
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    np.testing.assert_allclose(cloud.xyz, returns.position, atol=0.5001e-3)
    np.testing.assert_array_equal(cloud.point_source_id, 7)
    shots = jl.io.read_las_waveforms(path)
    assert len(shots) == len(waveforms)
    largest = waveforms.recorded.max()
    for i in (0, 5, len(waveforms) - 1):
        shot = shots[i]
        np.testing.assert_allclose(shot.waveform, waveforms.recorded[i, 0], atol=0.51 * largest / 65535)
        # Positions of samples: the time zero of a shot is at its aim point.
        height = -0.5 * jl.SPEED_OF_LIGHT * waveforms.time * np.cos(np.deg2rad(waveforms.zenith[i]))
        np.testing.assert_allclose(shot.elevation, height, atol=0.002)
        assert shot.gps_time == waveforms.acquisition.gps_time[i]
        assert shot.flight_line == 7
        step = 0.006 if point_format == 9 else 1.0
        assert shot.scan_angle == pytest.approx(waveforms.acquisition.scan_angle[i], abs=0.51 * step)


def test_noisy_records_of_many_shots_share_one_description_of_packets(tmp_path):
    """The lowest samples of 300 noisy records all differ; a file has 255 descriptions of packets."""
    survey = jl.Survey.grid(jl.Lidar(altitude=500.0), low=(0, 0), high=(29, 9), spacing=1.0)
    waveforms = jl.simulate_many(survey, SCENE, key=jax.random.key(0), max_orders=1)
    largest = waveforms.recorded.max()
    noise = np.random.default_rng(0).normal(size=waveforms.recorded.shape)
    record = waveforms.recorded + 0.02 * largest * noise
    waveforms.to_las_waveforms(tmp_path / "noisy.las", record=record)
    shots = jl.io.read_las_waveforms(tmp_path / "noisy.las")
    assert len(shots) == 300
    step = np.ptp(record) / 65535
    # Without GPS times, shots are read in the order in which they were written.
    for i in (0, 150, 299):
        np.testing.assert_allclose(shots[i].waveform, record[i, 0], rtol=0, atol=0.51 * step)


def test_formats_from_6_on_declare_well_known_text_without_a_system_too(tmp_path, waveforms):
    waveforms.to_las(tmp_path / "a.las")
    waveforms.to_las_waveforms(tmp_path / "b.las")
    waveforms.to_las_waveforms(tmp_path / "c.las", point_format=4)
    flags = [laspy.read(tmp_path / f"{name}.las").header.global_encoding.wkt for name in "abc"]
    assert flags == [True, True, False]


def test_the_command_converts_waveforms_to_points(tmp_path, waveforms, capsys):
    waveforms.save(tmp_path / "strip.nc")
    source, target = str(tmp_path / "strip.nc"), str(tmp_path / "strip.laz")
    assert cli.main(["convert", source, target, "--crs", CRS, "--detector", "constant fraction"]) == 0
    assert f"{2 * len(waveforms)} returns of {len(waveforms)} shots" in capsys.readouterr().out
    expected = waveforms.returns("constant fraction")
    np.testing.assert_allclose(laspy.read(target).xyz, expected.position, atol=0.5001e-3)
    assert cli.main(["info", target]) == 0
    output = capsys.readouterr().out
    assert "UTM zone 33N" in output
    assert "point format 6, compressed" in output
    assert f"{2 * len(waveforms)} of pulses with 2" in output
    assert cli.main(["convert", source, str(tmp_path / "a.toml"), "--crs", CRS]) == 2


@pytest.mark.slow
def test_decomposition_needs_no_other_import(tmp_path, waveforms):
    """In a process of its own, where nothing has imported `inversion`."""
    waveforms.save(tmp_path / "strip.nc")
    code = (
        "import sys, jaxlidar; waves = jaxlidar.open(sys.argv[1]); assert 'optimistix' not in sys.modules; "
        "waves.to_las(sys.argv[2], detector='decomposition'); assert 'inversion' not in sys.modules"
    )
    target = tmp_path / "strip.laz"
    subprocess.run([sys.executable, "-c", code, tmp_path / "strip.nc", target], check=True)
    assert len(laspy.read(target)) == 2 * len(waveforms)


def test_writers_create_missing_folders_alike(tmp_path, waveforms):
    for write, name in (
        (waveforms.save, "a.nc"),
        (waveforms.save, "a.zarr"),
        (waveforms.to_las, "a.las"),
        (waveforms.to_las_waveforms, "b.las"),
    ):
        path = tmp_path / f"folder of {name}" / "inner" / name
        write(path)
        assert path.exists()
    # A refused file leaves none behind.
    with pytest.raises(ValueError, match="has no return"):
        waveforms.to_las(tmp_path / "empty" / "a.las", threshold=1.0)
    assert not (tmp_path / "empty").exists()


def test_what_a_file_cannot_hold_is_refused(tmp_path, waveforms):
    with pytest.raises(ValueError, match=r"does not end in \.las or \.laz"):
        waveforms.to_las(tmp_path / "strip.xyz")
    with pytest.raises(ValueError, match=r"strip\.las: the survey has no return .* a lower threshold"):
        waveforms.to_las(tmp_path / "strip.las", threshold=1.0)
    # What the message names instead: shots without a return have a synthetic point.
    waveforms.to_las_waveforms(tmp_path / "packets.las", threshold=1.0)
    assert len(jl.io.read_las_waveforms(tmp_path / "packets.las")) == len(waveforms)
    with pytest.raises(ValueError, match="no sample above zero"):
        waveforms.to_las_waveforms(tmp_path / "strip.las", record=np.zeros_like(waveforms.recorded))


def test_numbers_that_point_formats_do_not_hold_are_refused(tmp_path):
    point, value = np.zeros((1, 3)), np.ones(1)
    for fields, message in (
        ({"scan_angle": 181.0 * value}, "scan_angle = 181 is outside"),
        ({"point_source": 70000 * value}, "point_source_id = 70000 is outside"),
        ({"extra": {"x" * 33: ("text", value)}}, "admissible are 32 bytes"),
        ({"extra": {"a": ("text", np.ones(2))}}, r"extra\['a'\] has shape \(2,\)"),
        ({"extra": {"a": ("text", 1e300 * value)}}, r"extra\['a'\] = 1e\+300 is outside"),
        ({"extra": {"": ("text", value)}}, "extra: '' is empty or a name that points have"),
        ({"extra": {"intensity": ("text", value)}}, "extra: 'intensity' is empty or a name that points have"),
        ({"extra": {"X": ("text", value)}}, "extra: 'X' is empty or a name that points have"),
    ):
        with pytest.raises(ValueError, match=message):
            jl.io.write_las(tmp_path / "a.las", point, **fields)


def test_what_a_format_or_a_part_does_not_hold_names_the_way_out(tmp_path, waveforms):
    upward = eqx.tree_at(lambda w: w.acquisition.scan_angle, waveforms, replace_fn=lambda a: a + 120.0)
    with pytest.raises(ValueError, match=r"scan_angle = 120 .* of point format 4; formats 6 to 10 hold"):
        upward.to_las_waveforms(tmp_path / "a.las", point_format=4)
    upward.to_las_waveforms(tmp_path / "a.las", point_format=9)
    bright = eqx.tree_at(lambda r: r.reflectance, waveforms.returns(), replace_fn=lambda a: 10.0 * a)
    with jl.io.LasWriter(tmp_path / "parts.las") as file:
        waveforms.to_las(file)
        with pytest.raises(ValueError, match=r"reflectance = .* is outside .* give to_las a path, which"):
            bright.to_las(file)
    bright.to_las(tmp_path / "whole.las")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_file_in_parts_has_the_points_of_all(tmp_path, waveforms, suffix):
    parts = simulate(shots=slice(0, 6)), simulate(shots=slice(6, None))
    path = tmp_path / f"parts{suffix}"
    with jl.io.LasWriter(path, crs=CRS) as file:
        for part in parts:
            part.to_las(file)
    expected = []
    for number, part in enumerate(parts):
        part.to_las(tmp_path / f"{number}{suffix}")
        expected.append(laspy.read(tmp_path / f"{number}{suffix}"))
    cloud = laspy.read(path)
    assert "UTM zone 33N" in cloud.header.parse_crs().name
    np.testing.assert_allclose(cloud.xyz, np.concatenate([np.asarray(c.xyz) for c in expected]), atol=1e-9)
    np.testing.assert_allclose(cloud.header.maxs, cloud.xyz.max(axis=0), atol=1e-9)
    for name in cloud.point_format.dimension_names:
        if name not in "XYZ":
            values = np.concatenate([np.asarray(c[name]) for c in expected])
            np.testing.assert_array_equal(cloud[name], values, err_msg=name)


def test_a_file_in_parts_is_complete_or_not_there(tmp_path, waveforms):
    path, point = tmp_path / "parts.laz", np.zeros((1, 3))

    def write(*parts):
        with jl.io.LasWriter(path) as file:
            for part in parts:
                part(file)

    def stop(file):
        raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        write(waveforms.to_las, stop)
    with pytest.raises(ValueError, match="no part has a point"):
        write()
    with pytest.raises(ValueError, match="is not open"):
        jl.io.LasWriter(path).write(point)
    with jl.io.LasWriter(tmp_path / "whole.las") as file:
        file.write(point)
    for again in (lambda: file.write(point), file.__enter__):
        with pytest.raises(ValueError, match=r"is not open|is written"):
            again()
    (tmp_path / "whole.las").unlink()
    for fields, message in (
        (
            {"extra": {"height": ("m", np.ones(1))}},
            r"extra has \['height'\]; admissible are those of the first",
        ),
        ({"gps_time": np.full(1, 3.2e8)}, "gps_time is outside 0 to 604800 s in some parts alone"),
        ({"intensity": np.full(1, 65536)}, "intensity = 65536 is outside"),
    ):
        with pytest.raises(ValueError, match=message):
            write(lambda file: file.write(point), lambda file, fields=fields: file.write(point, **fields))
    with pytest.raises(ValueError, match="together with a LasWriter"):
        write(lambda file: waveforms.to_las(file, crs=CRS))
    assert list(tmp_path.iterdir()) == []
