"""The code in the documentation runs: a page's Python blocks, in order, as one program in an empty
folder; one that begins with a file's name, as that."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import design
import torchfilm

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FILE = re.compile(r"# (\w+\.py)\n")
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def test_there_are_pages_with_code():
    assert sum(bool(BLOCK.search(page.read_text())) for page in PAGES) >= 6


@pytest.mark.parametrize(
    "page", [p for p in PAGES if BLOCK.search(p.read_text())], ids=lambda p: p.name
)
def test_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "docs"}
    for number, code in enumerate(BLOCK.findall(page.read_text())):
        if file := FILE.match(code):
            Path(file[1]).write_text(code)
            subprocess.run([sys.executable, file[1]], check=True)
            continue
        exec(compile(code, f"{page.name}, block {number}", "exec"), names)


def test_the_reference_lists_every_public_name():
    text = (ROOT / "docs" / "reference.md").read_text()
    names = [f"tf.{n}" for n in torchfilm.__all__ if not n.startswith("_")]
    assert [n for n in names if f"`{n}`" not in text] == []
    assert [n for n in design.__all__ if f"`{n}`" not in text] == []


def test_the_site_has_the_docstring_of_every_public_name():
    text = (ROOT / "docs" / "docstrings.md").read_text()
    listed = re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE)
    names = [f"torchfilm.{n}" for n in torchfilm.__all__ if not n.startswith("_")]
    assert sorted(listed) == sorted([*names, *(f"design.{n}" for n in design.__all__)])


def test_the_site_lists_every_page_once():
    text = (ROOT / "mkdocs.yml").read_text()
    listed = re.findall(r": (\S+\.md)$", text, re.MULTILINE)
    assert sorted(listed) == sorted(p.name for p in PAGES if p.parent.name == "docs")


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda page: page.name)
def test_prose_is_at_most_100_columns_wide(page):
    """Apart from tables, pictures, code and what a script wrote between its marks."""
    long, code, written = [], False, False
    for number, line in enumerate(page.read_text().splitlines(), 1):
        code ^= line.startswith("```")
        if line.startswith("<!--"):
            written = "to here" not in line
        if len(line) > 100 and not code and not written and not line.startswith(("|", "![")):
            long.append(number)
    assert long == []


def test_the_readme_and_the_citation_file_ask_for_the_same():
    citation = (ROOT / "CITATION.cff").read_text()
    wish = re.search(r"^message: >-\n  (.*\.)$", citation, re.MULTILINE)
    assert wish and wish[1] in " ".join((ROOT / "README.md").read_text().split())
    assert f"\nversion: {torchfilm.__version__}\n" in citation
