"""Values that no gyroscope at rest gives, told from the file's own numbers, with the evidence.

A recording's values are samples of one device. Each check takes values (n, 3), NaN where there are
none, and returns a text for a message, empty where nothing is wrong.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import trim_mean

from gyro_pipeline.conventions import AXES, InputError

Floats = NDArray[np.float64]


def _whole(values: Floats) -> bool:
    return bool(len(values)) and bool((values == np.rint(values)).all())


def _finite(values: Floats) -> Floats:
    return values[np.isfinite(values).all(axis=1)]


def wrapped(
    values: Floats, bits: Sequence[int] = (12, 14, 16, 20, 24, 32), compact: float = 8
) -> str:
    """Signed counts that were written as unsigned ones.

    Whole numbers without a sign, of which some lie so high that their signed reading is smaller, in
    range or in size, by the factor ``compact``.
    """
    values = _finite(values)
    if not _whole(values) or values.min() < 0:
        return ""
    for width in bits:
        if values.max() >= 2**width:
            continue
        high = values >= 2 ** (width - 1)
        signed = np.where(high, values - 2.0**width, values)
        smaller = np.abs(signed).max(axis=0) * compact <= values.max(axis=0)
        narrower = (np.ptp(signed, axis=0) + 1) * compact <= np.ptp(values, axis=0)
        for axis in np.flatnonzero(high.any(axis=0) & (smaller | narrower)):
            return (
                f"whole numbers from {values[:, axis].min():.0f} to {values[:, axis].max():.0f} "
                f"about {AXES[axis]} read as {signed[:, axis].min():.0f} to "
                f"{signed[:, axis].max():.0f} if they are signed counts of {width} bits; give "
                f"signed_bits: {width}"
            )
    return ""


def signed(values: Floats, bits: int, where: str) -> Floats:
    """Signed counts of unsigned ones.

    Raises:
        InputError: They are not whole numbers of so many bits.
    """
    finite = values[np.isfinite(values)]
    if not _whole(finite) or finite.min() < 0 or finite.max() >= 2**bits:
        raise InputError(
            f"{where}: signed_bits: {bits}: expected whole numbers from 0 to {2**bits - 1}, got "
            f"{finite.min():g} to {finite.max():g}"
        )
    return np.where(values >= 2 ** (bits - 1), values - 2.0**bits, values)


def lost_decimal_points(values: Floats, digits: tuple[int, int] = (6, 9), most: float = 0.9) -> str:
    """Whole numbers of many digits: a spreadsheet took decimal points for separators."""
    values = np.abs(_finite(values))
    many = (values >= 10.0 ** (digits[0] - 1)) & (values < 10.0 ** digits[1])
    if not _whole(values) or many.mean() < most:
        return ""
    return (
        f"whole numbers of {digits[0]} to {digits[1]} digits, such as {values[0, 0]:.0f}: the "
        "decimal points are lost; export the recording again"
    )


def implausible_level(rates: Floats, most_dps: float = 100.0, trimmed: float = 0.1) -> str:
    """A mean that no MEMS gyroscope at rest has; of rates in deg/s."""
    rates = _finite(rates)
    if not len(rates):
        return ""
    means = trim_mean(rates, trimmed, axis=0)
    axis = int(np.abs(means).argmax())
    if abs(means[axis]) <= most_dps:
        return ""
    return (
        f"a mean of {means[axis]:.4g} deg/s about {AXES[axis]}, and no MEMS gyroscope at rest has "
        f"more than {most_dps:g}; check units and scale_dps, or give offset, the count at rest"
    )
