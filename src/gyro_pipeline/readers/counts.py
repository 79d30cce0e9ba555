"""Checks for values that no gyroscope at rest measures.

Each check takes values (n, 3), NaN where missing, and returns the evidence for a message, or an
empty text if the values are plausible.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES
from gyro_pipeline.readers.file import File

Floats = NDArray[np.float64]


def check_values(file: File, raw: Floats, rates: Floats, are_counts: bool) -> None:
    """Contradict values that no gyroscope at rest measures, unless the options explain them.

    Args:
        file: Collects the first contradiction.
        raw: (n, 3), the file's numbers.
        rates: (n, 3), deg/s.
        are_counts: Whether the file's numbers are counts.
    """
    has_offset, text, start = file.options.offset is not None, "", _finite(raw[:100])
    if (start == np.rint(start)).sum() > 0.9 * start.size:  # noqa: PLR2004 - whole numbers
        explained = file.options.signed_bits or has_offset
        text = "" if explained else wrapped(raw)
        text = text or ("" if are_counts else lost_decimal_points(raw))
    text = text or ("" if has_offset else implausible_level(rates))
    if text:
        file.add_contradiction(text)


def wrapped(values: Floats, bits: Sequence[int] = (*range(12, 25), 32), compact: float = 8) -> str:
    """Detect signed counts that were written as unsigned ones.

    Nearly all rows are whole numbers without a sign, and the signed reading of the high ones makes
    the range or the largest value smaller by at least the factor ``compact``.
    """
    counts = values[((values == np.rint(values)) & (values >= 0)).all(axis=1)]
    for width in bits:
        within = counts[(counts < 2**width).all(axis=1)]
        high = within >= 2 ** (width - 1)
        if not high.any() or len(within) < 0.99 * len(_finite(values)):  # noqa: PLR2004
            continue
        signed = np.where(high, within - 2.0**width, within)
        smaller = np.abs(signed).max(axis=0) * compact <= within.max(axis=0)
        narrower = (np.ptp(signed, axis=0) + 1) * compact <= np.ptp(within, axis=0)
        for axis in np.flatnonzero(high.any(axis=0) & (smaller | narrower)):
            low, top = within[:, axis].min(), within[:, axis].max()
            return (
                f"whole numbers from {low:.0f} to {top:.0f} about {AXES[axis]} read as "
                f"{signed[:, axis].min():.0f} to {signed[:, axis].max():.0f} if they are signed "
                f"counts of {width} bits; give signed_bits: {width}"
            )
    return ""


def to_signed(file: File, values: Floats, bits: int) -> Floats:
    """Convert unsigned to signed counts.

    Raises:
        InputError: The values are not whole numbers of this many bits.
    """
    finite = values[np.isfinite(values)]
    if (finite != np.rint(finite)).any() or finite.min() < 0 or finite.max() >= 2**bits:
        raise file.refusal(
            f"signed_bits: {bits}: expected whole numbers from 0 to {2**bits - 1}, got "
            f"{finite.min():g} to {finite.max():g}; correct it"
        )
    return np.where(values >= 2 ** (bits - 1), values - 2.0**bits, values)


def lost_decimal_points(values: Floats, digits: tuple[int, int] = (6, 9), most: float = 0.9) -> str:
    """Detect whole numbers of many digits, as a spreadsheet without decimal points writes them."""
    values = np.abs(_finite(values))
    are_long = (values >= 10.0 ** (digits[0] - 1)) & (values < 10.0 ** digits[1])
    if (are_long & (values == np.rint(values))).mean() < most:
        return ""
    return (
        f"whole numbers of {digits[0]} to {digits[1]} digits, such as {values[0, 0]:.0f}: the "
        "decimal points are lost; export the recording again"
    )


def implausible_level(rates: Floats, most_dps: float = 100.0) -> str:
    """Detect a level of rates, in deg/s, that no MEMS gyroscope at rest has."""
    if np.count_nonzero(np.abs(rates) > most_dps) < rates.size / 6:  # quick, for most recordings
        return ""
    levels = np.median(_finite(rates), axis=0)
    axis = int(np.abs(levels).argmax())
    if not abs(levels[axis]) > most_dps:
        return ""
    return (
        f"a level of {levels[axis]:.4g} deg/s about {AXES[axis]}, but no MEMS gyroscope at rest "
        f"has more than {most_dps:g}; check units and scale_dps, or give offset, the count at rest"
    )


def _finite(values: Floats) -> Floats:
    return values[np.isfinite(values).all(axis=1)]
