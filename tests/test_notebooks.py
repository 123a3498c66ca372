"""The notebooks of the documentation run from beginning to end, and display what they should."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("nbformat", reason='needs pip install -e ".[notebook]"')
pytest.importorskip("nbclient", reason='needs pip install -e ".[notebook]"')
pytest.importorskip("ipykernel", reason='needs pip install -e ".[notebook]"')

import nbformat

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
BAR = re.compile(r'<progress max="([0-9.]+)" value="([0-9.]+)"')
NEEDED = {"data_to_parameters": ("sbi",), "search": ("cma",)}


EXECUTE = """
import sys
import nbclient, nbformat
notebook = nbformat.read(sys.argv[1], as_version=4)
client = nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3")
client.execute()
nbformat.write(notebook, sys.argv[2])
"""


def run(path: Path, folder: Path) -> list[dict]:
    """Execute a notebook in a folder, by a process of its own; all its outputs."""
    done = subprocess.run(
        [sys.executable, "-c", EXECUTE, str(path), "done.ipynb"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    cells = nbformat.read(folder / "done.ipynb", as_version=4).cells
    return [o for cell in cells if cell.cell_type == "code" for o in cell.outputs]


def test_there_are_three():
    assert [path.stem for path in NOTEBOOKS] == ["colony", "data_to_parameters", "search"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_outputs_are_stored(path):
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            assert not cell.outputs and cell.execution_count is None


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path):
    for module in NEEDED.get(path.stem, ()):
        pytest.importorskip(module)
    outputs = run(path, tmp_path)
    assert [o for o in outputs if o.output_type == "error"] == []
    kinds = [kind for o in outputs if "data" in o for kind in o.data]
    assert kinds.count("image/png") >= 2 and kinds.count("text/html") >= 2
    said = "".join(o.text for o in outputs if o.get("name") == "stderr")
    assert "Warning" not in said and "IProgress" not in said
    shown = [o.data.get("text/html", "") for o in outputs if "data" in o]
    bars = [BAR.search(html) for html in shown if "<progress" in html]
    # a search of two replicates may leave one colony of its budget
    assert bars and all(float(b[2]) > 0.9 * float(b[1]) for b in bars)
    assert not any(" object at 0x" in o.data.get("text/plain", "") for o in outputs if "data" in o)
