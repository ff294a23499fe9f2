"""Response of a receiver from many shots: planted width and tail are estimated beside wider echoes.

Records are convolutions in time on a grid of a quarter of a sample; the estimate works with spectra. Skewed
pulses of a standard deviation of about 6 samples; flat ground, slopes (echoes widened by 3 to 12 samples) and
low canopies.
"""

import types

import numpy as np
import pytest

import inversion

FINE = 0.25
LAG = np.arange(-60.0, 60.0 + FINE, FINE)
PULSE = np.where(LAG < 0, np.exp(-0.5 * (LAG / 5.0) ** 2), np.exp(-0.5 * (LAG / 7.0) ** 2))
TIME = np.arange(-300.0, 300.0 + FINE, FINE)
WIDTH, FRACTION, DECAY = 4.0, 0.04, 35.0


def gaussian(width):
    kernel = np.exp(-0.5 * (LAG / width) ** 2)
    return kernel / kernel.sum()


def records(*, flat, widened, tail_fraction=FRACTION, noise=2e-3, seed=0):
    """Shots over flat ground, and others that are widened or have a canopy before the ground."""
    random = np.random.default_rng(seed)
    late = np.where(TIME >= 0, np.exp(-np.maximum(TIME, 0.0) / DECAY), 0.0)
    tail = tail_fraction * late / late.sum()
    tail[np.argmin(np.abs(TIME))] += 1.0 - tail_fraction
    shots = []
    for i in range(flat + widened):
        target = np.zeros(TIME.size)
        at = int(np.argmin(np.abs(TIME))) + int(random.integers(-20, 20))
        target[at] = 1.0
        if i >= flat and i % 2:
            target[at - 160 : at - 20] += 0.3 / 140
        received = np.convolve(np.convolve(target, PULSE, mode="same"), gaussian(WIDTH), mode="same")
        if i >= flat and not i % 2:
            received = np.convolve(received, gaussian(random.uniform(3.0, 12.0)), mode="same")
        received = np.convolve(received, tail)[TIME.size // 2 :][: TIME.size]
        signal = received[::4] / received.max()
        every_fourth = slice(0, None, 4)
        shots.append(
            types.SimpleNamespace(
                signal=signal + noise * random.normal(size=signal.size),
                noise_std=noise,
                pulse_time=LAG[every_fourth],
                pulse_power=PULSE[every_fourth],
            )
        )
    return shots


def test_a_planted_response_is_estimated_from_the_narrowest_echoes():
    response = inversion.shot_response(records(flat=8, widened=12), fraction=0.4)
    assert set(response.shots) == set(range(8))
    assert response.width == pytest.approx(WIDTH, abs=0.15)
    assert response.tail_fraction == pytest.approx(FRACTION, abs=0.004)
    assert response.tail_decay == pytest.approx(DECAY, rel=0.15)
    # The energy of the response more than a sample's width after its smoothed part is that of the tail.
    lag = np.arange(response.impulse.size) - response.impulse.size // 2
    late = response.impulse[lag > 20].sum()
    assert response.impulse.sum() == pytest.approx(1.0)
    assert late == pytest.approx(FRACTION * np.exp(-20.0 / DECAY), rel=0.1)


def test_a_receiver_without_a_tail_has_none():
    response = inversion.shot_response(records(flat=8, widened=4, tail_fraction=0.0), fraction=0.6)
    assert response.tail_fraction < 0.002


def test_all_shots_together_are_taken_for_a_wider_receiver():
    """Planted: slopes and canopies belong to no receiver; without the selection the width is wrong."""
    response = inversion.shot_response(records(flat=8, widened=12), fraction=1.0)
    assert response.width > WIDTH + 0.5


@pytest.mark.parametrize("fraction", [0.0, 1.5, np.nan])
def test_fractions_outside_their_range_are_refused(fraction):
    with pytest.raises(ValueError, match="fraction"):
        inversion.shot_response(records(flat=3, widened=0), fraction=fraction)


def test_too_few_strong_echoes_are_refused():
    weak = records(flat=4, widened=0)
    for shot in weak[2:]:
        shot.noise_std = 1.0
    with pytest.raises(ValueError, match="2 echoes"):
        inversion.shot_response(weak)


def test_the_response_of_recorded_shots_is_that_of_other_shots_of_the_orbit(shared):
    """The tails of two halves of an orbit agree; widths contain the relief of the flattest ground of each."""
    pytest.importorskip("h5py")
    from jaxlidar.io import read_gedi_l1b

    shots = read_gedi_l1b(shared / "gedi/GEDI01_B_2019108080338_O01964_T05337_02_003_01_sub.h5")
    even, odd = (inversion.shot_response(half) for half in (shots[::2], shots[1::2]))
    assert even.width == pytest.approx(odd.width, abs=1.2)
    assert even.tail_fraction == pytest.approx(odd.tail_fraction, abs=0.02)
    assert min(even.tail_fraction, odd.tail_fraction) > 0.015
