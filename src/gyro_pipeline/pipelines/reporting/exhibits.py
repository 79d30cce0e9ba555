"""The data that a report is made from, and the tables and figures that it consists of."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyro_pipeline.conventions import ALL, AXES, FIRST, LEAVE_ONE_DEVICE_OUT, MDPS
from gyro_pipeline.parameters import Published, PublishedResult, PublishedSpecification
from gyro_pipeline.physics.ceiling import best_gain
from gyro_pipeline.physics.warm_up import amplitude_needed
from gyro_pipeline.pipelines.reporting.recordings import WARM_UPS_S
from gyro_pipeline.pipelines.reporting.results import CNN_BEST, column
from gyro_pipeline.scoring.scores import Estimate
from gyro_pipeline.studies import CNN, CNN_SHUFFLED, CONSTANT, MEAN

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEAK_VARIANTS = {
    ("k_fold", "cnn"): "Split by recording",
    ("k_fold", CNN_SHUFFLED): "By recording, labels shuffled",
    ("window_split", "cnn"): "Windows split at random",
    ("test_in_training", "cnn"): "Test windows in training",
    ("best_epoch_on_test", "cnn"): "By recording, epoch chosen on test",
}
"""Names of the ways of training in the leak study, by protocol and estimator, in their order."""

BEATS_ORACLE_P = 0.001
"""A p value against the oracle below this, after Holm's correction, is a leak or a defect."""

_LABELS = {
    MEAN: "running mean",
    CNN: "network",
    CONSTANT: "constant",
    CNN_BEST: "network at its best epoch",
}
STUDIES_OF = {
    "three_gyroscopes": "augmentation",
    "multiple_gyroscopes": "augmentation",
    "generalization": "real2real",
}
"""The study that makes each result table of the paper."""

TIME_CONSTANTS_S = (5.0, 10.0, 20.0, 30.0, 60.0)
"""Time constants for which the amplitude of a warm-up is computed."""


@dataclass(frozen=True)
class Exhibit:
    """A table or figure of the report."""

    name: str  # name of its files
    title: str  # a few words
    caption: str  # explanation for a reader who has not read the paper
    content: "pd.DataFrame | Figure"
    page_columns: Sequence[str] | None = None  # of the table, which the page shows; None for all

    @property
    def page_table(self) -> pd.DataFrame | None:
        """The table as the page shows it; None for a figure."""
        if not isinstance(self.content, pd.DataFrame):
            return None
        return self.content if self.page_columns is None else self.content[[*self.page_columns]]


@dataclass(frozen=True)
class Material:
    """The data that the tables and figures of a source are made from."""

    source: str  # where the logs come from
    published: Published  # results and specifications that the paper states
    results: pd.DataFrame  # results of all studies, with the column study
    curves: pd.DataFrame  # running-mean curves, with the column study
    leaks: pd.DataFrame  # results of the leak study, which have other columns
    sensors: pd.DataFrame  # a row per sensor, from describe
    quality: pd.DataFrame  # the quality table of all sensors
    signals: pd.DataFrame  # lines of figures, with the column sensor

    @cached_property
    def finished(self) -> pd.DataFrame:
        """Results whose runs are finished."""
        return self.results[self.results.status.isna()]

    @property
    def simulated(self) -> bool:
        """Whether all recordings are simulated."""
        kinds = [
            table.simulated for table in (self.finished, self.sensors, self.leaks) if len(table)
        ]
        return bool(kinds) and all(bool(kind.all()) for kind in kinds)

    @property
    def source_name(self) -> str:
        """The source, with *simulated* or *measured* if its name does not say so."""
        kind = "simulated" if self.simulated else "measured"
        return self.source if kind in self.source else f"{self.source} ({kind})"

    @cached_property
    def sheets(self) -> dict[str, PublishedSpecification]:
        """What the paper states of each sensor."""
        return {sheet.sensor: sheet for sheet in self.published.specifications}

    @cached_property
    def described(self) -> dict[str, pd.Series]:
        """The description of each sensor by its recordings."""
        return {row.sensor: row for _, row in self.sensors.iterrows()}

    def sensor_name(self, sensor: str) -> str:
        """Name of a sensor as the paper writes it, if it does."""
        return self.sheets[sensor].name if sensor in self.sheets else sensor

    def beyond_white_noise(self, claim: PublishedResult) -> bool:
        """Whether a published gain exceeds A = 1 - sqrt(T0/T), with the paper's T."""
        r = claim.window_s / self.sheets[claim.sensor].recording_s
        return bool(claim.accuracy_gain_pct > 100 * best_gain(np.sqrt(r)))

    def warm_up_needed_mdps(self, claim: PublishedResult) -> list[float]:
        """Amplitudes of a warm-up with which the ceiling in first windows is a published gain.

        There is one for each of :data:`TIME_CONSTANTS_S`, or none without recordings. T is that of
        the paper, N and the turn-on spread are those of the recordings.
        """
        row = self.described.get(claim.sensor, pd.Series())
        noise, spread = (
            row.reindex([f"{name}_{axis}" for axis in AXES]).to_numpy(float)
            for name in ("white_dps_rts", "spread_dps")
        )
        times = claim.window_s, self.sheets[claim.sensor].recording_s, TIME_CONSTANTS_S
        needed = amplitude_needed(claim.accuracy_gain_pct / 100, noise, spread, *times) / MDPS
        return [] if np.isnan(needed).any() else needed.tolist()

    @cached_property
    def warm_ups_allowed_mdps(self) -> dict[str, list[float]]:
        """By the name of a sensor, the largest warm-up that it allows for each of ``WARM_UPS_S``.

        The bounds are those of the worst axis, from 95 % intervals. Sensors without are left out.
        """
        keys = [f"warm_up_bound_dps_{time_s:g}" for time_s in WARM_UPS_S]
        bounds = self.sensors.set_index("sensor").reindex(columns=keys).dropna() / MDPS
        return {self.sensor_name(str(sensor)): [*row] for sensor, *row in bounds.itertuples()}

    @property
    def claims(self) -> list[PublishedResult]:
        """Published results of the sensors of this source."""
        sensors = {*self.results.sensor, *self.sensors.sensor}
        return [row for row in self.published.results if row.sensor in sensors]

    def result(self, claim: PublishedResult, estimator: str, study: str | None = None) -> pd.Series:
        """Our result for a published one, by default of the study that makes the paper's table.

        Where the study has fewer real gyroscopes, such as on the public file of a single IMU, the
        result with the most of them is taken. It is empty if there is none.
        """
        rows = self._same(claim, estimator, study)
        rows = rows[rows.real_gyros <= claim.real_gyros].sort_values("real_gyros")[-1:]
        finished = rows[rows.status.isna()]
        return pd.Series() if finished.empty else finished.iloc[0]

    def status(self, claim: PublishedResult) -> str:
        """Why there is no result of ours for a published one."""
        rows = where(self._same(claim, CNN), real_gyros=claim.real_gyros)
        return str(rows.status.iloc[0]) if len(rows) else "not part of this run"

    def _same(
        self, claim: PublishedResult, estimator: str, study: str | None = None
    ) -> pd.DataFrame:
        """Results for the sensor, virtual gyroscopes and window of a published one."""
        same = {name: getattr(claim, name) for name in ("sensor", "virtual_gyros", "window_s")}
        study = study or STUDIES_OF[claim.table]
        return where(self.results, study=study, estimator=estimator, **same)


def where(rows: pd.DataFrame, **columns: Any) -> pd.DataFrame:
    """The rows with the given values of columns."""
    for name, value in columns.items():
        rows = rows[rows[name] == value]
    return rows


def label(estimator: str) -> str:
    """Name of an estimator for readers."""
    path = ":" in estimator  # of a user's class
    return _LABELS.get(estimator, estimator if path else estimator.replace("_", " "))


def ends(row: pd.Series, name: str, windows: str = ALL) -> NDArray[np.float64]:
    """A score over first or all windows and the ends of its interval; NaN if missing."""
    key = column(name, windows)
    return row.reindex([key, f"{key}_lo", f"{key}_hi"]).to_numpy(float)


def interval(row: pd.Series, name: str, windows: str = ALL) -> str:
    """A score in percent with its 95 % interval."""
    return bracketed(ends(row, name, windows), percent)


def bracketed(values: Iterable[float], text: Callable[[float], str]) -> str:
    """A value with its interval in brackets, if it has one; a dash for NaN."""
    value, lo, hi = values
    if np.isnan(value):
        return "–"
    return text(value) + ("" if np.isnan(lo) else f" [{text(lo)}, {text(hi)}]")


def percent(value: float) -> str:
    """A percentage; a saving is infinite beyond the ends of the running-mean curve."""
    if np.isinf(value):
        return "never reached" if value > 0 else "off the curve"
    return f"{round(value)}"


def two_digits(value: float) -> str:
    """A positive number with two digits, or all those before the decimal point."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}"  # noqa: PLR2004


def from_to(values: Iterable[float], text: Callable[[float], str] = two_digits) -> str:
    """The range of some values."""
    numbers = pd.Series(list(values), dtype=float)
    low, high = text(numbers.min()), text(numbers.max())
    return low if low == high else f"{low} to {high}"


def beyond_ceiling(row: pd.Series, windows: str = ALL) -> bool:
    """Whether the entire interval of an accuracy gain lies above the ceiling's."""
    gain, ceiling = (
        Estimate(*ends(row, f"{kind}accuracy_gain_pct", windows)) for kind in ("", "ceiling_")
    )
    return gain.lies_above(ceiling)


def remark(row: pd.Series) -> str | None:
    """A remark on an accuracy gain, such as one beyond its ceiling; None if there is none."""
    notes = []
    for windows in (ALL, FIRST):
        gain, _, _ = ends(row, "accuracy_gain_pct", windows)
        limit, _, _ = ends(row, "ceiling_accuracy_gain_pct", windows)
        if beyond_ceiling(row, windows):
            notes.append(f"beyond its ceiling in {windows} windows")
        elif gain > limit:
            notes.append(f"above its ceiling in {windows} windows, which its interval contains")
    if pd.notna(row.get("prior_conflict")):
        notes.append(row["prior_conflict"])
    return "; ".join(notes) or None


def gyroscopes(row: Any) -> str:
    """The number of gyroscopes in a training set, in words."""
    virtual = f" + {row.virtual_gyros:.0f} virtual" if row.virtual_gyros else ""
    return f"{row.real_gyros:.0f} real{virtual}"


def split(row: pd.Series) -> str:
    """The split of the recordings, in words."""
    if pd.isna(row.get("folds")):
        return "–"
    if row.get("protocol") == LEAVE_ONE_DEVICE_OUT:
        return f"leave-one-device-out, {row.folds:.0f} devices"
    return "hold-out" if row.folds == 1 else f"k-fold, {row.folds:.0f} folds"
