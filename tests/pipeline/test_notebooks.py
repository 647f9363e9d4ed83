"""The notebooks of docs/examples run from first to last cell, and are stored without outputs."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[2] / "docs/examples").glob("*.ipynb"))
#: Cells share one namespace, as in Jupyter; the last figure must show something.
RUN = """
import json, sys
names = {"__name__": "__main__"}
for cell in json.load(open(sys.argv[1], encoding="utf-8"))["cells"]:
    if cell["cell_type"] == "code":
        exec("".join(cell["source"]), names)
import matplotlib.pyplot as plt
assert [axis for axis in plt.gcf().axes if axis.has_data()]
print("chain" in names and len(names["chain"]._repr_html_()))
"""


def test_the_notebooks_have_no_outputs():
    assert len(EXAMPLES) == 2
    for path in EXAMPLES:
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            assert not cell.get("outputs"), f"{path}: clear the outputs"


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_notebook(path, tmp_path):
    environment = os.environ | {"NSF_RUNS": str(tmp_path / "runs"), "MPLBACKEND": "Agg"}
    ran = subprocess.run(
        [sys.executable, "-c", RUN, str(path)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert not ran.returncode, ran.stdout + ran.stderr
    assert "evaluate: mean δ" in ran.stdout
