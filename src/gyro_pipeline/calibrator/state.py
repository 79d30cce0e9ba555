"""What the calibrator says after each call."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STILL, MOVING, UNSURE = "still", "moving", "unsure"
"""At rest, not at rest, or too few blocks to say."""

USED, DROPPED, NONE = "used", "dropped", "none"
"""What became of the history on an axis."""


@dataclass(frozen=True)
class Reason:
    """Something that a user or a program should know.

    Attributes:
        code: One word for programs, such as ``conflict``, ``motion`` or ``floor``.
        sentence: The same for people.
        axis: x, y or z; None where it is of all.
        value: What was found, in the unit of the sentence.
        limit: What it was compared with.
    """

    code: str
    sentence: str
    axis: str | None = None
    value: float | None = None
    limit: float | None = None


@dataclass(frozen=True)
class State:
    """The answer so far; NaN and infinity stand where there is no number.

    Attributes:
        bias_dps: (3,), the bias now: what it settles to, where the device warms up.
        sigma_dps: (3,), its standard deviation; 1.96 of it to both sides hold the bias in 95 %.
        own_dps: (3,), by this log alone.
        own_sigma_dps: (3,), of that.
        history_dps: (3,), by the history alone.
        history_sigma_dps: (3,), of that.
        rest: STILL, MOVING or UNSURE.
        time_s: Seconds since the first sample.
        seconds_at_rest: Of the stretch that the answer is from.
        history: Three of USED, DROPPED and NONE.
        reasons: What should be known.
        reached: Whether the target is, on all axes; true where none is given.
        look_ahead: Makes ``seconds_left``, which takes some time.
    """

    bias_dps: Array
    sigma_dps: Array
    own_dps: Array
    own_sigma_dps: Array
    history_dps: Array
    history_sigma_dps: Array
    rest: str
    time_s: float
    seconds_at_rest: float
    history: tuple[str, ...]
    reasons: tuple[Reason, ...]
    reached: bool
    look_ahead: Callable[[], Array] = field(repr=False, compare=False)

    @cached_property
    def seconds_left(self) -> Array:
        """(3,), seconds at rest until the target; infinite where never, NaN without a target."""
        return self.look_ahead()

    @property
    def done(self) -> bool:
        """Whether the target is reached, at rest."""
        return self.rest == STILL and self.reached
