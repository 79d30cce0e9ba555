"""Typed parameters: every key that ``conf/*/parameters`` may hold, with its unit and source.

An unknown key or a value out of bounds is refused in every run. What one part requires of another,
for example a study of a sensor, is checked only for the studies that will run
(:func:`gyro_pipeline.studies.check_possible`). Both checks happen before any node runs.
"""

import json
import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from gyro_pipeline.conventions import AXES, LEAVE_ONE_DEVICE_OUT, InputError
from gyro_pipeline.units import read_unit

Size = Annotated[float, Field(ge=0)]
PerAxis = Annotated[tuple[Size, Size, Size], Strict(False)]
Seconds = Annotated[float, Field(gt=0)]
Gyroscopes = Annotated[int, Field(ge=0, multiple_of=len(AXES), description="a count of axes")]
Seed = Annotated[int, Field(ge=0, lt=2**63)]

LEAST_BLOCKS = 10
"""Fewest blocks whose means quality control compares; fewer do not determine their scatter."""


class Parameter(BaseModel):
    """Base of all groups: immutable, without unknown keys, with numbers that are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def _refuse_duplicates(name: str, values: Sequence[Any]) -> None:
    if len(set(values)) < len(values):
        raise ValueError(f"{name}: expected different values, got one of them twice in {values}")


class WarmUp(Parameter):
    """A bias that settles after power-on: amplitude times exp(-t / time constant)."""

    amplitude_mdps: float = Field(description="its mean over power-ons, at power-on")
    spread_mdps: float = Field(ge=0, description="its standard deviation over power-ons")
    time_constant_s: Annotated[tuple[Seconds, Seconds], Strict(False)] = Field(
        description="shortest and longest, uniform between them; one number: for all power-ons"
    )

    @field_validator("time_constant_s", mode="before")
    @classmethod
    def _expand_number(cls, value: Any) -> Any:
        return (value, value) if type(value) in (int, float) else value

    @field_validator("time_constant_s")
    @classmethod
    def _check_order(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] > value[1]:
            raise ValueError(f"time_constant_s: expected shortest, longest; got {value}")
        return value


class SimulatedNoise(Parameter):
    """Noise of a simulated sensor, the stand-in for files (sources: conf/base/globals.yml)."""

    noise_mdps_rts: PerAxis = Field(description="N per axis: the mean of t s scatters by N/sqrt(t)")
    turn_on_spread_mdps: PerAxis = Field(description="tau per axis: bias from power-on to power-on")
    unit_bias_dps: float = Field(ge=0, description="biases of units are uniform within +- this")
    lag1_correlation: float = Field(0.0, gt=-0.5, lt=0.5, description="of successive samples")
    flicker_mdps: float = Field(0.0, ge=0, description="bias instability B; 0 is white noise")
    random_walk_mdps_per_rts: float = Field(
        0.0, ge=0, description="K: a walk from power-on, whose variance after t s is K^2 t"
    )
    warm_up: WarmUp | None = Field(None, description="drawn for each axis separately; null: none")


def _implied_rate(fields: dict[str, Any]) -> float | None:
    """Sample rate in Hz from the samples and the length of a recording, if both are set."""
    samples, recording_s = fields.get("samples"), fields.get("recording_s")
    return samples / recording_s if samples and recording_s else None


class Sensor(Parameter):
    """One brand of gyroscope.

    Files need none of these values, except the rate where they have no timestamps. All others
    describe a simulated stand-in (:class:`SimulatedSensor`) and allow studies to be checked early.
    """

    imus: int | None = Field(None, ge=1)
    recordings: int | None = Field(None, ge=2, description="power-ons per IMU")
    train_recordings: int | None = Field(
        None, ge=1, description="number of them in the training file"
    )
    samples: int | None = Field(None, ge=2, description="per recording and axis")
    recording_s: float | None = Field(None, gt=0, description="T, seconds (paper, section IV-A)")
    rate_hz: float | None = Field(
        default_factory=_implied_rate,
        gt=0,
        description="expected sample rate; null: samples / recording_s, or measured by timestamps",
    )
    simulated: SimulatedNoise | None = None

    @model_validator(mode="after")
    def _some_recordings_are_for_testing(self) -> Self:
        if (
            self.recordings is not None
            and self.train_recordings is not None
            and self.train_recordings >= self.recordings
        ):
            raise ValueError("train_recordings must leave at least one recording for testing")
        return self


class SimulatedSensor(Sensor):
    """A sensor with everything that a simulation needs."""

    imus: int = Field(ge=1)
    recordings: int = Field(ge=2)
    train_recordings: int = Field(ge=1)
    samples: int = Field(ge=2)
    recording_s: float = Field(gt=0)
    rate_hz: float = Field(gt=0)
    simulated: SimulatedNoise

    @model_validator(mode="after")
    def _counts_and_rate_agree(self) -> Self:
        implied = self.samples / self.recording_s
        if not math.isclose(self.rate_hz, implied, rel_tol=1e-6):
            raise ValueError(
                f"rate_hz is {self.rate_hz:g}, samples / recording_s {implied:g}; correct one"
            )
        return self


Column = Annotated[
    str | Annotated[int, Field(ge=0)], Field(description="a name, or a number from 0")
]
Triple = Annotated[tuple[Column, Column, Column], Strict(False)]


class ReaderOptions(Parameter):
    """How the files of a logger are read; the header or the format decides what is null.

    The options must agree with what a file says about itself. Where they differ, the file is
    refused unless ``trust: options`` is set.
    """

    format: Literal[
        "auto",
        "general",
        "movella_dot",
        "movella_dot_angles",
        "xsens_mt_manager",
        "openlog_artemis",
        "ros_imu",
        "px4_sensor_combined",
    ] = Field(
        "auto", description="of a vendor (readers.FORMATS); general: no vendor; auto: recognised"
    )
    columns: Triple | dict[int, Triple] | None = Field(
        None, description="angular rates about x, y, z; or a mapping from IMU numbers to these"
    )
    units: str | None = Field(
        None, description="of the rates, angle per time or raw; with increments, of the angle"
    )
    scale_dps: float | None = Field(None, gt=0, description="deg/s per count; with units: raw only")
    offset: float | None = Field(None, description="count at a rate of 0; with units: raw only")
    signed_bits: int | None = Field(
        None, ge=2, le=32, description="width of signed counts that were written as unsigned ones"
    )
    increments: bool = Field(False, description="the columns hold angles turned since the last row")
    time_column: Column | None = None
    time_units: str | Seconds | None = Field(
        None, description="of the time column; a number: seconds per tick"
    )
    time_is: Literal["steps"] | None = Field(
        None, description="steps: the time column holds the time since the last row"
    )
    temperature_column: Column | None = Field(
        None, description="degrees Celsius, unless its header says another unit"
    )
    acceleration_columns: Triple | None = Field(None, description="along x, y, z")
    acceleration_units: str | None = Field(None, description="such as g, mg or m/s^2")
    counter_column: Column | None = Field(None, description="packet counter, one packet per row")
    counter_bits: int | None = Field(
        None,
        ge=2,
        le=32,
        description="width of the counter, which wraps; null: the format's, or 16",
    )
    trust: Literal["options"] | None = Field(
        None, description="options: these options overrule what the file says about itself"
    )
    encoding: str | None = Field(None, description="of a text file; null: UTF-8 or UTF-16")
    delimiter: str | None = Field(
        None,
        min_length=1,
        max_length=1,
        description="of a text file; a blank: one or more blanks; null: recognised",
    )
    row: str | None = Field(
        None, description="regular expression with named groups; each line it matches is a row"
    )
    rows: dict[Column, str | float] = Field(
        {}, description="only rows with these values in these columns, such as {sensor: 1}"
    )
    repeats: Literal["drop"] | None = Field(
        None, description="drop: a row that repeats the rates of the previous row is not a sample"
    )
    topic: str | None = Field(None, description="of the rates in a flight log or a bag")
    instance: int | None = Field(
        None, ge=0, description="of the sensor, from 0, in a flight log of several"
    )
    largest_mb: float = Field(
        1000.0, gt=0, description="size of a binary file's unpacked values, at 8 bytes each"
    )
    rate_tolerance_pct: float = Field(
        2.0, gt=0, description="by which a measured sample rate may differ from the expected one"
    )

    @field_validator("time_units", "acceleration_units")
    @classmethod
    def _units_of_time_and_acceleration_are_valid(
        cls, value: str | float | None, info: ValidationInfo
    ) -> str | float | None:
        quantity = "time" if info.field_name == "time_units" else "acceleration"
        if isinstance(value, str):
            _check_unit(str(info.field_name), value, quantity)
        return value

    @model_validator(mode="after")
    def _units_suit_the_columns(self) -> Self:
        if self.units not in (None, "raw"):
            _check_unit("units", str(self.units), "angle" if self.increments else "rate")
        if (self.units == "raw") != (self.scale_dps is not None):
            raise ValueError("units: raw and scale_dps go together: give both or neither")
        if self.offset is not None and self.units != "raw":
            raise ValueError("offset: applies to raw counts: give units: raw and scale_dps as well")
        if self.increments and self.units == "raw":
            raise ValueError("increments: expected an angle in units, got raw")
        return self


def _check_unit(option: str, text: str, quantity: str) -> None:
    unit = read_unit(text)
    if unit is None or unit.quantity != quantity:
        examples = {
            "rate": "of angle per time, such as deg/s, rad/s, mdps, deg/h or rpm, or raw",
            "angle": "of an angle, such as deg or rad, as increments are angles",
            "time": "of time, such as s, ms, us or ns, or a number of seconds per tick",
            "acceleration": "of acceleration, such as g, mg or m/s^2",
        }
        raise ValueError(f"{option}: expected a unit {examples[quantity]}, got {text!r}")


class Quality(Parameter):
    """Thresholds of the quality control of recordings (gyro_pipeline.quality).

    Other thresholds are multiples of the recording's own noise, chosen by ``false_alarm``.
    """

    least_s: float = Field(gt=0, description="least length of the usable samples, seconds")
    least_share: float = Field(
        gt=0, le=1, description="least share of unmasked rows between two gaps"
    )
    false_alarm: float = Field(
        gt=0, lt=0.5, description="probability of an alarm, for each check of a recording at rest"
    )
    block_s: float = Field(gt=0, description="length of the blocks whose means are compared, s")
    least_change_dps: float = Field(
        gt=0,
        description="change of the mean within half a minute that is motion, deg/s; a bias drifts "
        "by less",
    )
    shock_s: float = Field(gt=0, description="a burst of at least this length, seconds, is motion")
    largest_step: float = Field(
        gt=0, description="largest ratio of quantisation step to noise at which means are accurate"
    )
    drift_mdps: float = Field(ge=0, description="least warm-up or drift that is reported, mdps")
    largest_noise_dps: float = Field(gt=0, description="of a sample at rest, deg/s")
    largest_drift_dps: float = Field(gt=0, description="of a recording at rest, deg/s")
    length_s: float | None = Field(
        None,
        gt=0,
        description="length to which recordings are cut, seconds; shorter ones are rejected; "
        "null: recordings keep their length, and studies cut them to a common one",
    )
    needed_pct: float = Field(
        90.0,
        gt=0,
        le=100,
        description="least share of recordings, of a sensor and of the tested IMU, that must "
        "remain, percent",
    )

    @model_validator(mode="after")
    def _lengths_hold_blocks(self) -> Self:
        if self.least_s < LEAST_BLOCKS * self.block_s:
            raise ValueError(
                f"least_s: {self.least_s:g} s; expected at least {LEAST_BLOCKS} blocks of block_s, "
                f"{self.block_s:g} s, whose scatter is compared"
            )
        return self


class GroundTruth(Parameter):
    """How the bias of a recording and the noise of a gyroscope are measured."""

    tolerance_mdps: float = Field(gt=0, description="band in which the running mean must stay")


class VirtualGyros(Parameter):
    """Dataset-3 and Dataset-4 (paper, section IV-A)."""

    imus: int = Field(ge=1, description="virtual IMUs of three gyroscopes each")
    recordings: int = Field(ge=1)
    train_recordings: int = Field(ge=1, description="number of the first recordings, which train")
    turn_on_jitter_mdps: float = Field(
        ge=0, description="0: one bias for all recordings of a virtual gyroscope, as in the paper"
    )
    seed: Seed


class Splits(Parameter):
    """Which recordings train, validate and test."""

    test_fraction: float = Field(
        gt=0, lt=1, description="of the recordings, unless the source comes split"
    )
    validation_recordings: int = Field(ge=0, description="of the training ones; paper: 0")
    fold_validation_recordings: int = Field(ge=0, description="of each fold of a k-fold")
    training_windows: Literal["all", "first"] | Seconds = Field(
        "all",
        description="of a recording: all that do not overlap, only the first, or a stride in "
        "seconds from one window to the next",
    )
    k_fold_below: int = Field(ge=0, description="fewer recordings than this: k-fold by recording")
    leave_one_out_up_to: int = Field(ge=0, description="up to this many recordings: one fold each")
    folds: int = Field(ge=2, description="of a k-fold that is not leave-one-out")
    split_seed: Seed


class NetworkSizes(Parameter):
    """Sizes of the network that the paper leaves open (section III-D)."""

    channels: int = Field(ge=1)
    kernel: int = Field(ge=1, description="samples")
    stride: int = Field(ge=1, description="samples")
    pool: int = Field(ge=1, description="convolution outputs")
    hidden: int = Field(ge=1)

    @property
    def hop(self) -> int:
        """Samples from one pooled output to the next."""
        return self.stride * self.pool


class Training(NetworkSizes):
    """The network's sizes and its schedule (paper, sections III-D and IV)."""

    centring: Literal["per_device", "global"] = Field(
        description="subtract each gyroscope's own training mean, or one mean of all gyroscopes"
    )
    epochs: int = Field(ge=1, le=10**6)
    batch_size: int = Field(ge=1)
    learning_rate: float = Field(gt=0, le=1, description="of Adam, at the first epoch")
    decay: float = Field(gt=0, le=1, description="factor on the learning rate ...")
    decay_every: int = Field(ge=1, description="... after this many epochs")
    stop_below: float = Field(
        0.0,
        ge=0,
        description="training ends once the remaining learning rates sum to less; 0: never early",
    )
    steps: int | None = Field(
        None,
        ge=1,
        le=10**7,
        description="least number of optimiser steps, instead of epochs, whose number then follows "
        "from the number of windows; null: epochs",
    )

    @model_validator(mode="after")
    def _an_epoch_remains(self) -> Self:
        if self.steps is None:
            self.learning_rates(1)
        return self

    @property
    def schedule(self) -> dict[str, Any]:
        """The settings that all networks share, whatever their options."""
        return self.model_dump(exclude={*NetworkSizes.model_fields})

    def learning_rates(self, windows: int) -> np.ndarray:
        """Learning rate of every epoch, shape (epochs,), for a number of training windows.

        Raises:
            InputError: Training would end before the first epoch.
        """
        epochs = self.epochs
        if self.steps is not None:
            epochs = -(-self.steps // -(-windows // self.batch_size))
        rates = self.learning_rate * self.decay ** (np.arange(epochs) // self.decay_every)
        remaining = rates[::-1].cumsum()[::-1]
        if remaining[0] < self.stop_below:
            raise InputError(
                f"stop_below: {self.stop_below:g} leaves no epoch to train, as all learning rates "
                f"sum to {remaining[0]:.3g}; expected less"
            )
        return rates[remaining >= self.stop_below]


class Execution(Parameter):
    """How the trainings are run; this affects their results by rounding only."""

    executor: Literal["auto", "processes", "serial", "batched", "dask"] = Field(
        description="batched: many at once, on a GPU if there is one; processes and serial: on the "
        "CPU, in parallel or one after the other; dask: on the workers of a scheduler; auto: "
        "batched with a GPU, else processes"
    )
    workers: int | None = Field(ge=1, description="processes; null: one per core")
    scheduler: str | None = Field(None, description="address of dask's, tcp://HOST:8786")
    folder: str | None = Field(
        None, description="for dask, visible to all workers; null: the temporary folder"
    )

    @model_validator(mode="after")
    def _dask_has_a_scheduler(self) -> Self:
        if (self.executor == "dask") != (self.scheduler is not None):
            raise ValueError("executor dask and scheduler=tcp://HOST:8786 go together: give both")
        return self


class Grid(Parameter):
    """The networks that a study trains on a sensor: all combinations of the lists."""

    method: int = Field(
        ge=1, le=2, description="more gyroscopes are 1: input channels; 2: training data"
    )
    real_gyros: list[Gyroscopes] = Field(min_length=1)
    virtual_gyros: list[Gyroscopes] = Field([0], min_length=1)

    @model_validator(mode="after")
    def _has_gyroscopes(self) -> Self:
        for name in ("real_gyros", "virtual_gyros"):
            _refuse_duplicates(name, getattr(self, name))
        if min(self.real_gyros) < len(AXES):
            raise ValueError("real_gyros: at least one IMU, 3 gyroscopes, is needed")
        if self.method == 1 and any(self.virtual_gyros):
            raise ValueError("method 1 has no virtual gyroscopes")
        return self


Protocol = Literal[
    "by_recording",
    "leave_one_device_out",
    "k_fold",
    "window_split",
    "test_in_training",
    "best_epoch_on_test",
]


def _as_number(value: Any) -> Any:
    """A number where a text spells one, since 1e-4 and 0.0001 are the same value."""
    try:
        return json.loads(value) if isinstance(value, str) else value
    except ValueError:
        return value


class Study(Parameter):
    """Estimators to compare, tracked in one MLflow experiment."""

    experiment: str = Field(description="name of the MLflow experiment: the name of the study")
    estimators: list[str] = Field(
        ["cnn"],
        min_length=1,
        description="besides the running mean; names of gyro_pipeline.estimators, or "
        "package.module:Class",
    )
    windows_s: list[Seconds] | None = Field(
        None, min_length=1, description="of this study; null: those of all studies"
    )
    default: bool = Field(True, description="part of `kedro run` and `--pipeline=reporting`")
    protocol: Protocol = Field(
        "by_recording",
        description="the test data: recordings of the first IMU, or every IMU in turn, as an "
        "unseen device (docs/protocol.md)",
    )
    also: dict[Protocol, list[str]] = Field(
        {}, description="further protocols, and the estimators to compare under each"
    )
    strides_s: list[Seconds] | None = Field(
        None,
        min_length=1,
        description="from the start of a window to the start of the next, seconds; null: windows "
        "do not overlap",
    )
    recordings: int | None = Field(
        None, ge=2, description="number of the first IMU's first recordings to use; null: all"
    )
    folds: int | None = Field(None, ge=2, description="of this study; null: those of splits")
    training_windows: Literal["all", "first"] | Seconds | None = Field(
        None, description="of this study; null: those of splits"
    )
    training: dict[str, Any] = Field({}, description="settings of training that the study changes")
    sweep: dict[str, list[str | float | int | bool]] = Field(
        {},
        description="values of training settings or network options, all combinations of which are "
        "trained; in --params separated by slashes: 1e-4/1e-3",
    )
    sensors: dict[str, Grid] = {}
    any_sensor: Grid | None = Field(
        None, description="grid of every other sensor of globals.yml; null: the study has no other"
    )

    @field_validator("sweep", mode="before")
    @classmethod
    def _slashes_separate_values(cls, sweep: dict[str, Any]) -> dict[str, Any]:
        separated = {
            name: values if isinstance(values, list) else str(values).split("/")
            for name, values in sweep.items()
        }
        return {name: [_as_number(value) for value in values] for name, values in separated.items()}

    @property
    def unseen_devices(self) -> bool:
        """Whether the tested devices are unseen in training."""
        return self.protocol == LEAVE_ONE_DEVICE_OUT

    @property
    def estimators_of(self) -> dict[Protocol, list[str]]:
        """Estimators of each protocol."""
        return {self.protocol: self.estimators} | dict(self.also)

    def sensors_among(self, sensors: Iterable[str]) -> list[str]:
        """The study's sensors: those that it names, and all others if ``any_sensor`` is set."""
        others = [name for name in sensors if name not in self.sensors] if self.any_sensor else []
        return [*self.sensors, *others]

    def grid_of(self, sensor: str) -> Grid:
        """The networks that the study trains on a sensor.

        Raises:
            InputError: The sensor is not part of the study.
        """
        grid = self.sensors.get(sensor, self.any_sensor)
        if grid is None:
            raise InputError(
                f"studies.{self.experiment}.sensors: expected one of {', '.join(self.sensors)}, "
                f"got {sensor!r}; add it there"
            )
        return grid

    def training_of(self, base: Training) -> Training:
        """The settings of training, with the study's changes."""
        return Training.model_validate(base.model_dump() | self.training)

    def splits_of(self, base: Splits) -> Splits:
        """The settings of the splits, with the study's changes.

        Where the study sets a stride for the windows of all roles, it applies to training as well.
        """
        windows = self.training_windows or base.training_windows
        windows = "all" if self.strides_s else windows
        changed = {"folds": self.folds or base.folds, "training_windows": windows}
        return base.model_copy(update=changed)

    @model_validator(mode="after")
    def _nothing_is_named_twice(self) -> Self:
        for name in ("estimators", "windows_s", "strides_s"):
            _refuse_duplicates(name, getattr(self, name) or [])
        return self

    @model_validator(mode="after")
    def _unseen_devices_have_one_protocol(self) -> Self:
        if LEAVE_ONE_DEVICE_OUT in self.also:
            raise ValueError(f"also: {LEAVE_ONE_DEVICE_OUT} is a study's only protocol")
        return self


class Only(Parameter):
    """Narrows every study to the rows that match; an unset key matches every row."""

    sensor: str | None = None
    real_gyros: Gyroscopes | None = None
    virtual_gyros: Gyroscopes | None = None
    window_s: Seconds | None = None
    seed: Seed | None = None


class PublishedResult(Parameter):
    """One row of the paper's result tables."""

    table: str = Field(description="our name for the paper's table")
    section: str = Field(description="of the paper")
    approach: str
    sensor: str
    real_gyros: Gyroscopes
    virtual_gyros: Gyroscopes
    window_s: float
    time_saving_pct: float
    accuracy_gain_pct: float


class PublishedSpecification(Parameter):
    """One row of the paper's table of sensor specifications, as the manufacturer states them."""

    section: str
    sensor: str
    name: str = Field(description="as the paper spells it")
    rate_hz: Annotated[tuple[float, float], Strict(False)] = Field(
        description="lowest and highest sample rate, Hz"
    )
    noise_density_mdps_rthz: float | None = Field(description="one-sided, mdps/sqrt(Hz)")
    bias_stability_dph: float | None = Field(description="bias instability, deg/h")
    recording_s: Seconds = Field(description="T of the paper's recordings (section IV-A)")


class PublishedHours(Parameter):
    """One row of the paper's table of dataset hours."""

    section: str
    dataset: int
    sensor: str
    virtual: bool
    train_h: float
    test_h: float
    total_h: float
    note: str = Field("", description="our reading where the paper contradicts itself")


class Published(Parameter):
    """Numbers that the paper states; only these do not come from runs of the pipelines."""

    results: list[PublishedResult]
    specifications: list[PublishedSpecification]
    hours: list[PublishedHours]

    def of_table(self, table: str) -> list[PublishedResult]:
        """Rows of one of the paper's result tables, in its order."""
        return [row for row in self.results if row.table == table]

    def of_networks(self, sensor: str, **gyros: int) -> list[PublishedResult]:
        """Results of a sensor with given counts, e.g. ``real_gyros=3``."""
        return [
            row
            for row in self.results
            if row.sensor == sensor and all(getattr(row, key) == n for key, n in gyros.items())
        ]


class Parameters(Parameter):
    """All parameters, as one tree."""

    source: str = Field(pattern=r"^[a-z0-9_]+$", description="where the logs come from")
    published_address: str = Field(
        pattern="^https?://", description="base address of the authors' files; the catalog reads it"
    )
    logs: str | None = Field(
        None, description="folder of a logger's files; the catalog of the environment logs reads it"
    )
    reader: ReaderOptions | None = Field(None, description="how these files are read; likewise")
    sensors: dict[str, Sensor]
    quality: Quality
    ground_truth: GroundTruth
    virtual_gyros: VirtualGyros
    splits: Splits
    training: Training
    execution: Execution
    windows_s: list[Seconds] = Field(min_length=1)
    seeds: list[Seed] = Field(min_length=1)
    studies: dict[str, Study]
    only: Only
    sweep: dict[str, Any] = Field({}, description="of the study sweep: see Study.sweep")
    published: Published

    @model_validator(mode="after")
    def _names_are_used_once(self) -> Self:
        for name in ("seeds", "windows_s"):
            _refuse_duplicates(name, getattr(self, name))
        for name, study in self.studies.items():
            if study.experiment != name:
                raise ValueError(
                    f"studies.{name}.experiment: expected {name!r}, got {study.experiment!r}"
                )
            try:
                study.training_of(self.training)
            except ValidationError as error:
                problem = error.errors()[0]
                where = ".".join(map(str, problem["loc"]))
                raise ValueError(f"studies.{name}.training.{where}: {problem['msg']}") from None
        return self

    @model_validator(mode="after")
    def _only_names_a_sensor(self) -> Self:
        if self.only.sensor is not None:
            self.check_sensor("only.sensor", self.only.sensor)
        return self

    def check_sensor(self, where: str, name: str) -> None:
        """Refuse an unknown sensor.

        Args:
            where: The parameter that names the sensor, for the message.
            name: The sensor.

        Raises:
            InputError: No sensor has this name.
        """
        if name not in self.sensors:
            raise InputError(
                f"{where}: unknown sensor {name!r}; expected one of {', '.join(self.sensors)}, or "
                "a new entry in conf/base/globals.yml or in that of the environment"
            )
