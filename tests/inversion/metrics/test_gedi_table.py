"""Tables of GEDI shots: scatter over noise against standard errors, damaged shots, the product's values."""

import numpy as np
import pytest

import inversion
from inversion.metrics import gedi_table as module
from inversion.metrics.gedi import pulse_samples
from jaxlidar.io import GediShot, read_gedi_l1b

LAG = np.arange(-40.0, 41.0)
PULSE = np.exp(-0.5 * (LAG / 6.6) ** 2)
STEP = 0.15
RECORD = "gedi/GEDI01_B_2019108080338_O01964_T05337_02_003_01_sub.h5"


def shot(number=1, *, bins=900, random=None, noise=3.0, cover=0.5, target=None, **changes):
    """A canopy from 4 to 16 m over flat ground at 100 m, of 17,500 counts; noise is smoothed as recorded.

    `target`: shares of the counts in the samples, in place of those of this canopy.
    """
    elevation = 160.0 - STEP * np.arange(bins)
    height = elevation - 100.0
    if target is None:
        target = np.where((height > 4.0) & (height < 16.0), 1.0, 0.0)
        target *= cover / target.sum()
        target[np.argmin(np.abs(height))] += 1.0 - cover
    record = 200.0 + 17500.0 * np.convolve(target, PULSE / PULSE.sum(), mode="same")
    if random is not None:
        kernel = np.exp(-0.5 * (np.arange(-8, 9) / 1.7) ** 2)
        record = record + noise * np.convolve(
            random.normal(size=bins + 16), kernel / kernel.sum(), mode="valid"
        )
    fields = {
        "beam": "BEAM0101",
        "shot_number": number,
        "time": np.arange(float(bins)),
        "elevation": elevation,
        "waveform": record,
        "noise_mean": 200.0,
        "noise_std": noise,
        "pulse_time": LAG,
        "pulse_power": PULSE,
        "latitude": 10.0,
        "longitude": 20.0,
        "altitude": 4e5,
        "zenith": 0.0,
        "azimuth": 0.0,
        "solar_elevation": -20.0,
        "degrade": 0,
    }
    return GediShot(**{**fields, **changes})


@pytest.fixture(scope="module")
def noisy():
    random = np.random.default_rng(0)
    return inversion.gedi_table([shot(i, random=random) for i in range(60)])


def test_estimates_are_those_of_the_made_up_canopy(noisy):
    ratio = 0.5 / (0.5 + 0.5 * 1.5)
    assert np.median(noisy["ground"]) == pytest.approx(100.0, abs=0.05)
    assert np.median(noisy["cover"]) == pytest.approx(ratio, abs=0.01)
    assert np.median(noisy["pai"]) == pytest.approx(-2 * np.log(1 - ratio), abs=0.04)
    density = noisy["plant_area_density"]
    np.testing.assert_allclose(5 * density.sum(axis=1), noisy["pai"], rtol=0.02)
    assert density.shape == (60, 30)
    # Layers of 5 m: plants from 4 to 16 m.
    assert np.all(np.median(density, axis=0)[1:3] > 0.05)
    assert np.all(np.abs(np.median(density, axis=0)[4:]) < 0.005)
    assert set(noisy["quality"]) == {"good"}
    assert np.all((noisy["sensitivity"] > 0.9) & (noisy["sensitivity"] < 1.0))
    assert noisy["rh"][:, 98].mean() == pytest.approx(16.0, abs=1.5)
    assert noisy["solar_elevation"].tolist() == [-20.0] * 60


def test_standard_errors_contain_the_scatter_of_noise(noisy, monkeypatch):
    """They cover the scatter; without the terms of the model they are not much larger than it."""

    def ratio(table, name, level=None):
        values, stderr = table[name], table[f"{name}_stderr"]
        if level is not None:
            values, stderr = values[:, level], stderr[:, level]
        return np.nanstd(values) / np.nanmedian(stderr)

    cases = [("cover",), ("pai",), ("rh", 50), ("rh", 75)]
    assert all(ratio(noisy, *case) < 1.0 for case in cases)
    for term in ("_SPLIT_ERROR", "_MODE_ERROR", "_EXCESS_FRACTION"):
        monkeypatch.setattr(module, term, 0.0)
    random = np.random.default_rng(1)
    of_noise = inversion.gedi_table([shot(i, random=random, noise=15.0) for i in range(60)])
    ratios = {case: ratio(of_noise, *case) for case in cases}
    assert all(0.4 < value < 1.5 for value in ratios.values()), ratios
    # Noise alone, without the term of the model: its scatter is the closed form's.
    records = np.stack([shot(i, random=np.random.default_rng(i)).waveform - 200.0 for i in range(200)])
    height = np.broadcast_to(-STEP * np.arange(900), records.shape)
    ground = np.asarray(inversion.find_ground(height, records, pulse=PULSE, noise=3.0), float)
    pulse = np.tile(pulse_samples(shot()), (200, 1))
    noise = np.full(200, 3.0 * np.sqrt(1 / (2 * np.sqrt(np.pi) * 1.7)))
    stderr = module._ground_stderr(records, np.full(200, STEP), ground, pulse, noise)
    assert ground.std() == pytest.approx(np.median(stderr), rel=0.25)


def test_shots_of_any_length_share_programs_and_one_bad_shot_does_no_harm():
    damaged = [
        shot(2, waveform=np.full(900, np.nan)),
        shot(3, waveform=np.full(900, 200.0)),
        # A record without noise has no sample below its mean.
        shot(4, random=np.random.default_rng(4), noise_std=0.0),
        shot(5, pulse_power=np.zeros(81)),
        shot(6, waveform=shot().waveform + 500.0),
        shot(7, time=np.arange(2.0), waveform=np.array([200.0, 201.0]), elevation=np.array([100.0, 99.85])),
    ]
    shots = [shot(1), *damaged, *(shot(10 + i, bins=900 + 7 * i) for i in range(5)), shot(20, degrade=1)]
    progress = []
    table = inversion.gedi_table(shots, progress=progress.append)
    assert table["shot_number"].tolist() == [s.shot_number for s in shots]
    bad = np.arange(1, 7)
    assert set(table["quality"][bad]) == {"bad"}
    assert np.all(np.isnan(table["ground"][bad]))
    assert np.all(np.isnan(table["plant_area_density"][bad]))
    reasons = table["reasons"][bad]
    for reason, text in zip(
        reasons, ("waveform", "weak", "noise_std", "pulse_power", "baseline", "three or more")
    ):
        assert text in reason, reasons
    good = np.setdiff1d(np.arange(len(shots)), bad)
    np.testing.assert_allclose(table["ground"][good], 100.0, atol=0.05)
    # The length of a record does not change what is read from it.
    np.testing.assert_allclose(table["rh"][good] - table["rh"][0], 0.0, atol=0.04)
    assert table["quality"][-1] == "doubtful"
    assert "degrade" in table["reasons"][-1]
    assert str(progress[-1]).startswith("8 of 8 shots")


def test_records_without_noise_are_not_judged_by_noise():
    noiseless = shot(2, noise_std=0.0, waveform=shot().waveform.astype(np.float32).astype(float))
    table = inversion.gedi_table([shot(1), noiseless])
    assert table["quality"].tolist() == ["doubtful", "good"]
    assert "uneven noise" in table["reasons"][0]
    assert np.isnan(table["sensitivity"][1])
    for name in ("ground", "elev_lowestmode", "cover", "pai"):
        assert table[name][1] == pytest.approx(table[name][0], abs=0.02), name
    # The signal's ends are those of lower thresholds.
    np.testing.assert_allclose(table["rh"][1, 1:100], table["rh"][0, 1:100], atol=0.3)
    assert 0.0 < table["rh"][1, 100] - table["rh"][0, 100] < 1.5


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"shots": shot()}, TypeError, r"gedi_table\(\[shot\]\)"),
        ({"shots": "nowhere.h5"}, FileNotFoundError, "nowhere.h5: no such file"),
        ({"shots": [], "group": 7}, ValueError, "group = 7"),
        ({"shots": [], "edges": [5.0, 0.0]}, ValueError, "edges = .*increasing"),
        ({"shots": [], "projection": 0.0}, ValueError, "projection = 0"),
        ({"shots": [], "fit": "yes"}, TypeError, "fit"),
        ({"shots": [], "fit": True, "path": 3}, TypeError, "path"),
        ({"shots": [], "path": "fits.zarr"}, ValueError, "fits.zarr.*fit=True"),
        ({"shots": [], "path": "fits.sqlite", "fit": True}, ValueError, "admissible is .* fits.zarr"),
    ],
)
def test_inadmissible_arguments_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        inversion.gedi_table(**arguments)


@pytest.fixture
def recorded(shared):
    path = shared / RECORD
    if not path.is_file():
        pytest.skip("the recorded GEDI file is not beside this checkout")
    return path


@pytest.mark.slow
def test_recorded_shots_agree_with_the_product(recorded, shared, tmp_path):
    table = inversion.gedi_table(recorded)
    assert len(table) == 300
    with np.load(shared / "gedi" / "level2_answers_60_shots.npz") as answers:
        product = {name: answers[name] for name in ("shot", "elev_lowestmode", "rh", "pai", "cover")}
    reference = {name: product[name] for name in ("elev_lowestmode", "pai", "cover")}
    reference |= {"shot_number": product["shot"], "rh98": product["rh"][:, 98]}
    names = {"elev_lowestmode": "elev_lowestmode", "ground": "elev_lowestmode", "pai": "pai", "rh_98": "rh98"}
    comparison = inversion.compare(table, reference, names, classes="quality")
    rows = {(row.column, row.group): row for row in comparison.statistics}
    assert rows["elev_lowestmode", "all"].count == 60
    assert abs(rows["elev_lowestmode", "all"].bias) < 0.03
    assert rows["ground", "all"].median_absolute < 0.04
    assert rows["ground", "good"].coverage >= 0.88
    assert rows["rh_98", "all"].rmse < 0.05
    assert rows["pai", "all"].rank > 0.8
    assert np.all(table["pai_stderr"][np.isfinite(table["pai"])] > 0)
    assert np.mean(table["quality"] == "good") > 0.6


@pytest.mark.slow
def test_the_command_writes_a_table(recorded, tmp_path, monkeypatch, capsys):
    from inversion.commands import gedi

    shots = read_gedi_l1b(recorded)[:5]
    monkeypatch.setattr(
        "inversion.commands.gedi_table", lambda files, **more: inversion.gedi_table(shots, **more)
    )
    gedi.main([str(recorded), "-o", str(tmp_path / "shots.csv")], standalone_mode=False)
    output = capsys.readouterr()
    assert output.out.startswith("5 shots: ")
    # Not a terminal: whole lines.
    assert "5 of 5 shots" in output.err
    assert len((tmp_path / "shots.csv").read_text().splitlines()) == 6
