"""The crown of `examples/benchmarks/peers.py` by jaxlidar and by another code, compared sum by sum."""

import tempfile
from pathlib import Path

import numpy as np
from _validation import COLOURS, draw_differences, finish, row, steps
from peers import CASES, FIRST, WINDOW, block_sums, crown, ours, peer, sampled, task


def moments(samples):
    """Mean over repetitions, and its standard error."""
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def rows_of(code, case, own, theirs, timing):
    """The light returned in all, and in sums of 5 ns above 1 % of the largest.

    Where the times of the other code are uncertain by up to `timing` ns either way, so are its sums.
    """
    at, mean = np.arange(own.shape[1]), own.mean(axis=0)
    late, early = (np.interp(at + shift, at, mean) for shift in (-timing, timing))
    moved = block_sums((late - early)[None])[0] / 2 / np.sqrt(3)
    parts, others = block_sums(own), block_sums(theirs)
    bright = parts.mean(axis=0) > 0.01 * parts.mean(axis=0).max()
    middle = WINDOW[0] + FIRST + 2 + 5 * np.arange(bright.size)
    (a, da), (b, db) = moments(own.sum(axis=1)), moments(theirs.sum(axis=1))
    yield row("returned in all", code, case, a, b, stderr=np.hypot(da, db))
    for t, *values in np.column_stack([middle, *moments(parts), *moments(others), moved])[bright]:
        a, da, b, db, blur = values
        name = f"returned in 5 ns: {case}"
        yield row(name, code, f"{t:g} ns", a, b, stderr=np.linalg.norm([da, db, blur]), time=float(t))


def compare(given, name, code, worker, cases, *, orders, pulse, asked=(), timing=0.0, **told):
    """Run both codes, and write the record.

    `cases` are names of `peers.CASES`; `asked` is what else the worker is given.
    """
    extinction = crown()
    mine = {c: ours(extinction, c, pulse, given.repeats, orders)["waves"] for c in steps(given, cases)}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "given.npz")
        np.savez(file, **task(extinction, given.repeats) | {"orders": orders} | dict(asked))
        found = peer(worker, file)
    if isinstance(found, str):
        raise SystemExit(f"{code} does not run here: {found}")
    if not found.get("corrected", True):
        raise SystemExit(f"{code}: its path lengths could not be corrected (see {worker})")
    rows = []
    for case in cases:
        theirs = sampled(found[f"{case}_waves"], pulse)
        rows += rows_of(code, CASES[case], mine[case], theirs, timing)

    def draw(figure):
        axes = figure.subplots(2, len(cases), squeeze=False, sharex="col", height_ratios=(2, 1)).T
        for (top, low), case in zip(axes, cases):
            group = [r for r in rows if r["what"] == f"returned in 5 ns: {CASES[case]}"]
            t = [r["time"] for r in group]
            for who, label, how in (("here", "jaxlidar", "-"), ("there", code, "o")):
                top.semilogy(t, [r[who] for r in group], how, ms=4, mfc="none", label=label)
            top.set(title=CASES[case], ylabel="apparent reflectance in 5 ns")
            top.legend()
            draw_differences(low, [{**r, "difference": r["difference"] / r["there"],
                                    "standard error": r["standard error"] / r["there"]} for r in group],
                             "time", color=COLOURS[1])  # fmt: skip
            low.set(xlabel="time (ns)", ylabel="relative difference")

    notes = {"code": str(found["version"]), "repetitions": given.repeats, "orders": orders}
    return finish(given, name, rows, draw=draw, size=(5.0 * len(cases) + 1.0, 6.0), **told, **notes)
