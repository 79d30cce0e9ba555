from pathlib import Path

import pytest
from kedro.config import OmegaConfigLoader
from pydantic import ValidationError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import Parameters
from gyro_pipeline.session import checked
from gyro_pipeline.settings import CONFIG_LOADER_ARGS
from gyro_pipeline.studies import check_possible

ONE_DOT = {"sensor": "dot", "real_gyros": 3}
CONF = str(Path(__file__).parents[1] / "conf")


@pytest.fixture
def loaded():
    """Parameters of the base configuration, not checked yet, with some groups changed."""

    def load(**changes):
        loader = OmegaConfigLoader(CONF, runtime_params=changes, **CONFIG_LOADER_ARGS)
        return loader["parameters"]

    return load


def refusal(parameters):
    """What a user is told about parameters, before any pipeline is made."""
    with pytest.raises(InputError) as refused:
        checked(parameters)
    return str(refused.value)


def test_the_configuration_of_this_project_is_accepted(loaded):
    assert checked(loaded()) == Parameters(**loaded())


def of_study(name, **changes):
    return {"studies": {name: changes}}


REFUSED = [
    ({"epoch": 5}, "epoch:", "unknown key; see conf/base"),
    ({"training": {"epoch": 5}}, "training.epoch:", "unknown key"),
    (
        {"sensors": {"dot": {"simulated": {"colour": 1}}}},
        "sensors.dot.simulated.colour:",
        "unknown",
    ),
    ({"only": {"fold": 3}}, "only.fold:", "unknown key"),
    ({"training": {"epochs": 0}}, "training.epochs:", "greater than or equal to 1"),
    ({"training": {"centring": "none"}}, "training.centring:", "'per_device' or 'global'"),
    ({"splits": {"test_fraction": 1.0}}, "splits.test_fraction:", "less than 1"),
    ({"splits": {"training_windows": "some"}}, "splits.training_windows.", "'all' or 'first'"),
    ({"source": "My Files"}, "source:", "match pattern"),
    ({"only": {"real_gyros": 4}}, "only.real_gyros:", "multiple of 3"),
    ({"only": {"sensor": "bosch"}}, "only.sensor:", "sparkfun, dot, ng, memsense"),
    ({"windows_s": []}, "windows_s:", "at least 1 item"),
    ({"windows_s": [0]}, "windows_s.0:", "greater than 0"),
    (
        of_study("input_channels", sensors={"sparkfun": {"virtual_gyros": [12]}}),
        "studies.input_channels.sensors.sparkfun:",
        "method 1 has no virtual gyroscopes",
    ),
    (
        of_study("real2real", sensors={"ng": {"real_gyros": [0]}}),
        "studies.real2real.sensors.ng:",
        "at least one IMU, 3 gyroscopes",
    ),
    (of_study("real2real", experiment="all"), "studies.real2real.experiment:", "'real2real'"),
    (
        of_study("estimators", estimators=["mean", "mean"]),
        "studies.estimators:",
        "estimators: ['mean', 'mean'] names one of them twice",
    ),
    (of_study("leakage", strides_s=[1, 0]), "studies.leakage.strides_s.1:", "greater than 0"),
    (of_study("leakage", strides_s=[1, 1]), "studies.leakage:", "names one of them twice"),
    (
        of_study("leakage", also={"leave_one_device_out": ["mean"]}),
        "studies.leakage:",
        "also: leave_one_device_out is a study's only protocol",
    ),
    (of_study("leakage", protocol="peek"), "studies.leakage.protocol:", "'by_recording'"),
    (
        {"sensors": {"ng": {"train_recordings": 100}}},
        "sensors.ng:",
        "train_recordings must leave at least one recording for testing",
    ),
    ({"training": {"learning_rate": 2.0}}, "training.learning_rate:", "less than or equal to 1"),
    ({"training": {"stop_below": 5}}, "training:", "stop_below: 5 leaves no epoch to train"),
    ({"seeds": [-1]}, "seeds.0:", "greater than or equal to 0"),
    ({"reader": {"unit": "deg/s"}}, "reader.unit:", "unknown key; there are format, "),
]


@pytest.mark.parametrize(("changes", "place", "said"), REFUSED)
def test_a_bad_parameter_is_refused_by_its_place(loaded, changes, place, said):
    message = refusal(loaded(**changes))
    assert place in message
    assert said in message


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
        tree = given
        for key in place[:-1]:
            tree = tree[key]
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


ASKED = {
    "unknown sensor": (
        {"studies": {"real2real": {"sensors": {"bosch": {"method": 2, "real_gyros": [3]}}}}},
        "real2real",
        "studies.real2real: unknown sensor 'bosch'",
    ),
    "real gyroscopes": (
        {"sensors": {"dot": {"imus": 1}}},
        "augmentation",
        "studies.augmentation.dot: 12 real gyroscopes asked, dot has 3 (its imus: 1)",
    ),
    "virtual gyroscopes": (
        {"virtual_gyros": {"imus": 4}},
        "augmentation",
        "studies.augmentation.sparkfun: 24 virtual gyroscopes asked, virtual_gyros.imus makes 12",
    ),
    "windows": (
        {"sensors": {"dot": {"recording_s": 20}}},
        "real2real",
        "studies.real2real.dot: 30 s windows asked, longer than a recording of dot, 20 s",
    ),
    "leaking windows": (
        {"studies": {"leakage": {"windows_s": [53]}}},
        "leakage",
        "studies.leakage.memsense: 53 s windows asked, longer than a recording of memsense, 52 s",
    ),
    "estimator": (
        {"studies": {"real2real": {"estimators": ["kalman"]}}},
        "real2real",
        "unknown estimator 'kalman'; expected one of mean, median",
    ),
    "nothing": (
        {"only": {"sensor": "ng"}},
        "augmentation",
        "only={'sensor': 'ng'} matches nothing in augmentation",
    ),
}
"""Changes of the parameters, the pipeline that they stop, and why."""


@pytest.mark.parametrize("name", ASKED)
def test_what_sensors_cannot_give_stops_the_studies_that_ask_for_it_and_no_other(loaded, name):
    changes, pipeline, said = ASKED[name]
    parameters = Parameters(**loaded(**changes))
    with pytest.raises(InputError) as refused:
        check_possible(parameters, ["ground_truth", pipeline])
    assert said in str(refused.value)
    for other in ("ground_truth", "virtual_gyros"):
        check_possible(parameters, [other])


def test_a_study_without_a_name_is_checked_like_one_with_it(loaded):
    parameters = Parameters(**loaded(sensors={"dot": {"imus": 1}}))
    with pytest.raises(InputError, match="12 real gyroscopes"):
        check_possible(parameters, ["__default__"])
    check_possible(Parameters(**loaded(sensors={"dot": {"imus": 1}}, only=ONE_DOT)), ["real2real"])


@pytest.mark.parametrize(
    ("entry", "rate_hz"),
    [
        ({}, None),
        ({"rate_hz": 100}, 100),
        ({"samples": 1000, "recording_s": 20}, 50),
        ({"samples": 1000, "recording_s": 20, "rate_hz": 100}, 100),
        ({"samples": 1000}, None),
    ],
)
def test_a_sensor_with_files_may_say_its_rate_or_nothing(loaded, entry, rate_hz):
    parameters = Parameters(**loaded(sensors={"device": entry}, only={"sensor": "device"}))
    assert parameters.sensors["device"].rate_hz == rate_hz
    check_possible(parameters, ["ground_truth"])


def test_all_problems_are_told_at_once(loaded):
    message = refusal(loaded(training={"epochs": 0, "stride": 0}, nonsense=1))
    for place in ("training.epochs:", "training.stride:", "nonsense:"):
        assert place in message


def test_a_missing_key_is_refused(loaded):
    parameters = loaded()
    del parameters["splits"]["split_seed"]
    assert "splits.split_seed: Field required" in refusal(parameters)


def test_groups_cannot_be_changed_after_loading(parameters):
    with pytest.raises(ValueError, match="frozen"):
        parameters("base").training.epochs = 1


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
