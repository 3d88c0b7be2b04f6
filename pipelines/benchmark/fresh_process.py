"""Work in a process of its own, so that nothing of one measurement is warm in the next."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from colmap_vg.errors import ColmapVgError

PIPELINES = Path(__file__).resolve().parents[1]


def result_of(module: str, arguments: Sequence[str], told: str) -> dict[str, Any]:
    """Run a module with arguments and the path of a JSON file that it writes; what it wrote.

    Parameters
    ----------
    module : str
        In `pipelines`, as imported.
    arguments : sequence of str
    told : str
        What is run, for the error.

    Raises
    ------
    ColmapVgError
        It wrote nothing.
    """
    path = os.pathsep.join(filter(None, [str(PIPELINES), os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory() as name:
        result = Path(name) / "run.json"
        command = [sys.executable, "-m", module, *arguments, str(result)]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path}
        )
        if not result.is_file():
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise ColmapVgError(f"{told} ended with code {done.returncode}: {last}")
        fields: dict[str, Any] = json.loads(result.read_text())
    return {**fields, "stages": tuple(tuple(stage) for stage in fields["stages"])}
