"""What the report says about the tables and figures that it knows."""

from dataclasses import dataclass

from gyro_pipeline.estimators import ORIENTATION_NOTE


@dataclass(frozen=True)
class Caption:
    """Of one table or figure.

    Attributes:
        title: A few words.
        text: What is to be seen, for a reader who has not read the paper. The page says the same
            text once.
        pipeline: What ``kedro run --pipeline=`` makes it.
        section: Of the paper, where it has one like it.
    """

    title: str
    text: str
    pipeline: str
    section: str = ""


_SUMMARY = (
    "Windows of 10 s; S and A in percent, with 95 % intervals over recordings. S and A are over "
    "all windows, the main result; the paper's way is over the first window of each recording, "
    "and scatters more. Paper, section IV-G."
)
_ON_CURVE = (
    "Left: all windows, the main result. Right: the first window of each recording, the paper's "
    "way. The line is the running mean against its length. Filled markers are the networks with "
    "95 % intervals, hollow ones the error that a published gain would mean on these data, bars "
    "the ceiling. Lower is better."
)
_ESTIMATORS = (
    "Left: error over all windows. Right: the same relative to the running mean. Relatives share a "
    "colour, filled markers are the recommended estimators. The dashed line is the ceiling, on "
    "measured data an estimate. Lower is better. Estimators in black need no training recordings; "
    f"each of the others {ORIENTATION_NOTE}."
)
_RATIOS = (
    "RMSE over all windows against the mean of the recording, relative to that of the running mean "
    "over the same window, with 95 % intervals. A gain is one whose interval lies below 1. "
    "Differences, coverage and the other truths are in `tables/{study}_comparison.csv`. Each but "
    f"mean, median and trimmed mean {ORIENTATION_NOTE}."
)
_UNSEEN = (
    "Every device in turn is one that the estimators have never seen: they learn from the others, "
    "and all that those tell of its bias is the spread from unit to unit. Intervals are over "
    "devices; over two to five of them they are rough."
)
_TOLERANCE = "The band is the tolerance around the mean of the recording, which counts as truth."

_NAMES = {"sparkfun": "SparkFun", "dot": "DOT", "ng": "NG", "memsense": "Memsense"}


def _compared(kind: str) -> dict[str, Caption]:
    """Of the studies that compare estimators, for each sensor: tables or figures."""
    what = {"tables": "error relative to the running mean", "figures": "error against the window"}
    captions = {}
    for study, whose, more in (
        ("estimators", "estimators", ""),
        ("unseen_devices", "estimators on unseen devices", f" {_UNSEEN}"),
        ("networks", "networks", ""),
        ("sweep", "a sweep", ""),
    ):
        text = _RATIOS.format(study=study) if kind == "tables" else _ESTIMATORS
        for sensor, name in _NAMES.items():
            title = f"{name}: {whose}, {what[kind]}"
            captions[f"{kind}/{study}_{sensor}"] = Caption(title, text + more, study)
    return captions


CAPTIONS = {
    "tables/augmentation_three_gyroscopes": Caption(
        "Three real gyroscopes", _SUMMARY, "augmentation"
    ),
    "tables/augmentation_multiple_gyroscopes": Caption(
        "Twelve real gyroscopes", _SUMMARY, "augmentation"
    ),
    "tables/real2real_generalization": Caption(
        "The four sensors",
        f"{_SUMMARY} Where runs on measured data of another source are in the store, they stand "
        "below the row of the same sensor.",
        "real2real",
    ),
    **_compared("tables"),
    "tables/sensor_specifications": Caption(
        "Sensors: datasheets and recordings",
        "Datasheet values beside those found in the recordings: the root mean square over "
        "gyroscopes, with the smallest and the largest. N is the white noise: the mean of t "
        "seconds scatters by N/√t. B is the bias instability.",
        "reporting",
        "IV-A",
    ),
    "tables/recording_quality": Caption(
        "Recordings: kept, repaired, rejected",
        "Quality control of the raw logs, and the recordings in which it found "
        "something. The longest stretch without a gap is kept of a recording, and brief damage in "
        "it is masked. Rows count from 0.",
        "ground_truth",
    ),
    "tables/dataset_hours": Caption(
        "Hours of the datasets",
        "Training recordings count for every gyroscope, test recordings for the three of IMU 1.",
        "reporting",
        "IV-A",
    ),
    "figures/real2real_saving_against_turn_on_spread": Caption(
        "What can be saved, against the turn-on spread",
        "The turn-on spread τ is what the bias changes from one power-on to the next; it decides "
        "how much can be gained. The line is the ceiling of a sensor with that spread, markers "
        "are what the networks save, with 95 % intervals.",
        "real2real",
    ),
    **_compared("figures"),
    "figures/input_channels_input_channels": Caption(
        "Method 1: more gyroscopes as input channels",
        _ON_CURVE,
        "input_channels",
        "IV-C",
    ),
    "figures/real2real_training_data": Caption(
        "Method 2: more gyroscopes as training data",
        _ON_CURVE,
        "real2real",
        "IV-D",
    ),
    "figures/real2real_gyroscopes_10s": Caption(
        "Method 2: error at 10 s against the number of gyroscopes",
        "Left: all windows, the main result. Right: the paper's way. Lower is better.",
        "real2real",
        "IV-D",
    ),
    "figures/augmentation_sparkfun_3_real": Caption(
        "SparkFun: 3 real gyroscopes and virtual ones",
        _ON_CURVE,
        "augmentation",
        "IV-E",
    ),
    "figures/augmentation_sparkfun_12_real": Caption(
        "SparkFun: 12 real gyroscopes and virtual ones",
        _ON_CURVE,
        "augmentation",
        "IV-E",
    ),
    "figures/augmentation_dot_3_real": Caption(
        "DOT: 3 real gyroscopes and virtual ones", _ON_CURVE, "augmentation", "IV-F"
    ),
    "figures/augmentation_dot_12_real": Caption(
        "DOT: 12 real gyroscopes and virtual ones", _ON_CURVE, "augmentation", "IV-F"
    ),
    "figures/running_average": Caption(
        "Running average of one gyroscope", _TOLERANCE, "reporting", "II"
    ),
    "figures/calibrated_signal": Caption(
        "Raw and calibrated signal of the same gyroscope",
        "Calibrated is the raw signal less the bias.",
        "reporting",
        "II",
    ),
    "figures/mg_convergence": Caption(
        "Running average of several gyroscopes",
        f"Each gyroscope is centred by its own bias before they are averaged. {_TOLERANCE}",
        "reporting",
        "III-A",
    ),
    "figures/allan_deviation": Caption(
        "Allan deviation of every gyroscope",
        "How much averages of a length differ. White noise falls as 1/√t; flicker noise (B) and "
        "random walk (K) bend the curve upwards. The dashed line is the fit.",
        "reporting",
    ),
}
"""By folder and file name, in the order of the report."""

FURTHER = {
    "tables/leakage_results": Caption(
        "Trained with leaks on purpose: S and A",
        "None of these is a result: test information was let into the training, each time in one "
        "way, beside the honest split of the same windows. It shows that leakage suffices to pass "
        "the ceiling, not that anybody did it. S and A are over the windows that each way calls "
        "its test, in percent, with 95 % intervals of A over recordings.",
        "leakage",
    ),
    "figures/leakage_accuracy_against_stride": Caption(
        "Trained with leaks on purpose: accuracy gain against the window stride",
        "Windows that start a whole number of the network's hops apart share most of what it sees. "
        "Split at random, they are near-duplicates that can be learned by heart.",
        "leakage",
    ),
}
"""The same for what is made apart from the report, and shown at its end."""
