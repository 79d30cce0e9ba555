"""What happens around a run: checks before it, provenance for its runs, directions after it.

Every ``kedro`` command imports this file, so it imports what is large only where it is used.
"""

import getpass
import hashlib
import logging
import platform
import shlex
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kedro.framework.hooks import hook_impl

from gyro_pipeline.conventions import InputError

if TYPE_CHECKING:
    from kedro.io import CatalogProtocol
    from kedro.pipeline import Pipeline

    from gyro_pipeline.parameters import Parameters
    from gyro_pipeline.session import Context

logger = logging.getLogger(__name__)

_STAGES = "http://127.0.0.1:4141/?types=task"
"""The seven stages as boxes, without the datasets between them, which there are for each sensor."""

_WITHOUT_EFFECT = ("execution", "only")
"""Settings that change how much is made, and how, but no number."""


class Preflight:
    """Refuses what cannot end well, before any node runs."""

    def __init__(self) -> None:
        self._parameters: Parameters | None = None
        self._project = Path()

    @hook_impl
    def after_context_created(self, context: "Context") -> None:
        """Note what the context has checked."""
        self._project, self._parameters = Path(context.project_path), context.parameters

    @hook_impl(tryfirst=True)  # before any dataset is made
    def before_pipeline_run(
        self, run_params: dict[str, Any], pipeline: "Pipeline", catalog: "CatalogProtocol"
    ) -> None:
        """Check what these pipelines ask for, and that every result can be written."""
        from gyro_pipeline.datasets.atomic import check_writable, remove_leftovers  # noqa: PLC0415
        from gyro_pipeline.datasets.stored import StoredFile  # noqa: PLC0415
        from gyro_pipeline.datasets.tracked_runs import TrackedRuns  # noqa: PLC0415
        from gyro_pipeline.studies import DEFAULT, check_possible  # noqa: PLC0415

        assert self._parameters is not None
        check_possible(self._parameters, run_params["pipeline_names"] or [DEFAULT])
        _check_logs_are_read(self._parameters, self._project, pipeline, catalog)
        for name in sorted(pipeline.datasets()):
            if isinstance(dataset := catalog.get(name), TrackedRuns):
                dataset.check_reachable()
        outputs = {path for name in pipeline.all_outputs() for path in _paths(catalog.get(name))}
        for path in sorted(outputs):
            check_writable(path)
        for folder in sorted({path.parent for path in outputs}):
            remove_leftovers(folder)
        settings = _settings(self._parameters)
        _hand_over(settings, pipeline, catalog)
        sensor = self._parameters.only.sensor  # of others a report shows what is there
        for name in sorted(pipeline.inputs()):
            dataset = catalog.get(name)
            if isinstance(dataset, StoredFile) and sensor in (None, *name.split(".")):
                dataset.check_made_with(settings)

    @hook_impl
    def after_pipeline_run(
        self, run_result: dict[str, Any], pipeline: "Pipeline", catalog: "CatalogProtocol"
    ) -> None:
        """Say where the results are and how to look at them."""
        reports = pipeline.all_outputs() & {"reporting.report"}
        for path in (path for name in reports for path in _paths(catalog.get(name))):
            logger.info("tables and figures: %s", _relative(path.parent, self._project))
            logger.info("report:             %s", _relative(path, self._project))
        if not reports:  # no runs either
            ends = (".raw_logs.quality", ".ground_truth.bias")
            for name in sorted(name for name in pipeline.all_outputs() if name.endswith(ends)):
                for path in _paths(catalog.get(name)):
                    logger.info("table:              %s", _relative(path, self._project))
        if run_result:  # where nothing was run, nothing is new
            for link in _run_links(catalog.get(name) for name in sorted(pipeline.datasets())):
                logger.info("compare runs:       %s", link)
        logger.info("see the lineage:    kedro viz, then %s", _STAGES)


class Provenance:
    """Marks every new run with the code, packages, settings and command that made it."""

    def __init__(self) -> None:
        self._changed = frozenset[str]()

    @hook_impl
    def after_context_created(self, context: "Context") -> None:
        """Compare the settings of runs with those of ``conf/base``."""
        import yaml  # noqa: PLC0415

        # not by a second loader, whose globals would take the place of the first one's
        files = Path(context.config_loader.conf_source, "base", "parameters").glob("*.yml")
        base: dict[str, Any] = {}
        for path in files:
            base |= yaml.safe_load(path.read_text())
        self._changed = _changed(base, context.given)

    @hook_impl
    def before_pipeline_run(
        self, run_params: dict[str, Any], pipeline: "Pipeline", catalog: "CatalogProtocol"
    ) -> None:
        """Hand the tags to the datasets that create runs."""
        from gyro_pipeline.datasets.tracked_runs import TrackedRuns  # noqa: PLC0415

        project = Path(run_params["project_path"])
        tags = {
            "kedro_run": run_params["run_id"],
            "kedro_env": run_params["env"] or "base",
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "numpy", "gyro-pipeline")},
            "lock_hash": _file_hash(project / "requirements.lock"),
            **_version(project),
            "mlflow.user": _user(),
            "mlflow.source.name": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
            "mlflow.source.type": "LOCAL",
        }
        for name in pipeline.datasets():
            dataset = catalog.get(name)
            if isinstance(dataset, TrackedRuns):
                dataset.provenance |= tags
                dataset.changed = self._changed


def _settings(parameters: "Parameters") -> dict[str, Any]:
    """All parameters, and each study by the name that nodes ask for it by, as JSON holds them."""
    given = parameters.model_dump(mode="json")
    return given | {f"studies.{name}": study for name, study in given["studies"].items()}


def _hand_over(given: dict[str, Any], pipeline: "Pipeline", catalog: "CatalogProtocol") -> None:
    """Tell each stored file with which settings, and from which other ones, it is made."""
    from gyro_pipeline.datasets.stored import StoredFile  # noqa: PLC0415

    passed: dict[str, tuple[dict[str, Any], list[StoredFile]]] = {}  # on in memory
    for node in pipeline.nodes:
        names = [name.removeprefix("params:") for name in node.inputs if name.startswith("params:")]
        settings = {name: given[name] for name in names if name not in _WITHOUT_EFFECT}
        sources = []
        for name in node.inputs:
            if isinstance(source := catalog.get(name), StoredFile):
                sources.append(source)
            elif name in passed:
                settings |= passed[name][0]
                sources += passed[name][1]
        for name in node.outputs:
            if isinstance(dataset := catalog.get(name), StoredFile):
                dataset.settings, dataset.sources = settings, sources
            else:
                passed[name] = settings, sources


def _changed(base: Mapping[str, Any], given: Mapping[str, Any]) -> frozenset[str]:
    """Names of the settings of runs that differ from those of ``conf/base``."""
    return frozenset(
        f"virtual_{key}" if group == "virtual_gyros" else key
        for group in ("splits", "virtual_gyros", "training")
        for key, value in (given.get(group) or {}).items()
        if base.get(group, {}).get(key) != value
    )


def _check_logs_are_read(
    parameters: "Parameters", project: Path, pipeline: "Pipeline", catalog: "CatalogProtocol"
) -> None:
    """Refuse a folder of logs that nothing reads, rather than to run on other recordings."""
    asked: dict[str, Any] = {}
    if parameters.logs is not None:
        asked["path"] = str(project / parameters.logs)
    if parameters.reader is not None:
        asked["reader"] = parameters.reader.model_dump(exclude_defaults=True)
    sources = [name for name in pipeline.inputs() if name.endswith(".raw_logs.files")]
    read = [source._describe() for name in sources if (source := catalog.get(name))]
    if read and not any(asked.items() <= source.items() for source in read):
        given = [name for name in ("logs", "reader") if getattr(parameters, name) is not None]
        raise InputError(
            f"{' and '.join(given)} of --params: not taken by what is read here, "
            f"{', '.join(source['path'] for source in read)}; "
            "type --env=logs --params=logs=FOLDER, or give it in a catalog entry of your own"
        )


def _run_links(datasets: Iterable[Any]) -> list[str]:
    """Where to look at the runs of each study."""
    from gyro_pipeline.datasets.tracked_runs import (  # noqa: PLC0415
        USER_INTERFACE,
        TrackedRuns,
        run_link,
    )

    by_study = defaultdict(list)
    for dataset in datasets:
        if isinstance(dataset, TrackedRuns) and dataset.study is not None:
            by_study[dataset.study].append(dataset)
    links = [link for runs in by_study.values() if (link := run_link(runs)) is not None]
    return ["mlflow ui, then " * link.startswith(USER_INTERFACE) + link for link in links]


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container may have a number and no name
        return "unknown"


def _paths(dataset: Any) -> list[Path]:
    """Where a dataset is stored; nowhere if it is kept in memory."""
    described = dataset._describe()
    if "dataset_type" in described:  # a folder of files of any name
        return [Path(described["path"], "*")]
    return [Path(described[key]) for key in ("filepath", "path") if key in described]


def _relative(path: Path, project: Path) -> Path:
    return path.relative_to(project) if path.is_relative_to(project) else path


def _file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.exists() else "no lock file"


def _version(project: Path) -> dict[str, str]:
    """The commit of the project, and whether files differ from it; unknown if git cannot say."""
    tags = dict.fromkeys(("mlflow.source.git.commit", "git_dirty"), "unknown")
    top = _git(project, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != project.resolve():  # none, or of another project
        return tags
    commit, changes = _git(project, "rev-parse", "HEAD"), _git(project, "status", "--porcelain")
    if commit is None or changes is None:
        return tags
    return {"mlflow.source.git.commit": commit, "git_dirty": str(bool(changes))}


def _git(project: Path, *arguments: str) -> str | None:
    """What git says; None where the project is no checkout of this user, or git is absent."""
    command = ["git", "-C", str(project), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None
