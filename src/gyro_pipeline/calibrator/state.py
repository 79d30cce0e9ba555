"""What the calibrator answers after each call."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.calibrator.reasons import Reason

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STILL, MOVING, UNSURE = "still", "moving", "unsure"
"""At rest, not at rest, or too few blocks to say."""

USED, DROPPED, NONE = "used", "dropped", "none"
"""What became of the history on an axis."""


@dataclass(frozen=True)
class State:
    """The answer so far; NaN and infinity stand where there is no number. Arrays are (3,)."""

    bias_dps: Array  # now; what it settles to, where the device warms up
    sigma_dps: Array  # the bias is within 1.96 of it in 95 % of cases
    own_dps: Array  # by this log alone
    own_sigma_dps: Array
    history_dps: Array  # by the history alone
    history_sigma_dps: Array
    rest: str  # STILL, MOVING or UNSURE
    time_s: float  # since the first sample
    seconds_at_rest: float  # of the stretch that the answer is from
    history: tuple[str, ...]  # USED, DROPPED or NONE for each axis
    reached: bool  # whether all axes are at the target; true where none is given
    look_ahead: Callable[[], Array] = field(repr=False, compare=False)
    explain: Callable[[], Iterable[Reason]] = field(repr=False, compare=False)

    @cached_property
    def reasons(self) -> tuple[Reason, ...]:
        """What should be known about the answer, the most important first."""
        return tuple(self.explain())

    @cached_property
    def seconds_left(self) -> Array:
        """(3,), seconds at rest until the target; infinite where never, NaN without a target."""
        return self.look_ahead()

    @property
    def done(self) -> bool:
        """Whether the target is reached, at rest."""
        return self.rest == STILL and self.reached
