"""Size buckets: sizes of arrays and loops are rounded up, so that most changes compile nothing."""


def size_bucket(size: int, per_octave: int = 2) -> int:
    """Return the smallest bucket that holds `size`.

    There are `per_octave` buckets from one power of two to the next: 1, 2, 3, 4, 6, 8, 12, 16, 24, ... for
    two.
    """
    if size <= 2:
        return size
    # With 2^k < size <= 2^(k + 1), buckets divide the octave from 2^k to 2^(k + 1) evenly. The first octaves
    # have fewer integers than that.
    octave = 1 << ((size - 1).bit_length() - 1)
    buckets = min(per_octave, octave)
    return octave + -(-(size - octave) * buckets // octave) * octave // buckets
