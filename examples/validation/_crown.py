"""The crown of `examples/benchmarks/peers.py` by jaxlidar and by another code."""

from functools import partial

from _peer import run_peer
from _validation import finish, with_progress
from _waveforms import draw_cases, rows_of
from peers import CASES, crown_extinction, run_jaxlidar, sampled, worker_task


def compare(
    arguments, name, code, worker, cases, *, orders, pulse, worker_options=(), timing=0.0, **page_texts
):
    """Run both codes, and write the record.

    `cases` are names of `peers.CASES`; `worker_options` are further numbers for the worker.
    """
    extinction = crown_extinction()
    our_waves = {
        c: run_jaxlidar(extinction, c, pulse, arguments.repeats, orders)["waves"]
        for c in with_progress(arguments, cases)
    }
    task = worker_task(extinction, arguments.repeats) | {"orders": orders} | dict(worker_options)
    measurements = run_peer(worker, task)
    if isinstance(measurements, str):
        raise SystemExit(f"{code} does not run here: {measurements}")
    if not measurements.get("corrected", True):
        raise SystemExit(f"{code}: its path lengths could not be corrected (see {worker})")
    rows = []
    for case in cases:
        theirs = sampled(measurements[f"{case}_waves"], pulse)
        rows += rows_of(code, CASES[case], our_waves[case], theirs, timing)
    draw = partial(draw_cases, rows=rows, code=code, cases=[CASES[case] for case in cases])
    notes = {"code": str(measurements["version"]), "repetitions": arguments.repeats, "orders": orders}
    return finish(arguments, name, rows, draw=draw, size=(5.0 * len(cases) + 1.0, 6.0), **page_texts, **notes)
