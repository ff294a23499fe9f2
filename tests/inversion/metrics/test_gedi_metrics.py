"""GEDI's level 2A metrics and the tools without a model, against the product's values for recorded shots."""

import types
from pathlib import Path

import numpy as np
import pytest

from inversion import (
    find_ground,
    gedi_metrics,
    gedi_settings,
    ground_and_canopy,
    plant_area_index,
    relative_heights,
)
from tests.conftest import SHARED

RECORD = "GEDI01_B_2019108080338_O01964_T05337_02_003_01_sub.h5"


@pytest.fixture(scope="module")
def recorded():
    """Shots with values of the level 2 products, and those values in the same order."""
    pytest.importorskip("h5py")
    from jaxlidar.io import read_gedi_l1b

    if not (SHARED / "gedi" / RECORD).is_file():
        pytest.skip("the recorded GEDI file is not beside this checkout")
    product = np.load(SHARED / "gedi" / "level2_answers_60_shots.npz")
    return read_gedi_l1b(SHARED / "gedi" / RECORD, product["shot"]), product


def test_settings_are_those_of_the_basis_document():
    assert gedi_settings(1) == (6.5, 6.5, 3.0, 6.0)
    assert [gedi_settings(group).back_threshold for group in range(1, 7)] == [6.0, 3.0, 6.0, 6.0, 2.0, 4.0]
    assert [gedi_settings(group).front_threshold for group in range(1, 7)] == [3.0, 3.0, 3.0, 6.0, 3.0, 3.0]
    for group in (0, 7, -1):
        with pytest.raises(ValueError, match="group = "):
            gedi_settings(group)


def test_metrics_are_those_of_the_product(recorded):
    """All elevations and all 101 relative heights of all shots agree within 0.1 m; another group's do not."""
    shots, product = recorded
    metrics = gedi_metrics(shots)
    np.testing.assert_allclose(metrics.elev_lowestmode, product["elev_lowestmode"], atol=0.06, rtol=0)
    np.testing.assert_allclose(metrics.elev_highestreturn, product["elev_highest"], atol=0.06, rtol=0)
    np.testing.assert_allclose(metrics.rh, product["rh"], atol=0.1, rtol=0)
    np.testing.assert_array_equal(metrics.num_detectedmodes, product["nmodes"])
    # Negative control: the higher front threshold of group 4.
    of_group_4 = gedi_metrics(shots, gedi_settings(4))
    assert np.mean(np.abs(of_group_4.elev_highestreturn - product["elev_highest"]) < 0.15) < 0.2


def stacked(shots):
    """Heights over the first bin, records and pulses, of one length, and the elevation of the first bin."""
    size = max(shot.time.size for shot in shots)
    lag = np.arange(-64.0, 65.0)
    top = np.array([shot.elevation[0] for shot in shots])
    step = np.array([(shot.elevation[0] - shot.elevation[-1]) / (shot.time.size - 1) for shot in shots])
    power = np.stack([np.pad(shot.signal, (0, size - shot.time.size)) for shot in shots])
    pulse = np.stack([np.interp(lag, s.pulse_time, s.pulse_power, left=0, right=0) for s in shots])
    return -step[:, None] * np.arange(size), power, pulse, top


def rank_correlation(a, b):
    """Spearman's, of values without ties."""
    return np.corrcoef(np.argsort(np.argsort(a)), np.argsort(np.argsort(b)))[0, 1]


def test_tools_without_a_model_agree_with_the_product(recorded):
    """From nothing but the record and its pulse."""
    shots, product = recorded
    height, power, pulse, top = stacked(shots)
    ground = np.asarray(find_ground(height, power, pulse=pulse))
    difference = ground + top - product["elev_lowestmode"]
    # A bin is 0.15 m.
    assert np.mean(np.abs(difference) < 0.15) >= 0.95
    assert np.max(np.abs(difference)) < 0.3
    rh98 = np.asarray(relative_heights(height, power, ground=ground, levels=(98.0,)))[:, 0]
    assert rank_correlation(rh98, product["rh"][:, 98]) > 0.97
    split = ground_and_canopy(height, power, pulse=pulse)
    assert rank_correlation(plant_area_index(split.gap), product["pai"]) > 0.82


def made_up_shot(elevation, record):
    """Shot with the attributes that the metrics read."""
    return types.SimpleNamespace(elevation=elevation, waveform=record, noise_mean=200.0, noise_std=3.0)


def test_shots_of_all_lengths_in_their_order():
    """Two size buckets, more shots than are computed at a time, and one of noise alone."""
    ground = np.linspace(90.0, 110.0, 70)
    shots = []
    for i, ground_elevation in enumerate(ground):
        elevation = 130.0 - 0.15 * np.arange(380 if i % 2 else 300)
        # Shot 7 has no signal.
        amplitude = 0.0 if i == 7 else 300.0
        echo = amplitude * np.exp(-0.5 * ((elevation - ground_elevation) / 0.9) ** 2)
        shots.append(made_up_shot(elevation, 200.0 + echo))
    metrics = gedi_metrics(shots)
    assert np.isnan(metrics.elev_lowestmode[7])
    assert np.all(np.isnan(metrics.rh[7]))
    assert metrics.num_detectedmodes[7] == 0
    has_echo = np.arange(70) != 7
    np.testing.assert_allclose(metrics.elev_lowestmode[has_echo], ground[has_echo], atol=0.03)
    assert np.all(metrics.num_detectedmodes[has_echo] == 1)
    assert metrics.rh.shape == (70, 101)
    assert gedi_metrics([]).rh.shape == (0, 101)


def test_bad_input_is_refused():
    elevation = 130.0 - 0.15 * np.arange(300)
    with pytest.raises(ValueError, match="waveform = nan"):
        gedi_metrics([made_up_shot(elevation, elevation * np.nan)])
    with pytest.raises(ValueError, match="waveform and elevation have the shapes"):
        gedi_metrics([made_up_shot(elevation[1:], elevation)])
    with pytest.raises(ValueError, match="smoothing = 0"):
        gedi_metrics([made_up_shot(elevation, elevation)], gedi_settings(1)._replace(smoothing=0.0))
    lost_noise = made_up_shot(elevation, elevation)
    lost_noise.noise_mean = np.nan
    with pytest.raises(ValueError, match="noise_mean = nan"):
        gedi_metrics([lost_noise])


@pytest.mark.parametrize(
    ("shots", "message"),
    [
        (
            "GEDI01_B.h5",
            r"shots = 'GEDI01_B\.h5' is a path; .*gedi_metrics\(jaxlidar\.io\.read_gedi_l1b\(path\)\)",
        ),
        (Path("GEDI01_B.h5"), r"shots = 'GEDI01_B\.h5' is a path; .*read_gedi_l1b"),
        (made_up_shot(np.arange(3.0), np.arange(3.0)), r"SimpleNamespace; .*gedi_metrics\(\[shot\]\)"),
        (["a.h5"], "shots has a str at index 0, which has no elevation; .*noise_std, as .*read_gedi_l1b"),
    ],
)
def test_other_things_than_shots_are_refused_with_the_right_call(shots, message):
    with pytest.raises(TypeError, match=message):
        gedi_metrics(shots)


def test_shots_may_come_one_by_one():
    elevation = 120.0 - 0.15 * np.arange(300)
    record = 200.0 + 400.0 * np.exp(-0.5 * ((elevation - 100.0) / 0.9) ** 2)
    metrics = gedi_metrics(made_up_shot(elevation, record) for _ in range(2))
    np.testing.assert_allclose(metrics.elev_lowestmode, 100.0, atol=0.05)


def test_ground_that_merges_with_the_canopy(shared):
    """Smoothed by the width of the pulse, ground and canopy, 3 m apart, are one mode, 1.9 m too high."""
    shot = np.load(shared / "gedi" / "shot_merged_ground.npz")
    height, power, pulse = shot["height"], shot["signal"], shot["pulse"]
    for noise in (float(shot["noise"]), None):
        assert abs(float(find_ground(height, power, pulse=pulse, noise=noise))) < 0.5
    # Negative control: a pulse a fifth wider, and with it the smoothing.
    lag = np.arange(pulse.size) - pulse.size // 2
    wide = np.interp(lag / 1.2, lag, pulse)
    assert float(find_ground(height, power, pulse=wide)) > 1.0
