"""Sizes of compiled programs: a short ladder of them, so that most changes of a scene compile nothing."""


def rung(size: int, per_octave: int = 2) -> int:
    """The smallest size on the ladder that is not less than `size`.

    The ladder has `per_octave` rungs from one power of two to the next: 1, 2, 3, 4, 6, 8, 12, 16, 24, ...
    """
    if size <= 2:
        return size
    octave = 1 << ((size - 1).bit_length() - 1)
    steps = min(per_octave, octave)
    return octave + -(-(size - octave) * steps // octave) * octave // steps
