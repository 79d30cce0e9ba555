from types import SimpleNamespace

import pytest

from gyro_pipeline.conventions import InputError, Missing
from gyro_pipeline.hooks import Preflight

ABSENT = {"ng.raw_logs.recordings": Missing(("kedro run --pipeline=ground_truth",))}


def test_only_the_report_goes_on_without_its_data():
    training = SimpleNamespace(namespace="training")
    message = "ng.raw_logs.recordings is not there; make it: kedro run --pipeline=ground_truth"
    with pytest.raises(InputError, match=message):
        Preflight().before_node_run(training, ABSENT)
    Preflight().before_node_run(training, {"ng.raw_logs.recordings": 1})
    Preflight().before_node_run(SimpleNamespace(namespace="reporting"), ABSENT)
