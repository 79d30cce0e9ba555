"""What the report says about the tables and figures that it knows."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Caption:
    """Of one table or figure.

    Attributes:
        title: A few words.
        text: What is to be seen, for a reader who has not read the paper.
        pipeline: What ``kedro run --pipeline=`` makes it.
    """

    title: str
    text: str
    pipeline: str


_SUMMARY = (
    "Windows of 10 s; S and A in percent, with 95 % intervals over recordings. The main result "
    "uses all windows; the paper's way uses the first window of each recording, and scatters more."
)
_AUGMENTATION = (
    "Left: all windows, the main result. Right: the first window of each recording, the paper's "
    "way. The line is the running mean against its length. Filled markers are the networks with "
    "their 95 % intervals, hollow ones the error that the published gain would mean on these "
    "data, bars the ceiling. Lower is better."
)

CAPTIONS = {
    "tables/augmentation_three_gyroscopes": Caption(
        "Three real gyroscopes", _SUMMARY, "augmentation"
    ),
    "tables/augmentation_multiple_gyroscopes": Caption(
        "Twelve real gyroscopes", _SUMMARY, "augmentation"
    ),
    "figures/augmentation_sparkfun_3_real": Caption(
        "SparkFun: 3 real gyroscopes, with and without virtual ones", _AUGMENTATION, "augmentation"
    ),
    "figures/augmentation_sparkfun_12_real": Caption(
        "SparkFun: 12 real gyroscopes, with and without virtual ones",
        _AUGMENTATION,
        "augmentation",
    ),
    "figures/augmentation_dot_3_real": Caption(
        "DOT: 3 real gyroscopes, with and without virtual ones", _AUGMENTATION, "augmentation"
    ),
    "figures/augmentation_dot_12_real": Caption(
        "DOT: 12 real gyroscopes, with and without virtual ones", _AUGMENTATION, "augmentation"
    ),
}
"""By folder and file name, in the order of the report."""
