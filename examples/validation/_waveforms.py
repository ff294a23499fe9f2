"""Waveforms by jaxlidar and by another code, compared by their totals and by sums of 5 ns."""

import numpy as np
from _validation import COLOURS, comparison, draw_differences
from peers import FIRST_SAMPLE, WINDOW, block_sums


def moments(samples):
    """Return the mean over repetitions, and its standard error."""
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def rows_of(code, case, ours, theirs, timing=0.0):
    """Yield comparisons of the total, and of sums of 5 ns above 1 % of the largest.

    The times of the other code are uncertain by up to `timing` ns; the effect on its sums is part of their
    error.
    """
    sample_number, mean = np.arange(ours.shape[1]), ours.mean(axis=0)
    late, early = (np.interp(sample_number + shift, sample_number, mean) for shift in (-timing, timing))
    timing_error = block_sums((late - early)[None])[0] / 2 / np.sqrt(3)
    our_sums, their_sums = block_sums(ours), block_sums(theirs)
    bright = our_sums.mean(axis=0) > 0.01 * our_sums.mean(axis=0).max()
    middle = WINDOW[0] + FIRST_SAMPLE + 2 + 5 * np.arange(bright.size)
    (our_value, our_error), (their_value, their_error) = (
        moments(ours.sum(axis=1)),
        moments(theirs.sum(axis=1)),
    )
    yield comparison(
        "returned in all", code, case, our_value, their_value, stderr=np.hypot(our_error, their_error)
    )
    for t, *values in np.column_stack([middle, *moments(our_sums), *moments(their_sums), timing_error])[
        bright
    ]:
        our_value, our_error, their_value, their_error, timing_blur = values
        name = f"returned in 5 ns: {case}"
        yield comparison(
            name,
            code,
            f"{t:g} ns",
            our_value,
            their_value,
            stderr=np.linalg.norm([our_error, their_error, timing_blur]),
            time=float(t),
        )


def draw_cases(figure, rows, code, cases):
    """Draw the waveforms of all cases, and below them their relative differences."""
    axes = figure.subplots(2, len(cases), squeeze=False, sharex="col", height_ratios=(2, 1)).T
    for (top, low), case in zip(axes, cases):
        group = [r for r in rows if r["what"] == f"returned in 5 ns: {case}"]
        t = [r["time"] for r in group]
        for who, label, how in (("here", "jaxlidar", "-"), ("there", code, "o")):
            top.semilogy(t, [r[who] for r in group], how, ms=4, mfc="none", label=label)
        top.set(title=case, ylabel="apparent reflectance in 5 ns")
        top.legend()
        draw_differences(
            low,
            [
                {
                    **r,
                    "difference": r["difference"] / r["there"],
                    "standard error": r["standard error"] / r["there"],
                }
                for r in group
            ],
            "time",
            color=COLOURS[1],
        )
        low.set(xlabel="time (ns)", ylabel="relative difference")
