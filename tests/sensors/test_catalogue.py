"""Instruments by name: all are lidars whose numbers have a source, and ATLAS counts what is published."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxlidar as jl

PLANCK_TIMES_LIGHT = 6.62607015e-34 * 299792458.0
SCANNERS = ("RIEGL", "Leica", "Optech")


@pytest.mark.parametrize("name", jl.instruments())
def test_an_instrument_is_a_lidar_and_each_number_has_its_source(name):
    lidar, sources = jl.instrument(name), jl.instrument_sources(name)
    assert isinstance(lidar, jl.Lidar)
    for field in ("wavelength", "divergence", "aperture", "energy", "altitude", "pulse.fwhm", "pulse_rate"):
        value = sources[field]
        assert value.value > 0
        assert len(value.source) > 5
        if field != "pulse_rate":
            stored = lidar.pulse.fwhm if field == "pulse.fwhm" else getattr(lidar, field)
            assert float(np.max(stored)) == pytest.approx(value.value, rel=1e-6)
    assert all(value.source != "without a source" for value in sources.values())
    # What a data sheet states is published, what it does not is marked.
    assert sources["pulse_rate"].is_published
    assert not sources["efficiency"].is_published
    if any(unit.is_published for key, unit in sources.items() if key.startswith("scan.")):
        assert isinstance(lidar.scan, jl.AbstractScan)


def test_the_table_has_the_instruments_that_it_should():
    names = jl.instruments()
    assert sum(name.startswith(SCANNERS) for name in names) >= 8
    for name in ("GEDI power", "GEDI coverage", "ATLAS strong", "ATLAS weak"):
        assert {name, f"{name} day"} <= set(names)
    assert "LVIS" in names
    terrestrial = {"RIEGL VZ-400", "RIEGL VZ-400i", "RIEGL VZ-600i", "Leica RTC360", "Z+F IMAGER 5016"}
    assert terrestrial <= {n for n in names if isinstance(jl.instrument(n).scan, jl.Panorama)}
    assert isinstance(jl.instrument("Livox Avia").scan, jl.Risley)
    assert jl.instrument("Livox Mid-360").scan is None
    for beam in ("GEDI power", "GEDI coverage"):
        assert float(jl.instrument(f"{beam} day").receiver.background) > 0
        assert float(jl.instrument(beam).receiver.background) == 0
    assert float(jl.instrument("GEDI power").energy / jl.instrument("GEDI coverage").energy) > 2


@pytest.mark.parametrize(("name", "published"), [("ATLAS strong", 6.0), ("ATLAS weak", 1.5)])
def test_atlas_counts_the_published_photons_of_winter_ice(name, published):
    """Signal levels of the ATBD for sea ice (Kwok et al.): 6 and 1.5 photons per shot, within 10 %."""
    lidar = jl.instrument(name)
    scene = jl.Scene(ground=jl.Ground(reflectance=0.9), atmosphere=jl.Atmosphere(visibility=23.0))
    wave = jl.simulate(lidar, scene, key=jax.random.key(0))
    photons = float(wave.energy.sum()) * 532e-9 / PLANCK_TIMES_LIGHT
    assert photons == pytest.approx(published, rel=0.1)
    # The counter loses a few to dead time; 4,000 pulses give the mean to 1 %.
    events = lidar.receiver.count(wave, key=jax.random.key(1), pulses=4000)
    arrived = (len(events) + int(events.lost.sum())) / 4000
    assert abs(arrived - photons) < 3 * np.sqrt(photons / 4000)
    # The planted wrong answer: a strong beam's energy in a weak one.
    assert photons * 4 != pytest.approx(published, rel=0.1)


def test_scan_patterns_make_surveys_and_leave_the_compiled_program_alone():
    line = {"start": (0, 0), "end": (0, 1), "speed": 60.0, "pulse_rate": 1000.0}
    for name in jl.instruments():
        lidar = jl.instrument(name)
        if isinstance(lidar.scan, jl.Panorama):
            pattern = dataclasses.replace(lidar.scan, step=5.0)
            assert len(jl.Survey.scan(lidar.at((0, 0, 1.5)), pattern)) > 1000
        elif lidar.scan is not None:
            assert len(jl.Survey.scan(lidar, lidar.scan, **line)) > 10
    lidar = jl.instrument("RIEGL VQ-780 II")
    scene = jl.Scene(ground=jl.Ground())
    assert jl.make_setup(lidar, scene, jl.plan(lidar, scene)).lidar.scan is None


def test_users_add_instruments_of_their_own(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        '["My scanner"]\nlike = "RIEGL VQ-780 II"\nenergy = {value = 2e-6, source = "calibration, 2024"}\n\n'
        '["My scanner".receiver]\nkind = "Receiver"\nelectronic_noise = {value = 1e-18, assumed = "guess"}\n'
    )
    assert jl.instruments(path)[-1] == "My scanner"
    lidar = jl.instrument("My scanner", path)
    assert float(lidar.energy) == pytest.approx(2e-6)
    assert lidar.noise == pytest.approx(1e-18)
    assert jl.instrument("RIEGL VQ-780 II").noise is None
    assert float(lidar.divergence) == float(jl.instrument("RIEGL VQ-780 II").divergence)
    assert not jl.instrument_sources("My scanner", path)["receiver.electronic_noise"].is_published


def test_numbers_without_a_source_are_listed_and_marked(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        '[A]\nlike = "RIEGL VQ-780 II"\ndescription = "ours"\nenergy = 2e-6\npulse_rate = 100000\n'
        '[A.pulse]\nkind = "SampledPulse"\ntime = [0.0, 1.0, 2.0]\n'
        'power = {value = [0, 1, 0], source = "x"}\n'
    )
    assert float(jl.instrument("A", path).energy) == pytest.approx(2e-6)
    sources = jl.instrument_sources("A", path)
    numbers = {"energy": 2e-6, "pulse_rate": 100000, "pulse.time": [0.0, 1.0, 2.0]}
    marked = {name: value.value for name, value in sources.items() if value.source == "without a source"}
    assert marked == numbers
    assert not any(sources[name].is_published for name in numbers)
    assert sources["pulse.power"].is_published
    assert "description" not in sources
    assert "pulse.kind" not in sources


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[A]\nenergy = {value = -1.0, source = 'x'}", "A: energy = -1 is outside"),
        ("[A]\nenergy = {value = 1.0}", "A.energy has the keys"),
        ("[A.pulse]\nkind = 'Pulse'", "A.pulse.kind = 'Pulse' is none of GaussianPulse"),
        ("[A]\nlike = 'A'", "like itself"),
        ("[A]\nlike = 'GEDI'", "instrument 'GEDI' is not known; the nearest are GEDI"),
        ("[A]\nlike = 'gedi power'", "the nearest are GEDI power,"),
        ("a = 1", "a is no table"),
        ("[A", "no TOML"),
    ],
)
def test_wrong_tables_are_refused(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        jl.instrument("A", path)


def test_cases_name_instruments_and_hold_scans_and_counters(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text('[lidar]\nkind = "instrument"\nname = "ATLAS weak"\n')
    lidar = jl.io.read_case(path).lidar
    assert isinstance(lidar.receiver, jl.PhotonCounter)
    for name in ("ATLAS weak", "Leica TerrainMapper", "RIEGL VZ-400", "Livox Avia"):
        lidar = jl.instrument(name)
        jl.io.write_case(path, jl.io.Case(lidar=lidar))
        read_lidar = jl.io.read_case(path).lidar
        assert read_lidar.scan == lidar.scan
        assert type(read_lidar.receiver) is type(lidar.receiver)
        assert float(read_lidar.energy) == float(lidar.energy)
