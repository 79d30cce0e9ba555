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
* the coordinate ``split`` (recording), the role of each recording in a hold-out; none where few
  recordings make a k-fold;
* attributes ``sensor``, ``source``, ``simulated`` (0 or 1), ``rate_hz`` and ``data_hash``.

Those of a study (``windowed_splits.recordings``) are all of one length, and have
``recording_mean`` (imu, recording, axis), deg/s, the truth of the paper, as virtual ones do.

A windows table has a row per window: ``protocol, window_s, window_stride_s``; ``fold``, ``role``;
``origin``, real or virtual; ``imu``, ``recording`` and ``start``, its first sample.
"""

AXES = ("x", "y", "z")
DIMENSIONS = ("imu", "recording", "axis", "sample")

MDPS = 1e-3
"""deg/s in one mdps."""

TRAIN, VALIDATION, TEST = "train", "validation", "test"
"""The roles of windows and recordings."""

ALWAYS = "always"
"""Tag of a node that is run each time, since somebody waits for what it prints."""

UNSEEN = 0
"""In place of the number of an IMU, of which the first is 1: any that is not there."""

UNUSED = ""
"""The role of a window that has none in a fold."""

ORIGIN_REAL, ORIGIN_VIRTUAL = "real", "virtual"
"""Where the recording of a window comes from."""

HOLD_OUT, ALL_RECORDINGS = "hold-out", "all recordings"
"""Folds: the only one of a hold-out, and one in which nothing tests, of which the model is."""

BY_RECORDING, LEAVE_ONE_DEVICE_OUT, K_FOLD = "by_recording", "leave_one_device_out", "k_fold"
WINDOW_SPLIT = "window_split"
TEST_IN_TRAINING = "test_in_training"
BEST_EPOCH_ON_TEST = "best_epoch_on_test"
LEAKS = (WINDOW_SPLIT, TEST_IN_TRAINING, BEST_EPOCH_ON_TEST)
"""Protocols; the leaks let test information into training on purpose, in the leak study alone."""

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


class InputError(ValueError):
    """Input that cannot be used; the message says what, where, and what to do."""
