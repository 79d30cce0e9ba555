"""How a command of Kedro starts here: parameters are checked, and one run works at a time.

Every ``kedro`` command imports this file, so it imports what is large only where it is used.
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
"""Options that name nodes: these are run, whether they are up to date or not."""

OWN_SETTINGS = "own_settings"
"""Name of a resolver for the catalog: a folder named after the settings of a command, if any."""

_CHANGE_NO_RESULT = ("execution", "logs", "reader")
_LONGEST_NAME = 80


def settings_in_words(given: Mapping[str, Any], prefix: str = "") -> str:
    """Name the settings that a command gave with ``--params``, such as ``only.sensor=dot``.

    A run with settings of its own, narrowed or with other parameters, has a report of its own, and
    never replaces that of the full study.

    Args:
        given: Parameters; those of execution and of where logs are read change no result.
        prefix: Of the keys.

    Returns:
        A name for a folder; empty where there are none.
    """
    words = []
    for key, value in sorted(given.items()):
        if isinstance(value, Mapping):
            words.append(settings_in_words(value, f"{prefix}{key}."))
        else:
            words.append(re.sub(r"[^\w.=+-]+", "-", f"{prefix}{key}={value}").strip("-"))
    if prefix:
        return ",".join(words)
    kept = [word for word in words if word and not word.startswith(_CHANGE_NO_RESULT)]
    name = ",".join(kept)
    if len(name) <= _LONGEST_NAME:
        return name
    return f"{name[:_LONGEST_NAME]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def checked(given: Mapping[str, Any]) -> "Parameters":
    """The parameters of a configuration.

    Raises:
        InputError: One is unknown, lacking or out of bounds.
    """
    from pydantic import ValidationError  # noqa: PLC0415

    from gyro_pipeline.parameters import Parameters  # noqa: PLC0415

    try:
        return Parameters(**given)
    except ValidationError as error:
        raise InputError(_explained(error)) from None


class Context(KedroContext):
    """A context whose parameters are checked, and from which the pipelines are built.

    Kedro builds pipelines after the context, for every command that has an environment, such as
    ``kedro run`` and ``kedro viz``.

    Attributes:
        given: Parameters as the configuration has them.
        parameters: All of them, checked.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        from omegaconf import OmegaConf  # noqa: PLC0415

        boundary.install(Path(self.project_path))
        self.given = self.config_loader["parameters"]
        self.parameters = checked(self.given)
        pipeline_registry.select(self.parameters)
        name = settings_in_words(self.config_loader.runtime_params or {})
        OmegaConf.register_new_resolver(OWN_SETTINGS, lambda: name and f"/{name}", replace=True)


class Session(KedroSession):
    """A session that runs what changed, alone in its project, and from wherever it was started."""

    def run(self, *arguments: Any, **options: Any) -> dict[str, Any]:
        """Run pipelines, as :meth:`kedro.framework.session.KedroSession.run` does.

        Raises:
            InputError: The runner or an option is of no use here.
        """
        from kedro.runner import ParallelRunner, SequentialRunner  # noqa: PLC0415

        runner = options.get("runner")
        if options.get("only_missing_outputs"):
            raise InputError(
                "--only-missing-outputs: a run store is there or not, whatever it lacks; type "
                "kedro run without it, which makes the runs that are not FINISHED, and no others"
            )
        if isinstance(runner, ParallelRunner):
            raise InputError(
                "--runner=ParallelRunner: each node shares out its own work; type kedro run "
                "without it, and --params=execution.workers=N for N processes"
            )
        if getattr(runner, "_is_async", False):
            raise InputError(
                "--async: results are saved one by one as they are made, which Kedro cannot do in "
                "the background; type kedro run without it"
            )
        project = self._project_path
        boundary.install(project)
        run_lock.check_folder(project)
        every_node = not any(map(options.get, _NAMES_NODES))
        interrupts = run_lock.Interrupts()
        self._hook_manager.register(interrupts)
        with self._in_project(), run_lock.only_run(project / "data" / "run.lock"):
            if type(runner) in (SequentialRunner, NoneType) and every_node:
                from gyro_pipeline.runner import ChangedNodesRunner  # noqa: PLC0415

                options["runner"] = ChangedNodesRunner(project / "data" / "ended_nodes.json")
            try:
                with interrupts.heard():
                    return super().run(*arguments, **options)
            except KeyboardInterrupt:
                logger.error(
                    "interrupted: what is finished is stored, and the same command goes on"
                )
                raise
            finally:
                self._hook_manager.unregister(interrupts)

    @contextmanager
    def _in_project(self) -> Iterator[None]:
        """Paths and log settings are those of the project, wherever the command was typed."""
        if Path.cwd() != self._project_path and "KEDRO_LOGGING_CONFIG" not in os.environ:
            import yaml  # noqa: PLC0415
            from kedro.framework.project import configure_logging  # noqa: PLC0415

            settings = self._project_path / "conf" / "logging.yml"
            configure_logging(yaml.safe_load(settings.read_text(encoding="utf-8")))
        with chdir(self._project_path):
            yield


def _explained(error: "ValidationError") -> str:
    from gyro_pipeline.parameters import ReaderOptions  # noqa: PLC0415

    lines = []
    for problem in error.errors():
        where = ".".join(str(part) for part in problem["loc"]) or "parameters"
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "extra_forbidden":
            message = "unknown key; see conf/base for the keys there are"
            if problem["loc"][0] == "reader":
                message = f"unknown key; there are {', '.join(ReaderOptions.model_fields)}"
        lines.append(f"{where}: {message}" if problem["loc"] else message)
    return "parameters: " + "\n  ".join(lines)
