"""The commands that help and documentation name are there."""

import re
import subprocess
from pathlib import Path

from gyro_pipeline.pipeline_registry import register_pipelines

PROJECT = Path(__file__).parents[1]
# names that a text leaves to its reader
PLACEHOLDERS = {"NAME", "mine", "my_study"}


def test_pipelines_environments_and_targets_that_a_text_names_are_there(monkeypatch):
    monkeypatch.chdir(PROJECT / "notebooks")  # the registry works from a subfolder as well
    make = ["make", "--silent", "-C", "..", "help"]
    told = subprocess.run(make, capture_output=True, text=True, check=True).stdout
    pages = [PROJECT / "README.md", PROJECT / "CONTRIBUTING.md", *(PROJECT / "docs").glob("*.md")]
    targets = set(re.findall(r"^([a-z-]+):", (PROJECT / "Makefile").read_text(), re.M))
    environments = {path.name for path in (PROJECT / "conf").iterdir()}
    pipelines = set(register_pipelines())
    for page, text in [(page.name, page.read_text()) for page in pages] + [("make help", told)]:
        for pattern, there in (
            (r"--pipelines?[= ](\w+)", pipelines),
            (r"--env[= ](\w+)", environments),
            (r"(?:^|`|\$ )make ([a-z-]+)", targets),
        ):
            assert set(re.findall(pattern, text, re.M)) - there <= PLACEHOLDERS, page
    assert [name for name in pipelines - {"__default__"} if name not in told] == []
