"""The commands that help and documentation name are there."""

import re
import subprocess
from pathlib import Path

import pytest

from gyro_pipeline.pipeline_registry import register_pipelines

PROJECT = Path(__file__).parents[1]
# names that a text leaves to its reader
PLACEHOLDERS = {"NAME", "mine", "my_study"}


def make_help():
    return subprocess.run(
        ["make", "--silent", "help"], cwd=PROJECT, capture_output=True, text=True, check=True
    ).stdout


def texts():
    pages = [PROJECT / "README.md", PROJECT / "CONTRIBUTING.md", *(PROJECT / "docs").glob("*.md")]
    return {page.name: page.read_text() for page in pages} | {"make help": make_help()}


@pytest.mark.parametrize("page", texts())
def test_pipelines_environments_and_targets_that_a_page_names_are_there(page, monkeypatch):
    monkeypatch.chdir(PROJECT)
    text = texts()[page]
    targets = set(re.findall(r"^([a-z-]+):", (PROJECT / "Makefile").read_text(), re.M))
    environments = {path.name for path in (PROJECT / "conf").iterdir()}
    named = {
        "pipelines": (r"--pipelines?[= ](\w+)", register_pipelines().keys()),
        "environments": (r"--env[= ](\w+)", environments),
        "targets": (r"(?:^|`|\$ )make ([a-z-]+)", targets),
    }
    lacking = {
        kind: set(re.findall(pattern, text, re.M)) - set(there) - PLACEHOLDERS
        for kind, (pattern, there) in named.items()
    }
    assert not any(lacking.values()), lacking


def test_make_help_names_every_pipeline_and_target(monkeypatch):
    monkeypatch.chdir(PROJECT / "notebooks")  # the registry works from a subfolder as well
    text = make_help()
    assert [
        name for name in register_pipelines() if name != "__default__" and name not in text
    ] == []
