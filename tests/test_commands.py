"""The commands that help and documentation name are there, and links lead somewhere."""

import re
import subprocess
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from gyro_pipeline.pipeline_registry import register_pipelines

PROJECT = Path(__file__).parents[1]
# names that a text leaves to its reader
PLACEHOLDERS = {"NAME", "mine", "my_study"}
FILES = [*sorted(PROJECT.glob("*.md")), PROJECT / "benchmarks" / "README.md"]  # MkDocs: docs/


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


def links(path):
    for block in MarkdownIt().enable("table").parse(path.read_text()):
        for token in block.children or ():
            if target := token.attrGet("href") or token.attrGet("src"):
                yield target


def anchors(path):
    headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-") for text in headings}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PROJECT)))
def test_relative_links_lead_to_a_file_and_a_heading(path):
    for target in links(path):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        page = (path.parent / name) if name else path
        assert page.exists(), target
        assert not anchor or anchor in anchors(page), target
