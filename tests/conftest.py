"""Fixtures: a project of one's own to run, and recordings with known values.

Kedro, MLflow and others start slowly and many tests use none of them, so they are imported late.
"""

import contextlib
import io
import logging
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections import namedtuple
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from filelock import FileLock

from gyro_pipeline.conventions import AXES, DIMENSIONS, HOLD_OUT, TEST, TRAIN, VALIDATION

ROOT = Path(__file__).parents[1]
ROLES = (TRAIN, VALIDATION, TEST)
_TIMEOUT_S = 600
FEW = {"windows_s": [10], "training": {"epochs": 2}}
"""Less of the smoke environment, enough for stories."""


def pytest_collection_modifyitems(items):
    """What runs the pipelines is slow, and what is slow is run first: workers then end together."""
    for item in items:
        if {"new_project", "smoke"} & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


Done = namedtuple("Done", "code output")
"""What a command left on the terminal."""
Ran = namedtuple("Ran", "project done runs changes")
"""A finished run of the smoke environment, which changes of the parameters make small."""


@dataclass(frozen=True)
class Project:
    """A copy of the project's configuration with data and a run store of its own."""

    folder: Path

    @property
    def store(self):
        return self.folder / "mlflow.db"

    @property
    def log(self):
        return self.folder / "terminal.log"

    def start(self, *arguments):
        """``kedro run`` in a process group of its own, as a shell would start it."""
        command = [sys.executable, "-m", "kedro", "run", *arguments]
        given = {"cwd": self.folder, "env": dict(os.environ) | {"PYTHONPATH": str(ROOT / "src")}}
        # children inherit that a shell's background jobs ignore Ctrl-C
        given["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
        with self.log.open("wb") as output:
            told = {"stdout": output, "stderr": subprocess.STDOUT}
            return subprocess.Popen(command, start_new_session=True, **given, **told)

    def kedro_run(self, *arguments):
        """``kedro run`` to its end, in a process of its own."""
        process = self.start(*arguments)
        try:
            code = process.wait(_TIMEOUT_S)
        finally:
            process.kill()
        return Done(code, self.log.read_text())

    def command(self, *arguments):
        """``kedro run`` inside this process, which saves the start-up."""
        from kedro.framework.cli.project import run

        return self._here(lambda: run.main(list(arguments), standalone_mode=False))

    def run_here(self, pipeline, env, changed_only=False, **params):
        """A pipeline inside this process: all nodes, or what changed, as ``kedro run`` does."""
        from kedro.framework.session import KedroSession

        from gyro_pipeline.session import Session

        kind = Session if changed_only else KedroSession

        def run():
            with kind.create(self.folder, env=env, runtime_params=params) as session:
                session.run(pipeline_names=[pipeline])

        return self._here(run)

    def _here(self, run):
        from kedro.framework.startup import bootstrap_project

        code, log, logger = 0, io.StringIO(), logging.getLogger("gyro_pipeline")
        handler, level = logging.StreamHandler(log), logger.level
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        with contextlib.chdir(self.folder):
            try:
                bootstrap_project(self.folder)
                run()
            except Exception as error:
                code = 1
                with contextlib.redirect_stderr(log):  # where a traceback would go
                    sys.excepthook(type(error), error, error.__traceback__)
            finally:
                logger.removeHandler(handler)
                logger.setLevel(level)
        return Done(code, log.getvalue())

    def amend(self, env, **parameters):
        """Change some parameters of an environment."""
        path = self.folder / "conf" / env / "parameters.yml"
        path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | parameters))

    def runs(self, experiment):
        """Runs of a study that are not deleted, in the order they were made."""
        from mlflow import MlflowClient

        client = MlflowClient(f"sqlite:///{self.store}")
        study = client.get_experiment_by_name(experiment)
        order = ["attributes.start_time"]
        return list(client.search_runs([study.experiment_id], order_by=order)) if study else []

    @staticmethod
    def artifacts(run):
        """Where a run keeps them."""
        return Path(run.info.artifact_uri.removeprefix("file://"))

    def weights(self, run):
        """Of the last epoch of a network, bit by bit."""
        from gyro_pipeline.datasets.tracked_runs import TrackedRuns

        stored = {one.run_id: one for one in TrackedRuns(str(self.store)).load()}
        weights = vars(stored[run.info.run_id].load_fit(HOLD_OUT))["_artifact"]["last"]
        return {name: value.numpy().tobytes() for name, value in weights.items()}

    def count(self, query):
        """What a counting query finds in the store; cheap enough to poll."""
        with sqlite3.connect(f"file:{self.store}?mode=ro", uri=True, timeout=60) as connection:
            return int(connection.execute(query).fetchone()[0])

    def files(self, part="data"):
        """All files below a folder, hidden ones as well, with their content; but for the lock."""
        paths = sorted(path for path in (self.folder / part).rglob("*") if path.is_file())
        paths = [path for path in paths if path.name != "run.lock"]
        return {str(path.relative_to(self.folder)): path.read_bytes() for path in paths}


@pytest.fixture(scope="session", autouse=True)
def _no_settings_of_this_machine(tmp_path_factory):
    """Settings in the shell do not reach the tests, nor they the cache of who runs them."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("MLFLOW_TRACKING_URI", "KEDRO_ENV", "KEDRO_LOGGING_CONFIG"):
            patch.delenv(name, raising=False)
        patch.setenv("GYRO_PIPELINE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def _excepthook(monkeypatch):
    """A run sets it, also one inside this process."""
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)


@pytest.fixture(scope="session")
def real_file():
    """Paths of real recordings, by name; who asks for one that is not there is skipped."""

    def named(name):
        path = Path(os.environ.get("GYRO_PIPELINE_REAL_DATA", ""), name)
        if not path.is_file():
            pytest.skip(f"GYRO_PIPELINE_REAL_DATA names no folder with {name}")
        return path

    return named


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """Makes a folder once for all processes that run tests: ``made_once(name, make)``."""
    own = tmp_path_factory.getbasetemp()
    common = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def made(name, make):
        folder = common / name
        with FileLock(f"{folder}.lock"):
            if not (folder / "complete").exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                (folder / "complete").touch()
        return folder

    return made


def configured(folder):
    """A project without data and without a run store; settings of this machine stay out."""
    for name in ("pyproject.toml", "requirements.lock", ".telemetry"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "conf", folder / "conf", ignore=shutil.ignore_patterns("local"))
    for name in ("conf/local", "data", "src"):
        (folder / name).mkdir()
    return Project(folder)


@pytest.fixture(scope="session")
def new_project(tmp_path_factory, made_once):
    """Makes projects without data, with an empty run store, which takes MLflow seconds to make."""
    from gyro_pipeline.datasets.run_store import make_store

    empty = made_once("store", lambda folder: make_store(folder / "mlflow.db"))

    def make():
        project = configured(tmp_path_factory.mktemp("project"))
        shutil.copy(empty / "mlflow.db", project.store)
        return project

    return make


@pytest.fixture(autouse=True, scope="module")
def own_workers():
    """Workers that outlive a file of tests do not find the modules of the next one."""
    yield
    if "joblib" in sys.modules:
        from joblib.externals.loky import get_reusable_executor

        get_reusable_executor().shutdown()


@pytest.fixture(scope="session")
def smoke(made_once):
    """``kedro run --pipeline=augmentation --env=smoke``, once; to change it, see ``smoke_copy``."""

    def make(folder):
        project = configured(folder)
        # few fits are not worth the start of processes
        project.amend("smoke", **FEW, execution={"executor": "serial"})
        done = project.kedro_run("--pipeline=augmentation", "--env=smoke")
        (folder / "code").write_text(str(done.code))

    project = Project(made_once("smoke", make))
    done = Done(int((project.folder / "code").read_text()), project.log.read_text())
    return Ran(project, done, project.runs("augmentation"), FEW)


@pytest.fixture
def smoke_copy(smoke, tmp_path):
    """Another project with the same data and runs, to go on with."""
    from gyro_pipeline.store import relocate

    project = Project(shutil.copytree(smoke.project.folder, tmp_path / "project"))
    relocate(project.store, str(project.folder / "mlruns"))
    return project


@pytest.fixture(scope="session")
def parameters():
    """Parameters of an environment, with some groups changed: ``parameters(splits={...})``."""
    from kedro.config import OmegaConfigLoader

    from gyro_pipeline.parameters import Parameters
    from gyro_pipeline.settings import CONFIG_LOADER_ARGS

    def load(env="smoke", **changes):
        loader = OmegaConfigLoader(str(ROOT / "conf"), env, changes, **CONFIG_LOADER_ARGS)
        return Parameters(**loader["parameters"])

    return load


@pytest.fixture(scope="session")
def read_logs(parameters):
    """The raw-logs stage with its datasets, as ``kedro run`` wires them."""
    from gyro_pipeline.datasets.recordings import InspectedRecordings, Recordings
    from gyro_pipeline.parameters import Execution
    from gyro_pipeline.pipelines.raw_logs.nodes import inspect_logs, label_recordings, quality_table

    splits = parameters("base").splits

    def read(files, quality, folder, workers=None):
        """Recordings, and the table of their quality; few of them have no split."""
        execution = Execution(executor="processes" if workers else "serial", workers=workers)
        path = str(folder / "recordings.nc")
        reading, final = InspectedRecordings(path), Recordings(path)
        for item in inspect_logs(files, reading.load(), quality, execution):
            reading.save(item)
        table = quality_table(files, reading.load())
        final.save(label_recordings(files, reading.load(), table, quality, splits))
        return final.load(), table

    return read


@pytest.fixture(scope="session")
def make_recordings():
    """White noise of known N around known biases, in the layout of the conventions.

    ``split``: how many recordings train, validate and test, in this order; none for a k-fold.
    """
    import xarray as xr

    from gyro_pipeline.fingerprints import data_hash
    from gyro_pipeline.physics.noise import simulate_noise

    def make(bias, samples, rate_hz, noise_dps_rts, seed=0, split=None):
        generator = np.random.default_rng(seed)
        rates = simulate_noise(generator, (*bias.shape, samples), rate_hz, noise_dps_rts)
        rates += bias[..., None].astype(np.float32)
        imus, recordings, _ = bias.shape
        coords = {"imu": np.arange(1, 1 + imus), "recording": np.arange(1, 1 + recordings)}
        if split:
            coords["split"] = ("recording", np.repeat(ROLES, split))
        lengths = np.full(bias.shape[:2], samples)
        data = {"angular_rate": (DIMENSIONS, rates), "samples": (DIMENSIONS[:2], lengths)}
        attrs = {"sensor": "sparkfun", "source": "test", "simulated": 0, "rate_hz": rate_hz}
        attrs["data_hash"] = data_hash(rates, [])
        return xr.Dataset(data, coords | {"axis": list(AXES)}, attrs)

    return make
