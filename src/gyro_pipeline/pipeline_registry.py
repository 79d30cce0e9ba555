"""The pipelines by name.

Every ``kedro`` command imports this file, so large packages are imported where they are used.
"""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kedro.pipeline import Pipeline

    from gyro_pipeline.parameters import Parameters

_selected: "Parameters | None" = None


def select(parameters: "Parameters") -> None:
    """Register the pipelines for the studies, sensors and ``only`` of parameters.

    The context of a run calls this before Kedro builds the pipelines.
    """
    global _selected  # noqa: PLW0603 - Kedro calls register_pipelines without arguments
    _selected = parameters


def register_pipelines() -> dict[str, "Pipeline"]:
    """All pipelines; those of ``conf/base`` for commands without a context."""
    from gyro_pipeline.pipelines.assembly import assemble  # noqa: PLC0415

    return assemble(_selected or base_parameters())


def base_parameters() -> "Parameters":
    """Parameters of ``conf/base``."""
    from kedro.config import OmegaConfigLoader  # noqa: PLC0415
    from kedro.framework.project import settings  # noqa: PLC0415
    from kedro.utils import find_kedro_project  # noqa: PLC0415

    from gyro_pipeline.parameters import Parameters  # noqa: PLC0415

    project = find_kedro_project(Path.cwd())
    conf = OmegaConfigLoader(str(project / settings.CONF_SOURCE), **settings.CONFIG_LOADER_ARGS)
    return Parameters(**conf["parameters"])
