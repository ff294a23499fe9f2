"""Recorded photons of ICESat-2: ground and canopy against the product's at 20 m.

    python examples/validation/recorded_photons.py ATL03 ATL08 [--out figures]

ATL03 is a file of photons of one beam (HDF5), ATL08 one of the product's ground and canopy heights along the
same track, with values at 20 m (version 5 and later). Compared are the segments that both have. Errors are
those of `inversion.photon_ground_and_canopy`, as the product states none at 20 m. Where the product has no
ground, it has no canopy height either: such segments do not tell whether there is a canopy, and are counted
in the text only."""

import sys

import numpy as np
from _validation import COLOURS, comparison, finish, options

import inversion
from jaxlidar import plot
from jaxlidar.io import read_atl03, read_atl08

# Largest shares of segments that may have no canopy here where the product has one, and one where it has
# none.
MISSED_CANOPIES, FALSE_CANOPIES = 0.2, 0.1
# Segments by what the product has there.
CLASSES = ("a canopy", "ground alone", "neither")


def at_segments(product, name, segment_id):
    """Return a column of the product for each segment, NaN for those that it does not have."""
    row_of = {number: row for row, number in enumerate(product["segment_id"])}
    rows = [row_of.get(number) for number in segment_id]
    return np.array([np.nan if row is None else product[name][row] for row in rows])


def statistics(difference):
    """Return the number of differences, their median, median and ninth decile of sizes, and the largest."""
    size = np.abs(difference[np.isfinite(difference)])
    if size.size == 0:
        return {"segments": 0}
    return {
        "segments": int(size.size),
        "median difference": float(np.nanmedian(difference)),
        "median absolute difference": float(np.median(size)),
        "nine in ten below": float(np.quantile(size, 0.9)),
        "largest": float(size.max()),
    }


def text_of(agreement):
    """Say the numbers of how well the heights agree, and which segments have a canopy."""
    texts = ["Left, photons by their class here, with the ground. Right, differences from the product."]
    for name in ("ground", "canopy"):
        numbers = agreement[name]
        texts.append(
            f"The {name} of {numbers['segments']} segments differs by "
            f"{numbers['median absolute difference']:.2f} m in the median, by less than "
            f"{numbers['nine in ten below']:.2f} m in nine of ten."
        )
    numbers = agreement["canopy, photons"]
    texts.append(
        "ATL08's height is a percentile of photons: that of the photons of canopy, over the ground here, "
        f"differs by {numbers['median absolute difference']:.2f} m in the median."
    )
    worst = agreement["ground, good"].get("largest")
    texts.append(f"Good grounds are at most {worst:.2f} m off." if worst else "No ground is rated good.")
    for name in CLASSES:
        segments, canopies = agreement[name].values()
        if segments:
            texts.append(f"Of {segments} segments where ATL08 has {name}, {canopies} have a canopy here.")
    return " ".join(texts)


def main(argv=None):
    arguments = options(__doc__, argv, "atl03", "atl08")
    track = read_atl03(arguments.atl03)
    product = read_atl08(arguments.atl08, segment=20.0)
    heights = inversion.photon_ground_and_canopy(track)
    ground, canopy = (at_segments(product, name, heights.segment_id) for name in ("ground", "canopy"))
    is_good = heights.quality == "good"
    ground_difference, canopy_difference = heights.ground - ground, heights.canopy - canopy
    # The product's definition: a percentile of photons over the ground.
    number = np.searchsorted(track.segment_start, track.distance, side="right") - 1
    has_ground = np.isfinite(heights.ground)
    ground_there = np.interp(track.distance, heights.distance[has_ground], heights.ground[has_ground])
    above = track.height - ground_there
    photon_canopy = np.full(canopy.shape, np.nan)
    for i in np.flatnonzero(np.isfinite(heights.canopy)):
        photon_canopy[i] = np.percentile(above[(number == i) & (heights.label == 2)], 98.0)
    rows = []

    def add(what, i, value, reference, **error):
        case = f"segment {heights.segment_id[i]}"
        rows.append(comparison(what, "ATL08", case, value, reference, unit="m", **error))

    for i in np.flatnonzero(np.isfinite(ground_difference)):
        error = heights.ground_stderr[i]
        add("ground at 20 m", i, heights.ground[i], ground[i], stderr=error)
    for i in np.flatnonzero(np.isfinite(canopy_difference)):
        error = heights.canopy_stderr[i]
        add("canopy height at 20 m", i, heights.canopy[i], canopy[i], stderr=error)
    has_canopy, has_product_canopy = np.isfinite(heights.canopy), np.isfinite(canopy)
    is_bare = np.isfinite(ground) & ~has_product_canopy
    is_neither = np.isnan(ground) & ~has_product_canopy
    for what, is_class, expected, bound in (
        ("segments with a canopy, where the product has one", has_product_canopy, 1.0, MISSED_CANOPIES),
        ("segments with a canopy, where the product has ground alone", is_bare, 0.0, FALSE_CANOPIES),
    ):
        if np.any(is_class):
            share = has_canopy[is_class].mean()
            case = f"{is_class.sum()} segments"
            rows.append(comparison(what, "ATL08", case, share, expected, bound=bound))
    agreement = {
        "ground": statistics(ground_difference),
        "ground, good": statistics(np.where(is_good, ground_difference, np.nan)),
        "canopy": statistics(canopy_difference),
        "canopy, photons": statistics(photon_canopy - canopy),
        **{
            name: {"segments": int(is_class.sum()), "with a canopy here": int((is_class & has_canopy).sum())}
            for name, is_class in zip(CLASSES, (has_product_canopy, is_bare, is_neither), strict=True)
        },
    }

    def draw(figure):
        track_axes, side_axes = figure.subplots(1, 2, width_ratios=(2.0, 1))
        plot.photons(track, ax=track_axes, label=heights.label, markersize=2.5)
        track_axes.errorbar(
            *(heights.distance, heights.ground, 2.0 * heights.ground_stderr),
            **{"fmt": "-", "color": COLOURS[6], "lw": 0.8, "label": "ground, 2 s.e."},
        )
        for value, marker, name in (
            (ground, "s", "ATL08 ground"),
            (ground + canopy, "^", "ATL08 canopy top"),
        ):
            style = {"mfc": "none", "color": COLOURS[1], "ms": 6, "label": name}
            track_axes.plot(heights.distance, value, marker, **style)
        track_axes.legend(loc="upper left", fontsize=7, ncols=2)
        groups = (
            ("ground", ground_difference, heights.ground_stderr, "o", COLOURS[0]),
            ("canopy height", canopy_difference, heights.canopy_stderr, "^", COLOURS[2]),
        )
        for shift, (name, difference, stderr, marker, colour) in zip((-2.0, 2.0), groups):
            style = {"fmt": marker, "ms": 4, "lw": 0.8, "color": colour, "label": name}
            side_axes.errorbar(heights.distance + shift, difference, 2.0 * stderr, **style)
        side_axes.axhline(0.0, color="0.6", lw=0.8)
        side_axes.set(xlabel="distance along the track (m)", ylabel="difference from ATL08 (m)")
        side_axes.set_title("with two standard errors", fontsize=9)
        side_axes.legend(loc="lower left", fontsize=8)

    return finish(
        arguments,
        "recorded_photons",
        rows,
        title="Recorded photons of ICESat-2 against ATL08",
        caption=text_of(agreement),
        unchecked="""No survey of the ground or of tree heights. One short track of low woodland by day, with
        few photons of the ground and no open ground. The heights of 5 to 9 m that the product has between 270
        and 310 m are those of single photons, as many as the background gives. The product's errors at 20 m
        are not stated and not in the bars.""",
        draw=draw,
        of_others=True,
        size=(11.5, 4.6),
        photons=len(track),
        agreement=agreement,
    )


if __name__ == "__main__":
    main()
    sys.exit(0)
