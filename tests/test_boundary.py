"""What surrounds a run: options that are refused, errors in one line, no password, provenance."""

import errno
import logging
import re
import sys
from concurrent.futures.process import BrokenProcessPool
from types import SimpleNamespace

import pytest
from kedro.config import OmegaConfigLoader
from kedro.io import DataCatalog, DatasetError
from kedro.runner import ParallelRunner, SequentialRunner
from mlflow.exceptions import MlflowException

from gyro_pipeline import boundary
from gyro_pipeline.boundary import explanation, mask_passwords
from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.tracked_runs import TrackedRuns
from gyro_pipeline.hooks import Provenance
from gyro_pipeline.session import Session


def raised(error, cause=None):
    """An error as Kedro passes it on."""
    try:
        try:
            raise error from cause
        except Exception as inner:
            raise DatasetError("Failed while saving data") from inner
    except DatasetError as outer:
        return outer


def test_what_others_throw_becomes_a_line_and_a_defect_of_ours_does_not(tmp_path):
    for error, words in (
        (InputError("bias.csv: type make"), "bias.csv: type make"),
        (OSError(errno.ENOSPC, "No space left on device", "a.nc"), "write a.nc.*free some"),
        (PermissionError(errno.EACCES, "Permission denied", "x.db"), "x.db.*readable"),
        (RuntimeError("can't start new thread"), "memory ran out.*execution.workers"),
        (BrokenProcessPool("terminated abruptly"), "memory.*execution.workers"),
        (MlflowException("http://u:secret@h failed"), r"run store.*http://u:\*\*\*@h failed"),
    ):
        said = explanation(raised(error), tmp_path)
        assert "\n" not in said
        assert re.search(words, said), said
    assert explanation(raised(KeyError("x")), tmp_path) is None


def test_a_fault_in_the_configuration_is_named_by_file_and_line(tmp_path):
    base = tmp_path / "conf" / "base"
    base.mkdir(parents=True)
    path = base / "parameters_broken.yml"
    loader = OmegaConfigLoader(str(tmp_path / "conf"), base_env="base", default_run_env="base")
    for content, words in (
        (b"a: 1\nb: 2\na: 3\n", "line 3: found duplicate key a"),
        ("a: 1\nb: gr\xf6\xdfe\n".encode("latin-1"), "line 2: not UTF-8"),
    ):
        path.write_bytes(content)
        with pytest.raises(Exception) as caught:  # noqa: PT011 - they have no common base
            loader["parameters"]
        said = explanation(caught.value, tmp_path)
        assert said.startswith(f"configuration: {path}") and words in said


def test_passwords_in_addresses_are_masked_wherever_something_is_logged(tmp_path, caplog):
    address = "postgresql://me:s3cr@t/x@db.example:5432/runs"
    masked = "postgresql://me:***@t/x@db.example:5432/runs"
    assert mask_passwords(f"no answer: {address}, ") == f"no answer: {masked}, "
    assert mask_passwords("http://h:80/a?b=c@d") == "http://h:80/a?b=c@d"
    factory = logging.getLogRecordFactory()
    try:
        boundary.install(tmp_path)
        try:
            raise RuntimeError("postgresql://me:secret@db")
        except RuntimeError:
            logging.getLogger("anybody").exception("%s failed", "mysql://me:secret@db")
        assert "secret" not in caplog.text + str(caplog.records[0].exc_text)
        assert "mysql://me:***@db failed" in caplog.text
    finally:
        logging.setLogRecordFactory(factory)


def test_a_defect_is_shown_whole_and_kept(tmp_path, capsys, caplog, monkeypatch):
    monkeypatch.setattr(logging, "getLogRecordFactory", lambda: None)  # left as it is
    boundary.install(tmp_path)
    (tmp_path / "data").mkdir()
    error = raised(KeyError("of ours"))
    sys.excepthook(type(error), error, error.__traceback__)
    log = (tmp_path / "data" / "defect.log").read_text()
    assert "KeyError: 'of ours'" in log
    assert log.partition("\n")[2] == capsys.readouterr().err
    assert f"report it with {tmp_path / 'data' / 'defect.log'}" in caplog.text


def test_ways_to_run_that_cannot_end_well_are_refused_in_one_line(monkeypatch, tmp_path):
    installed = []
    monkeypatch.setattr(boundary, "install", installed.append)
    session = object.__new__(Session)
    session._project_path = tmp_path
    for options, words in (
        ({"only_missing_outputs": True}, "--only-missing-outputs: .* type kedro run without it"),
        ({"runner": object.__new__(ParallelRunner)}, "ParallelRunner: .*execution.workers=N"),
        ({"runner": SequentialRunner(is_async=True)}, "--async: .* type kedro run without it"),
    ):
        with pytest.raises(InputError, match=words):
            session.run(**options)
        assert installed.pop() == tmp_path  # it makes a line of the error


def test_new_runs_are_marked_with_who_made_them_by_which_command(tmp_path, monkeypatch):
    runs = TrackedRuns(str(tmp_path / "mlflow.db"))
    monkeypatch.setattr(sys, "argv", ["/usr/bin/kedro", "run", "--params=a b"])
    monkeypatch.setenv("LOGNAME", "gauss")
    pipeline = SimpleNamespace(datasets=lambda: {"dot.training.runs"})
    run_params = {"project_path": str(tmp_path), "run_id": "1", "env": None}
    Provenance().before_pipeline_run(run_params, pipeline, DataCatalog({"dot.training.runs": runs}))
    assert runs.provenance["mlflow.user"] == "gauss"
    assert runs.provenance["mlflow.source.name"] == "kedro run '--params=a b'"
    assert runs.provenance["kedro_env"] == "base"
