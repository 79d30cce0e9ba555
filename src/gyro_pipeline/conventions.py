"""Names, dimensions and units that the whole package shares.

Angular rates and biases are in deg/s everywhere inside the package. Other units appear only where
a person reads or types them, and the name then says so (``noise_mdps_rts``, ``window_s``).

Recordings are :class:`xarray.Dataset` objects with

* ``angular_rate`` (imu, recording, axis, sample), float32, deg/s; NaN beyond the end of a recording
  and where a sample is masked, that is, holds no measurement;
* ``samples`` (imu, recording), the length; 0 where the IMU lacks the recording;
* ``temperature_c`` (imu, recording, sample), degrees Celsius, and ``acceleration_g``
  (imu, recording, axis, sample), g, float32, where the files have them;
* ``true_bias`` (imu, recording, axis), float64, deg/s, on simulated data only;
* the coordinate ``split`` (recording), the role of each recording in a hold-out; absent where so
  few recordings exist that they make a k-fold;
* attributes ``sensor``, ``source``, ``simulated`` (0 or 1), ``rate_hz`` and ``data_hash``.

The recordings of a study (``windowed_splits.recordings``) and virtual recordings all have the same
length, and ``recording_mean`` (imu, recording, axis), deg/s, the label in
training; evaluation computes the paper's truth from the samples in the same way.

A windows table has a row per window: ``protocol, window_s, window_stride_s``; ``fold``, ``role``;
``origin``, real or virtual; ``imu``, ``recording`` and ``start``, the window's first sample.
"""

AXES = ("x", "y", "z")
DIMENSIONS = ("imu", "recording", "axis", "sample")
NOISE_COLUMNS = ("white_dps_rts", "instability_dps", "random_walk_dps_per_rts")
"""Columns of tables with N, B and K."""

MDPS = 1e-3
"""One mdps in deg/s."""

TRAIN, VALIDATION, TEST = "train", "validation", "test"
"""The roles of windows and recordings."""

ALWAYS = "always"
"""Tag of a node that runs every time, because the user waits for what it prints."""

UNSEEN = 0
"""IMU number that stands for any device without training data; real IMUs count from 1."""

UNUSED = ""
"""The role of a window that a fold does not use."""

ORIGIN_REAL, ORIGIN_VIRTUAL = "real", "virtual"
"""Whether the recording of a window is from a real or a virtual IMU."""

HOLD_OUT, ALL_RECORDINGS = "hold-out", "all recordings"
"""Names of folds: the only fold of a hold-out, and the fold without tests that fits the model."""

BY_RECORDING, LEAVE_ONE_DEVICE_OUT, K_FOLD = "by_recording", "leave_one_device_out", "k_fold"
WINDOW_SPLIT = "window_split"
TEST_IN_TRAINING = "test_in_training"
BEST_EPOCH_ON_TEST = "best_epoch_on_test"
"""Protocols. The leaks let test information into training on purpose, only in the leak study."""

PAPER, DISJOINT, TRUE = "paper", "disjoint", "true"
"""The truths that estimates are compared with: (a) the mean of the whole recording, (b) the mean of
the samples outside the window, (c) the simulated bias."""

RECORDING_MEAN, BIAS = "recording_mean", "bias"
"""Targets of an estimator: the mean of the whole recording, which is truth (a), or the bias itself,
which truths (b) and (c) measure and which a user needs."""

TARGET_OF = {PAPER: RECORDING_MEAN, DISJOINT: BIAS, TRUE: BIAS}
"""The target of an estimator, by the truth that it is compared with."""

FIRST, ALL = "first", "all"
"""Windows that are scored: the first that tests in each recording (the paper's way), or all."""

NOTHING, OWN, REAL = "nothing", "own", "real"
"""Parts of a training set that an estimator can use, besides ``ALL`` of it: none of it, the
device's own recordings (all real recordings where the device is unseen), or all real recordings."""

LAST, BEST = "last", "best"
"""Weights at the last epoch (the paper's way), or at the best validation epoch."""


IN_READER = "in `reader:` of the catalog entry in catalog.yml"
"""Where users give options of the reader, for messages."""


class InputError(ValueError):
    """Input that cannot be used; the message says what, where, and what to do."""
