"""Hooks around a run: checks before it, provenance of its results, directions after it.

Every ``kedro`` command imports this file, so large packages are imported where they are used.
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
"""The seven stages as boxes, without the datasets between them, which exist for each sensor."""

_WITHOUT_EFFECT = ("execution", "only")
"""Settings that decide which results are computed, and how, but not their values."""


class Preflight:
    """Refuses runs that would fail, before any node runs."""

    def __init__(self) -> None:
        self._parameters: Parameters | None = None
        self._project = Path()

    @hook_impl
    def after_context_created(self, context: "Context") -> None:
        """Keep the checked parameters."""
        self._project, self._parameters = Path(context.project_path), context.parameters

    @hook_impl(tryfirst=True)  # before any dataset is created
    def before_pipeline_run(
        self, run_params: dict[str, Any], pipeline: "Pipeline", catalog: "CatalogProtocol"
    ) -> None:
        """Check the studies, the logs, the run store, stored inputs and the paths of results."""
        from gyro_pipeline.datasets.atomic import check_writable, remove_leftovers  # noqa: PLC0415
        from gyro_pipeline.datasets.stored import StoredFile  # noqa: PLC0415
        from gyro_pipeline.datasets.tracked_runs import TrackedRuns  # noqa: PLC0415
        from gyro_pipeline.studies import DEFAULT_PIPELINE, check_possible  # noqa: PLC0415

        assert self._parameters is not None
        check_possible(self._parameters, run_params["pipeline_names"] or [DEFAULT_PIPELINE])
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
        _set_provenance(settings, pipeline, catalog)
        sensor = self._parameters.only.sensor  # a report shows stored results of all others
        for name in sorted(pipeline.inputs()):
            dataset = catalog.get(name)
            if isinstance(dataset, StoredFile) and sensor in (None, *name.split(".")):
                dataset.check_made_with(settings)

    @hook_impl
    def after_pipeline_run(
        self, run_result: dict[str, Any], pipeline: "Pipeline", catalog: "CatalogProtocol"
    ) -> None:
        """Log where the results are and how to look at them."""
        reports = pipeline.all_outputs() & {"reporting.report"}
        for path in (path for name in reports for path in _paths(catalog.get(name))):
            logger.info("tables and figures: %s", _relative(path.parent, self._project))
            logger.info("report:             %s", _relative(path, self._project))
        if not reports:
            tables = (".raw_logs.quality", ".ground_truth.bias")
            for name in sorted(name for name in pipeline.all_outputs() if name.endswith(tables)):
                for path in _paths(catalog.get(name)):
                    logger.info("table:              %s", _relative(path, self._project))
        if run_result:  # empty where no node ran
            for link in _run_links(catalog.get(name) for name in sorted(pipeline.datasets())):
                logger.info("compare runs:       %s", link)
        logger.info("see the lineage:    kedro viz, then %s", _STAGES)


class Provenance:
    """Tags every new run with the code, packages, settings and command behind it."""

    def __init__(self) -> None:
        self._changed_settings = frozenset[str]()

    @hook_impl
    def after_context_created(self, context: "Context") -> None:
        """Compare the settings of runs with those of ``conf/base``."""
        import yaml  # noqa: PLC0415

        # a second configuration loader would replace the globals of the first
        folder = Path(context.config_loader.conf_source, "base", "parameters")
        base: dict[str, Any] = {}
        for path in folder.glob("*.yml"):
            base |= yaml.safe_load(path.read_text())
        self._changed_settings = _changed_settings(base, context.configuration)

    @hook_impl
    def before_pipeline_run(
        self, run_params: dict[str, Any], pipeline: "Pipeline", catalog: "CatalogProtocol"
    ) -> None:
        """Pass the tags to the datasets that create runs."""
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
                dataset.changed = self._changed_settings


def _settings(parameters: "Parameters") -> dict[str, Any]:
    """All parameters as JSON holds them, and each study also under its name in the catalog."""
    groups = parameters.model_dump(mode="json")
    return groups | {f"studies.{name}": study for name, study in groups["studies"].items()}


def _set_provenance(
    parameters: dict[str, Any], pipeline: "Pipeline", catalog: "CatalogProtocol"
) -> None:
    """Set, for each stored file, the settings and the stored files that it depends on."""
    from gyro_pipeline.datasets.stored import StoredFile  # noqa: PLC0415

    in_memory: dict[str, tuple[dict[str, Any], list[StoredFile]]] = {}
    for node in pipeline.nodes:
        names = [name.removeprefix("params:") for name in node.inputs if name.startswith("params:")]
        settings = {name: parameters[name] for name in names if name not in _WITHOUT_EFFECT}
        sources = []
        for name in node.inputs:
            if isinstance(source := catalog.get(name), StoredFile):
                sources.append(source)
            elif name in in_memory:
                settings |= in_memory[name][0]
                sources += in_memory[name][1]
        for name in node.outputs:
            if isinstance(dataset := catalog.get(name), StoredFile):
                dataset.settings, dataset.sources = settings, sources
            else:
                in_memory[name] = settings, sources


def _changed_settings(base: Mapping[str, Any], configuration: Mapping[str, Any]) -> frozenset[str]:
    """Names of the settings of runs that differ from those of ``conf/base``."""
    return frozenset(
        f"virtual_{key}" if group == "virtual_gyros" else key
        for group in ("splits", "virtual_gyros", "training")
        for key, value in (configuration.get(group) or {}).items()
        if base.get(group, {}).get(key) != value
    )


def _check_logs_are_read(
    parameters: "Parameters", project: Path, pipeline: "Pipeline", catalog: "CatalogProtocol"
) -> None:
    """Refuse a folder of logs that no catalog entry reads, instead of using other recordings."""
    options: dict[str, Any] = {}
    if parameters.logs is not None:
        options["path"] = str(project / parameters.logs)
    if parameters.reader is not None:
        options["reader"] = parameters.reader.model_dump(exclude_defaults=True)
    names = [name for name in pipeline.inputs() if name.endswith(".raw_logs.files")]
    sources = [source._describe() for name in names if (source := catalog.get(name))]
    if sources and not any(options.items() <= source.items() for source in sources):
        params = [name for name in ("logs", "reader") if getattr(parameters, name) is not None]
        raise InputError(
            f"{' and '.join(params)} of --params: not used by this environment, which reads "
            f"{', '.join(source['path'] for source in sources)}; "
            "type --env=logs --params=logs=FOLDER, or write a catalog entry"
        )


def _run_links(datasets: Iterable[Any]) -> list[str]:
    """How to look at the runs of each study."""
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
    """The path of a dataset; empty for a dataset in memory."""
    description = dataset._describe()
    if "dataset_type" in description:  # a folder of files with any name
        return [Path(description["path"], "*")]
    return [Path(description[key]) for key in ("filepath", "path") if key in description]


def _relative(path: Path, project: Path) -> Path:
    return path.relative_to(project) if path.is_relative_to(project) else path


def _file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.exists() else "no lock file"


def _version(project: Path) -> dict[str, str]:
    """Tags for the commit of the project and for uncommitted changes; unknown without git."""
    tags = dict.fromkeys(("mlflow.source.git.commit", "git_dirty"), "unknown")
    top = _git(project, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != project.resolve():  # a checkout of another project
        return tags
    commit, changes = _git(project, "rev-parse", "HEAD"), _git(project, "status", "--porcelain")
    if commit is None or changes is None:
        return tags
    return {"mlflow.source.git.commit": commit, "git_dirty": str(bool(changes))}


def _git(project: Path, *arguments: str) -> str | None:
    """The output of git; None where git is absent or fails, e.g. as the project is no checkout."""
    command = ["git", "-C", str(project), *arguments]
    try:
        git = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return git.stdout.strip() if git.returncode == 0 else None
