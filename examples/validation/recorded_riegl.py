"""Recorded RIEGL shots: two files of the same pulses, and echoes beside the scanner's own points.

    python examples/validation/recorded_riegl.py LAS PLS [--out figures] [--every 10]

LAS is a file of points with waveform packets (.las beside .wdp), PLS the same pulses as PulseWaves (.pls
beside .wvs). Coordinates of the points along the beam are compared with positions by the anchors and
directions of the pulses, and with echoes detected in the samples as copies of the outgoing pulse of each shot
(`inversion.gaussian_decomposition(pulse=...)`). The points come from the software of the scanner.
"""

import sys

import numpy as np
from _validation import by_quantity, comparison, draw_differences, finish, options

import inversion
from jaxlidar.io import read_las_waveforms, read_pulsewaves, stack_shots

# m: files store directions to 1 mm in a range of 150 m or more, and points to 1 mm; a tenth of a sample of 1
# ns.
ANCHOR_BOUND, ECHO_BOUND = 5e-3, 0.015
LAGS = np.arange(-16.0, 17.0)
# Error of the pulse, of its peak: the receiver rings, and counts are not proportional to light.
PULSE_ERROR = 0.05


def main(argv=None):
    arguments = options(__doc__, argv, "las", "pls", every=10)
    shots, pulses = read_las_waveforms(arguments.las), read_pulsewaves(arguments.pls)
    by_time = {round(1e6 * time): number for number, time in enumerate(pulses.gps_time)}
    shots = [shot for shot in shots[:: arguments.every] if len(shot.returning) == 1]
    sent = [pulses[by_time[round(1e6 * shot.gps_time)]].of_channel(1) for shot in shots]
    stack = stack_shots(shots)
    echoes = inversion.gaussian_decomposition(
        stack.time,
        stack.signal,
        noise=np.where(stack.recorded, max(shots[0].noise_std, 1.0), np.inf),
        pulse=np.stack([np.interp(LAGS, p.pulse_time, p.pulse_power, left=0, right=0) for p in sent]),
        pulse_error=PULSE_ERROR,
    )
    points, count = inversion.echo_points(shots, echoes), np.asarray(echoes.count)
    rows, echo_positions = [], np.split(points.position, np.cumsum(count)[:-1])
    n_equal = sum(len(shot.returns.number) == n for shot, n in zip(shots, count))
    n_shots, scanner = len(shots), "the scanner's points"
    what = "shots with as many echoes as points"
    rows.append(comparison(what, scanner, "all shots", n_equal, n_shots, bound=0.05 * n_shots))
    for shot, pulse, echo_places in zip(shots, sent, echo_positions):
        up = -shot.direction / np.linalg.norm(shot.direction)
        scanner_points = shot.returns.position
        (same_segment,) = (s for s in pulse.returning if np.array_equal(s.samples, shot.returning[0].samples))
        times = shot.returns.time + same_segment.start - shot.returning[0].start
        along = [
            ("place by the pulse's anchor", pulse.anchor + times[:, None] * pulse.direction, ANCHOR_BOUND)
        ]
        if len(echo_places) == len(scanner_points):
            along.append(("place of the echo", echo_places, ECHO_BOUND))
        for what, at, bound in along:
            for number, (a, b) in enumerate(
                zip((at - scanner_points[0]) @ up, (scanner_points - scanner_points[0]) @ up)
            ):
                case = f"shot {shot.index}, point {number + 1}"
                rows.append(comparison(f"{what}, along the beam", scanner, case, a, b, bound=bound, unit="m"))

    def draw(figure):
        groups = {w: g for w, g in by_quantity(rows).items() if "place" in w}
        for ax, (what, group) in zip(figure.subplots(1, 2), groups.items()):
            draw_differences(ax, [{**r, "number": i} for i, r in enumerate(group)], "number")
            ax.set(title=what, xlabel="points", ylabel="difference (m)")

    return finish(
        arguments,
        "recorded_riegl",
        rows,
        title="Recorded RIEGL shots against the scanner's points",
        caption="""Left, where the pulses' geometry puts the points: to the millimetres that files keep.
        Right, where echoes are found in the samples: to a small part of a sample, but where two echoes
        overlap. Dashed lines are the bounds.""",
        unchecked="""Both files come from one scanner and one trajectory: an error of their georeference is
        not seen. No targets of known place or reflectance.""",
        draw=draw,
        of_others=True,
        size=(11.0, 4.0),
        shots=len(shots),
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
