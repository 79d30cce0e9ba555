"""Kedro's context and session with checked parameters and one run at a time.

Every ``kedro`` command imports this file, so large packages are imported where they are used.
"""

import hashlib
import logging
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import chdir, contextmanager
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any

from kedro.framework.context import KedroContext
from kedro.framework.session import KedroSession

from gyro_pipeline import boundary, pipeline_registry, run_lock
from gyro_pipeline.conventions import InputError

if TYPE_CHECKING:
    from pydantic import ValidationError

    from gyro_pipeline.parameters import Parameters

logger = logging.getLogger(__name__)

_NAMES_NODES = ("node_names", "from_nodes", "to_nodes", "from_inputs", "to_outputs", "tags")
"""Options that name nodes, which then run even if they are up to date."""

OWN_SETTINGS = "own_settings"
"""Resolver of the catalog for a folder that is named after the settings of a command, if any."""

_CHANGE_NO_RESULT = ("execution", "logs", "reader")
_LONGEST_NAME = 80


def settings_in_words(params: Mapping[str, Any], prefix: str = "") -> str:
    """Name the settings that a command gave with ``--params``, such as ``only.sensor=dot``.

    Reports of runs with such settings are kept apart, so that they never replace the report of the
    full study.

    Args:
        params: The settings; those that change no result, such as execution, are not named.
        prefix: Prefix of the keys.

    Returns:
        A name for a folder; empty without settings.
    """
    words = []
    for key, value in sorted(params.items()):
        if isinstance(value, Mapping):
            words.append(settings_in_words(value, f"{prefix}{key}."))
        else:
            words.append(re.sub(r"[^\w.=+-]+", "-", f"{prefix}{key}={value}").strip("-"))
    if prefix:
        return ",".join(words)
    name = ",".join(word for word in words if word and not word.startswith(_CHANGE_NO_RESULT))
    if len(name) <= _LONGEST_NAME:
        return name
    return f"{name[:_LONGEST_NAME]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def parse_parameters(configuration: Mapping[str, Any]) -> "Parameters":
    """Parse and check the parameters of a configuration.

    Raises:
        InputError: A parameter is unknown, missing or out of bounds.
    """
    from pydantic import ValidationError  # noqa: PLC0415

    from gyro_pipeline.parameters import Parameters  # noqa: PLC0415

    try:
        return Parameters(**configuration)
    except ValidationError as error:
        raise InputError(_explanation(error)) from None


def check_options(options: Mapping[str, Any]) -> None:
    """Refuse options of ``kedro run`` that do not suit these pipelines.

    Raises:
        InputError: It names the option, and what to type.
    """
    from kedro.runner import ParallelRunner  # noqa: PLC0415

    runner = options.get("runner")
    if options.get("only_missing_outputs"):
        raise InputError(
            "--only-missing-outputs: Kedro cannot see which runs a run store lacks; type kedro run "
            "without it, which makes only the runs that are not FINISHED"
        )
    if isinstance(runner, ParallelRunner):
        raise InputError(
            "--runner=ParallelRunner: each node starts its own processes; type kedro run without "
            "it, and --params=execution.workers=N for N processes"
        )
    if getattr(runner, "_is_async", False):
        raise InputError(
            "--async: each result is saved as soon as it is computed, which Kedro cannot do in the "
            "background; type kedro run without it"
        )


class Context(KedroContext):
    """A context that checks the parameters and selects the pipelines by them.

    Kedro builds pipelines after the context, for every command that has an environment, such as
    ``kedro run`` and ``kedro viz``.

    Attributes:
        configuration: Parameters as in the configuration files.
        parameters: The same, checked.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        from omegaconf import OmegaConf  # noqa: PLC0415

        boundary.install(Path(self.project_path))
        self.configuration = self.config_loader["parameters"]
        self.parameters = parse_parameters(self.configuration)
        pipeline_registry.select(self.parameters)
        name = settings_in_words(self.config_loader.runtime_params or {})
        OmegaConf.register_new_resolver(OWN_SETTINGS, lambda: name and f"/{name}", replace=True)


class Session(KedroSession):
    """A session that runs changed nodes only, from any folder, while no other run works."""

    def run(self, *arguments: Any, **options: Any) -> dict[str, Any]:
        """Run pipelines, as :meth:`kedro.framework.session.KedroSession.run` does.

        Raises:
            InputError: The runner or an option does not suit these pipelines.
        """
        from kedro.runner import SequentialRunner  # noqa: PLC0415

        project = self._project_path
        boundary.install(project)
        check_options(options)
        run_lock.check_folder(project)
        every_node = not any(map(options.get, _NAMES_NODES))
        interrupts = run_lock.Interrupts()
        self._hook_manager.register(interrupts)
        with self._in_project(), run_lock.only_run(project / "data" / "run.lock"):
            if type(options.get("runner")) in (SequentialRunner, NoneType) and every_node:
                from gyro_pipeline.runner import ChangedNodesRunner  # noqa: PLC0415

                options["runner"] = ChangedNodesRunner(project / "data" / "ended_nodes.json")
            try:
                with interrupts.watch():
                    return super().run(*arguments, **options)
            except KeyboardInterrupt:
                logger.error("interrupted: finished work is stored; the same command continues")
                raise
            finally:
                self._hook_manager.unregister(interrupts)

    @contextmanager
    def _in_project(self) -> Iterator[None]:
        """Use the paths and the log settings of the project, whatever the current folder is."""
        if Path.cwd() != self._project_path and "KEDRO_LOGGING_CONFIG" not in os.environ:
            import yaml  # noqa: PLC0415
            from kedro.framework.project import configure_logging  # noqa: PLC0415

            settings = self._project_path / "conf" / "logging.yml"
            configure_logging(yaml.safe_load(settings.read_text(encoding="utf-8")))
        with chdir(self._project_path):
            yield


def _explanation(error: "ValidationError") -> str:
    from gyro_pipeline.parameters import ReaderOptions  # noqa: PLC0415

    lines = []
    for problem in error.errors():
        where = ".".join(str(part) for part in problem["loc"]) or "parameters"
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "extra_forbidden":
            message = "unknown key; see conf/base for all keys"
            if problem["loc"][0] == "reader":
                message = f"unknown key; expected one of {', '.join(ReaderOptions.model_fields)}"
        lines.append(f"{where}: {message}" if problem["loc"] else message)
    return "parameters: " + "\n  ".join(lines)
