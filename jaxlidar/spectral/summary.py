"""Light that a waveform lacks, and the text of a printed waveform."""

from typing import Any

import numpy as np

from jaxlidar._text import NOTABLE_FRACTION, percent, samples_text
from jaxlidar.spectral.apply_optics import unfollowed_return


def neglected_fractions(wave: Any) -> tuple[float, float]:
    """Return how much light may return of orders beyond the last, and after the record.

    They are the largest fractions, of all wavelengths: the first of the light in the record, the second of
    this and what returns later. `Waveform.neglected` has the sum of both.
    """
    budget = {name: np.asarray(energy) for name, energy in wave.energy_budget.items()}
    total = np.maximum(np.asarray(wave.reflectance).sum(axis=-1), 1e-30)
    unfollowed = neglected = np.asarray(wave.neglected)
    if np.any(budget["after the window"]):
        unfollowed = unfollowed_return(budget["unfollowed"], budget["escaped"], total)
        unfollowed = np.minimum(neglected, unfollowed)
    outside = neglected - unfollowed
    fractions = unfollowed / total, outside / (total + outside)
    return float(np.max(fractions[0], initial=0.0)), float(np.max(fractions[1], initial=0.0))


def summary(wave: Any) -> str:
    """Describe a waveform in a few lines: its samples, energy budget and accuracy; many scenes in one."""
    wavelengths, total = np.asarray(wave.wavelength, float), np.asarray(wave.reflectance).sum(axis=-1)
    n_columns = min(len(wavelengths), 4)
    samples = samples_text(np.asarray(wave.time, float))
    if wave.has_scenes:
        return f"{len(wave)} waveforms of {samples}, at {', '.join(f'{w:g}' for w in wavelengths)} nm"
    title = f"Waveform of {samples}"
    rows = {
        "wavelength (nm)": [f"{w:g}" for w in wavelengths[:n_columns]],
        "apparent reflectance": [f"{r:.4g}" for r in total[:n_columns]],
        **{
            f"{name} (% of the light)": [f"{100 * float(f):.3g}" for f in np.asarray(fractions)[:n_columns]]
            for name, fractions in wave.energy_budget.items()
            # Fates that would be printed as 0.00 % are left out.
            if name != "returned" and np.max(np.asarray(fractions)) >= 5e-5
        },
    }
    if n_columns < len(wavelengths):
        for cells in rows.values():
            cells.append("...")
    width = max(map(len, rows))
    lines = [
        title,
        *(f"  {name.ljust(width)}  " + "  ".join(c.rjust(8) for c in cells) for name, cells in rows.items()),
    ]
    unfollowed, outside = neglected_fractions(wave)
    if outside >= NOTABLE_FRACTION:
        lines.append(f"  {percent(outside)} of the returned light is still on its way when the record ends")
    if unfollowed >= NOTABLE_FRACTION:
        lines.append(f"  orders beyond the last may add {percent(unfollowed)}")
    info = wave.info
    if info:
        lines.append(
            f"  {info.get('photons', 0):,} photons in {info.get('seconds', 0.0):.2g} s, relative error "
            f"{info.get('error', 0.0):.2g}: {info.get('stopped', '')}"
        )
    return "\n".join(lines)
