import re
from functools import reduce
from operator import getitem
from pathlib import Path

import pytest
from kedro.config import OmegaConfigLoader
from pydantic import ValidationError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import Parameters
from gyro_pipeline.session import parse_parameters
from gyro_pipeline.settings import CONFIG_LOADER_ARGS
from gyro_pipeline.studies import check_possible

CONF = str(Path(__file__).parents[1] / "conf")
PAPER = "rapid_gyroscope_calibration.tex"
SENSORS = {"SparkFan": "sparkfun", "DOT": "dot", "NG": "ng", "Memsense": "memsense"}
RESULTS = {
    "tab:three_gyro_results": "three_gyroscopes",
    "tab:mg_results": "multiple_gyroscopes",
    "tab:generalization": "generalization",
}
METHOD_1 = {"sparkfun": {"virtual_gyros": [12]}}


@pytest.fixture
def loaded():
    """Parameters of the base configuration, not checked yet, with some groups changed."""

    def load(**changes):
        loader = OmegaConfigLoader(CONF, runtime_params=changes, **CONFIG_LOADER_ARGS)
        return loader["parameters"]

    return load


def numbers(tree, place=()):
    """Places of all numbers in a tree."""
    if isinstance(tree, dict | list):
        items = tree.items() if isinstance(tree, dict) else enumerate(tree)
        return [found for key, value in items for found in numbers(value, (*place, key))]
    return [place] if type(tree) in (int, float) else []


def test_every_number_is_a_finite_number_of_its_own_type(loaded):
    given = loaded()
    places = numbers(given)
    assert len(places) > 200
    for place in places:
        tree = reduce(getitem, place[:-1], given)
        kept = tree[place[-1]]
        for value in (True, "1", float("inf"), float("nan"), -1e300):
            tree[place[-1]] = value
            if value == -1e300 and place[0] == "published":  # gains may be negative
                continue
            with pytest.raises(ValidationError) as refused:
                Parameters(**given)
            assert str(place[1]) in str(refused.value)
        tree[place[-1]] = kept
    Parameters(**given)


def test_a_number_of_steps_decides_the_epochs_of_any_number_of_windows(parameters):
    p = parameters("base")
    settings = p.studies["leakage"].training_of(p.training)
    epochs = {1: 3000, 64: 3000, 65: 1500, 4629: 42, 10**6: 1}
    for windows, expected in epochs.items():
        rates = settings.learning_rates(windows)
        assert len(rates) == expected
        assert set(rates) == {p.training.learning_rate}
    assert settings.batch_size == p.training.batch_size  # what the study does not change
    # the last 400 of 1200 epochs could move nothing
    assert (len(p.training.learning_rates(4629)), p.training.epochs) == (800, 1200)


def study(name, **changes):
    return {"studies": {name: changes}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"epoch": 5}, "epoch: unknown key; see conf/base"),
        ({"sensors": {"dot": {"simulated": {"colour": 1}}}}, "sensors.dot.simulated.colour: unkn"),
        ({"training": {"epochs": 0}, "windows_s": []}, "training.epochs: .*windows_s: "),
        ({"source": "My Files"}, "source: .*match pattern"),
        ({"only": {"real_gyros": 4}}, "only.real_gyros: .*multiple of 3"),
        (study("input_channels", sensors=METHOD_1), "method 1 has no virtual gyroscopes"),
        (study("real2real", experiment="all"), "studies.real2real.experiment: .*'real2real'"),
        (study("estimators", estimators=["mean", "mean"]), "got one of them twice in .*'mean'"),
        (study("leakage", strides_s=[1, 1]), "studies.leakage: .*got one of them twice"),
        (study("leakage", also={"leave_one_device_out": ["mean"]}), "is a study's only protocol"),
        ({"sensors": {"ng": {"train_recordings": 100}}}, "leave at least one recording for test"),
        ({"training": {"stop_below": 5}}, "training: stop_below: 5 leaves no epoch to train"),
        ({"reader": {"unit": "deg/s"}}, "reader.unit: unknown key; expected one of format, "),
    ],
)
def test_bad_parameters_are_refused_by_their_places_all_at_once(loaded, changes, said):
    with pytest.raises(InputError, match=f"(?s){said}"):
        parse_parameters(loaded(**changes))


def test_what_sensors_cannot_give_stops_the_studies_that_ask_for_it_and_no_other(loaded):
    bosch = {"bosch": {"method": 2, "real_gyros": [3]}}
    for changes, pipeline, said in (
        (study("real2real", sensors=bosch), "real2real", "real2real: unknown sensor 'bosch'"),
        ({"sensors": {"dot": {"imus": 1}}}, "__default__", r"dot: 12 real .* 3 \(imus: 1\)"),
        ({"virtual_gyros": {"imus": 4}}, "augmentation", "24 virtual .* needed, .* makes 12"),
        ({"sensors": {"dot": {"recording_s": 20}}}, "real2real", "30 s windows needed.*, 20 s"),
        ({"only": {"sensor": "ng"}}, "augmentation", "'ng'} matches nothing in augmentation"),
        (study("unseen_devices", estimators=["lstm"]), "unseen_devices", "lstm cannot be judged"),
        # the report would take them for seeds
        (
            study("real2real", strides_s=[10, 1]),
            "real2real",
            "expected one protocol and one stride",
        ),
        (study("real2real", also={"k_fold": ["cnn"]}), "real2real", "one protocol and one stride"),
    ):
        parameters = Parameters(**loaded(**changes))
        with pytest.raises(InputError, match=said):
            check_possible(parameters, ["ground_truth", pipeline])
        for other in ("ground_truth", "virtual_gyros"):
            check_possible(parameters, [other])


# the reference file against the text of the paper, where that is at hand


@pytest.fixture(scope="module")
def text(real_file):
    """Of the paper, in paper/ two folders above that of the real recordings."""
    folder = real_file("memsense_test_real.npy").parent.resolve().parents[1] / "paper"
    if not (folder / PAPER).is_file():
        pytest.skip(f"there is no {PAPER} in {folder}")
    return (folder / PAPER).read_text()


def table(text, label):
    """Cells of the rows of one table, without what only sets it."""
    (body,) = [
        part for part in re.findall(r"\\begin\{table\}(.*?)\\end\{table\}", text, re.S)
        if f"\\label{{{label}}}" in part
    ]  # fmt: skip
    body = re.sub(r"\\hline|\\multicolumn\{1\}\{c\|\}", "", body)
    cells = [[cell.strip(" \n{}") for cell in row.split("&")] for row in body.split(r"\\")]
    return [row for row in cells if re.fullmatch(r"[\d.]+|N/A", row[-1])]


@pytest.mark.parametrize("label", RESULTS)
def test_results_are_the_papers(text, parameters, label):
    rows = parameters("base").published.of_table(RESULTS[label])
    results = zip(table(text, label), rows, strict=True)
    for (approach, gyroscopes, saving, gain), row in results:
        if label == "tab:generalization":
            assert row.sensor == SENSORS[approach]
        else:
            assert row.approach.replace(" ", "") == approach.replace(" ", "")
            assert row.sensor == ("dot" if "DOT" in approach else "sparkfun")
        counts = [int(count) for count in re.findall(r"\d+", gyroscopes)]
        assert counts == [row.real_gyros] + [row.virtual_gyros] * (row.virtual_gyros > 0)
        stated = (row.time_saving_pct, row.accuracy_gain_pct)
        assert stated == (float(saving), float(gain))
        assert row.window_s == 10
        assert row.section.startswith("IV-G")


def test_specifications_and_hours_are_the_papers(text, parameters):
    published, specifications = parameters("base").published, table(text, "sensor_specifications")
    for (name, rate, *figures), row in zip(specifications, published.specifications, strict=True):
        assert row.name == name
        ends = [float(end) for end in rate.split("-")]
        assert row.rate_hz == (ends[0], ends[-1])
        stated = [row.noise_density_mdps_rthz, row.bias_stability_dph]
        assert stated == [None if cell == "N/A" else float(cell) for cell in figures]
    ours = [[row.dataset, row.train_h, row.test_h, row.total_h] for row in published.hours]
    assert [[float(cell) for cell in row] for row in table(text, "tab:dataset_in_hours")] == ours
    assert f"contain {sum(row.total_h for row in published.hours):.1f} hours" in text
