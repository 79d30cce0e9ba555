"""``python -m gyro_pipeline`` is ``kedro run``."""

import sys
from pathlib import Path
from typing import Any

from kedro.framework.cli.utils import find_run_command
from kedro.framework.project import configure_project


def main(*args: Any, **kwargs: Any) -> Any:
    """Run the project's pipelines.

    Args:
        *args: Command line arguments, as a list; by default those of the process.
        **kwargs: Further options of :meth:`click.Command.main`.

    Returns:
        The result of the run in an interactive session; otherwise the process exits with its code.
    """
    package_name = Path(__file__).parent.name
    configure_project(package_name)
    kwargs["standalone_mode"] = not hasattr(sys, "ps1")
    return find_run_command(package_name)(*args, **kwargs)


if __name__ == "__main__":
    main()
