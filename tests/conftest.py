"""Fixtures: a project of one's own to run, and recordings with known values."""

import contextlib
import io
import logging
import os
import pickle
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
import yaml
from filelock import FileLock
from kedro.config import OmegaConfigLoader
from kedro.framework.session import KedroSession
from kedro.framework.startup import bootstrap_project
from mlflow import MlflowClient
from mlflow.entities import Run

from gyro_pipeline.conventions import AXES, DIMENSIONS, HOLD_OUT, TEST, TRAIN, VALIDATION
from gyro_pipeline.datasets.recordings import InspectedRecordings, Recordings
from gyro_pipeline.datasets.tracked_runs import TrackedRuns
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import Logs
from gyro_pipeline.parameters import Execution, Parameters, Quality
from gyro_pipeline.physics.noise import simulate_noise
from gyro_pipeline.pipelines.raw_logs.nodes import inspect_logs, label_recordings, quality_table
from gyro_pipeline.settings import CONFIG_LOADER_ARGS
from gyro_pipeline.store import relocate

ROOT = Path(__file__).parents[1]
ROLES = (TRAIN, VALIDATION, TEST)
_TIMEOUT_S = 600


@pytest.fixture(scope="session", autouse=True)
def compiled_elsewhere(tmp_path_factory):
    """What tests compile does not end up in the cache of who runs them."""
    os.environ["GYRO_PIPELINE_CACHE"] = str(tmp_path_factory.mktemp("cache"))


def listen_to_interrupts() -> None:
    """A shell lets what it runs in the background ignore Ctrl-C, and children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@dataclass(frozen=True)
class Done:
    """What a command left on the terminal."""

    code: int
    output: str


@dataclass(frozen=True)
class Project:
    """A copy of the project's configuration with data and a run store of its own."""

    folder: Path

    @property
    def store(self) -> Path:
        return self.folder / "mlflow.db"

    def start(self, *arguments: str, log: Path) -> subprocess.Popen[bytes]:
        """``kedro run`` in a process group of its own, as a shell would start it."""
        with log.open("wb") as output:
            return subprocess.Popen(
                [sys.executable, "-m", "kedro", "run", *arguments],
                cwd=self.folder,
                env=dict(os.environ) | {"PYTHONPATH": str(ROOT / "src")},
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=listen_to_interrupts,
            )

    def kedro_run(self, *arguments: str) -> Done:
        """``kedro run`` to its end."""
        log = self.folder / "terminal.log"
        process = self.start(*arguments, log=log)
        try:
            code = process.wait(_TIMEOUT_S)
        finally:
            process.kill()
        return Done(code, log.read_text())

    def run_here(self, pipeline: str, env: str, **params: Any) -> Done:
        """The same inside this process, which saves the start-up."""
        with _logged() as log:
            code = 0
            try:
                bootstrap_project(self.folder)
                with KedroSession.create(self.folder, env=env, runtime_params=params) as session:
                    session.run(pipeline_names=[pipeline])
            except Exception as error:
                code = 1
                with contextlib.redirect_stderr(log):  # where a traceback would go
                    sys.excepthook(type(error), error, error.__traceback__)
        return Done(code, log.getvalue())

    def configure(self, env: str, **files: Mapping[str, Any]) -> None:
        """Write ``conf/<env>``: ``parameters``, ``globals`` and ``catalog``."""
        folder = self.folder / "conf" / env
        folder.mkdir(exist_ok=True)
        for name, content in files.items():
            (folder / f"{name}.yml").write_text(yaml.safe_dump(dict(content)))

    def runs(self, experiment: str) -> list[Run]:
        """Runs of a study that are not deleted, in the order they were made."""
        client = MlflowClient(f"sqlite:///{self.store}")
        found = client.get_experiment_by_name(experiment)
        if found is None:
            return []
        return list(client.search_runs([found.experiment_id], order_by=["attributes.start_time"]))

    @staticmethod
    def artifacts(run: Run) -> Path:
        """Where a run keeps them."""
        return Path(run.info.artifact_uri.removeprefix("file://"))

    def weights(self, run: Run) -> dict[str, bytes]:
        """Of the last epoch of a network, bit by bit."""
        stored = {one.run_id: one for one in TrackedRuns(str(self.store)).load()}
        network = vars(stored[run.info.run_id].load_fit(HOLD_OUT))
        return {
            name: value.numpy().tobytes() for name, value in network["_artifact"]["last"].items()
        }

    def count(self, query: str) -> int:
        """What a counting query finds in the store; cheap enough to poll."""
        with sqlite3.connect(f"file:{self.store}?mode=ro", uri=True, timeout=60) as connection:
            return int(connection.execute(query).fetchone()[0])

    def files(self, part: str = "data") -> dict[str, bytes]:
        """All files below a folder, hidden ones as well, with their content."""
        paths = sorted(path for path in (self.folder / part).rglob("*") if path.is_file())
        return {str(path.relative_to(self.folder)): path.read_bytes() for path in paths}


@contextlib.contextmanager
def _logged() -> Iterator[io.StringIO]:
    """What the project says on the terminal."""
    log = io.StringIO()
    handler, logger = logging.StreamHandler(log), logging.getLogger("gyro_pipeline")
    level = logger.level
    logger.addHandler(handler)
    try:
        logger.setLevel(logging.INFO)
        yield log
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


@pytest.fixture(scope="session", autouse=True)
def _no_settings_of_this_machine() -> Iterator[None]:
    """A store, an environment or a log level set in the shell must not reach the tests."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("MLFLOW_TRACKING_URI", "KEDRO_ENV", "KEDRO_LOGGING_CONFIG"):
            patch.delenv(name, raising=False)
        yield


@pytest.fixture(autouse=True)
def _excepthook(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run sets it, also one inside this process."""
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)


@pytest.fixture(scope="session")
def _empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """MLflow takes seconds to make one."""
    path = tmp_path_factory.mktemp("store") / "mlflow.db"
    MlflowClient(f"sqlite:///{path}").search_experiments()
    return path


@pytest.fixture(scope="session")
def new_project(
    tmp_path_factory: pytest.TempPathFactory, _empty_store: Path
) -> Callable[..., Project]:
    """Makes projects without data; ``with_store=False`` leaves the run store out as well."""

    def make(with_store: bool = True) -> Project:
        folder = tmp_path_factory.mktemp("project")
        for name in ("pyproject.toml", "requirements.lock", ".telemetry"):
            shutil.copy(ROOT / name, folder)
        # settings of this machine stay out
        shutil.copytree(ROOT / "conf", folder / "conf", ignore=shutil.ignore_patterns("local"))
        for name in ("conf/local", "data", "src"):
            (folder / name).mkdir()
        if with_store:
            shutil.copy(_empty_store, folder / "mlflow.db")
        return Project(folder)

    return make


@dataclass(frozen=True)
class Ran:
    """A finished run of the smoke environment, as it was then: later ones do not change this."""

    project: Project
    done: Done
    runs: list[Run]
    files: dict[str, bytes]


@pytest.fixture(scope="session")
def smoke(new_project: Callable[..., Project], tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """``kedro run --pipeline=augmentation --env=smoke`` in a project without anything.

    Each process of the tests gets a copy of one such run.
    """
    common = tmp_path_factory.getbasetemp()
    made = (common.parent if "PYTEST_XDIST_WORKER" in os.environ else common) / "smoke"
    project = new_project(with_store=False)
    with FileLock(f"{made}.lock"):
        if not made.exists():
            done = project.kedro_run("--pipeline=augmentation", "--env=smoke")
            ran = Ran(project, done, project.runs("augmentation"), project.files())
            shutil.copytree(project.folder, made)
            Path(f"{made}.pickle").write_bytes(pickle.dumps(ran))
            return ran
    shutil.copytree(made, project.folder, dirs_exist_ok=True)
    relocate(project.store, str(project.folder / "mlruns"))
    return replace(pickle.loads(Path(f"{made}.pickle").read_bytes()), project=project)


@pytest.fixture(scope="session")
def parameters() -> Callable[..., Parameters]:
    """Parameters of an environment, with some groups changed: ``parameters(splits={...})``."""

    def load(env: str = "smoke", **changes: Mapping[str, Any]) -> Parameters:
        settings: dict[str, Any] = dict(CONFIG_LOADER_ARGS)
        loader = OmegaConfigLoader(str(ROOT / "conf"), env, changes, **settings)
        return Parameters(**loader["parameters"])

    return load


@pytest.fixture(scope="session")
def read_logs(
    parameters: Callable[..., Parameters],
) -> Callable[..., tuple[xr.Dataset, pd.DataFrame]]:
    """The raw-logs stage with its datasets, as ``kedro run`` wires them."""
    splits = parameters("base").splits

    def read(
        files: Logs, quality: Quality, folder: Path, workers: int | None = None
    ) -> tuple[xr.Dataset, pd.DataFrame]:
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
def make_recordings() -> Callable[..., xr.Dataset]:
    """White noise of known N around known biases, in the layout of the conventions.

    ``split``: how many recordings train, validate and test, in this order; none for a k-fold.
    """

    def make(
        bias: np.ndarray,
        samples: int,
        rate_hz: float,
        noise_dps_rts: float,
        seed: int = 0,
        split: tuple[int, int, int] | None = None,
    ) -> xr.Dataset:
        generator = np.random.default_rng(seed)
        rates = simulate_noise(generator, (*bias.shape, samples), rate_hz, noise_dps_rts)
        rates += bias[..., None].astype(np.float32)
        return xr.Dataset(
            {
                "angular_rate": (DIMENSIONS, rates),
                "samples": (DIMENSIONS[:2], np.full(bias.shape[:2], samples)),
            },
            coords={
                "imu": np.arange(1, 1 + bias.shape[0]),
                "recording": np.arange(1, 1 + bias.shape[1]),
                "axis": list(AXES),
            }
            | ({"split": ("recording", np.repeat(ROLES, split))} if split else {}),
            attrs={
                "sensor": "sparkfun",
                "source": "test",
                "simulated": 0,
                "rate_hz": rate_hz,
                "data_hash": data_hash(rates, []),
            },
        )

    return make
