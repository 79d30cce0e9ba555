"""Names, dimensions and units, said once.

Angular rates and biases are in deg/s everywhere inside the package; other units appear only
where a person reads or types them, and the name then says so (``noise_mdps_rts``, ``window_s``).

Recordings are :class:`xarray.Dataset` objects with

* ``angular_rate`` (imu, recording, axis, sample), float32, deg/s; NaN beyond the recording's length
  and where it is masked: where a sample holds no measurement;
* ``samples`` (imu, recording), the length; 0 where the IMU lacks the recording;
* ``temperature_c`` (imu, recording, sample), degrees Celsius, and ``acceleration_g``
  (imu, recording, axis, sample), g, float32, where the files have them;
* ``true_bias`` (imu, recording, axis), float64, deg/s, on simulated data only;
* ``given_split`` (recording), ``"train"`` or ``"test"``, where the source came split;
* attributes ``sensor``, ``source``, ``simulated`` (0 or 1), ``rate_hz`` and ``data_hash``.

Those of a study (``windowed_splits.recordings``) are all of one length.
"""

from dataclasses import dataclass

AXES = ("x", "y", "z")
DIMENSIONS = ("imu", "recording", "axis", "sample")

MDPS = 1e-3
"""deg/s in one mdps."""

HOLD_OUT = -1
"""The ``fold`` of a run on the fixed hold-out split."""

LEAVE_ONE_DEVICE_OUT = "leave_one_device_out"
"""The ``protocol`` by which every IMU in turn is an unseen device; else recordings are held out."""

TRAIN, VALIDATION, TEST = "train", "validation", "test"
"""The roles a recording can have. It has exactly one of them in each fold."""

TEST_IMU = 1
"""All published results are on the three gyroscopes of IMU 1 (paper, section IV-B)."""

PAPER, DISJOINT, TRUE = "paper", "disjoint", "true"
"""The truths an estimate is judged against: (a) mean of the whole recording, (b) mean of the
samples outside the window, (c) the drawn bias of simulated data."""

RECORDING_MEAN, BIAS = "recording_mean", "bias"
"""Targets an estimator can be asked for: the mean of the whole recording, which truth (a) is, or
the bias itself, which truths (b) and (c) are about and what a user deploys."""

TARGET_OF = {PAPER: RECORDING_MEAN, DISJOINT: BIAS, TRUE: BIAS}
"""What an estimator is asked for, by the truth that judges it."""

FIRST, ALL = "first", "all"
"""Test windows: the first of each recording (the paper's way), or all non-overlapping ones."""

NOTHING, OWN, REAL = "nothing", "own", "real"
"""Parts of a training set that an estimator can use, beside ``ALL`` of it: none, the device's own
recordings (or all real ones where the device is unseen), or all real ones."""

ORIGIN_REAL, ORIGIN_VIRTUAL = "real", "virtual"
"""Where a window of a windows table is from: a real IMU, or a virtual one."""

LAST, BEST = "last", "best"
"""Weights at the last epoch (the paper's way), or at the best validation epoch."""

NO_LEAK = "none"
WINDOW_SPLIT = "window_split"
TEST_IN_TRAINING = "test_in_training"
BEST_EPOCH_ON_TEST = "best_epoch_on_test"
LEAKS = (NO_LEAK, WINDOW_SPLIT, TEST_IN_TRAINING, BEST_EPOCH_ON_TEST)
"""How test information reaches a training of the leak study on purpose; no other study has any."""


class InputError(ValueError):
    """Input that cannot be used; the message says what, where, and what to do."""


@dataclass(frozen=True)
class Missing:
    """In place of a result: what it could not be made from."""

    reasons: tuple[str, ...]
