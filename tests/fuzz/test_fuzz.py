"""Damaged databases and odd graphs end in a model or a `ColmapVgError`, whatever is wrong with them.

``COLMAP_VG_NUM_FUZZ`` sets the number of cases of each kind; the default keeps the suite short.
"""

import os
import selectors
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

NUM_CASES = int(os.environ.get("COLMAP_VG_NUM_FUZZ", "25"))
FIRST_SEED = int(os.environ.get("COLMAP_VG_FIRST_FUZZ", "0"))
MAX_SECONDS = 60.0
"""Of one case, on a busy machine."""


def outcomes(kind: str, folder: Path) -> dict[int, str]:
    """Outcome of each case; a process that a case takes along is started again after it."""
    found: dict[int, str] = {}
    seed, last = FIRST_SEED, FIRST_SEED + NUM_CASES
    while seed < last:
        command = [sys.executable, str(Path(__file__).with_name("worker.py")), kind, str(seed), str(last), str(folder)]
        with (folder / "errors.txt").open("w+") as errors:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors)
            reason = _follow(process, found)
            process.kill()
            process.communicate()
            errors.seek(0)
            said = " ".join(errors.read().split())
        open_seeds = [k for k in range(seed, last) if k not in found]
        if not open_seeds:
            break
        found[open_seeds[0]] = f"FAULT {reason} (code {process.returncode}): {said[:300]}"
        seed = open_seeds[0] + 1
    return found


def _follow(process: "subprocess.Popen[bytes]", found: dict[int, str]) -> str:
    """Take down what the process tells, until it ends or a case takes too long; why it ended."""
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        rest = b""
        while True:
            if not selector.select(MAX_SECONDS):
                return "the case takes too long"
            content = os.read(process.stdout.fileno(), 65536)
            if not content:
                process.wait()
                return "the process ended"
            *lines, rest = (rest + content).split(b"\n")
            for line in lines:
                word, _, told = line.decode(errors="replace").partition(" ")
                if word == "end":
                    seed, _, outcome = told.partition(" ")
                    found[int(seed)] = outcome


@pytest.mark.parametrize("kind", ["graph", "database"])
def test_the_end_is_a_model_or_an_error_of_ours(kind: str, tmp_path: Path) -> None:
    found = outcomes(kind, tmp_path)
    if report := os.environ.get("COLMAP_VG_FUZZ_REPORT"):
        lines = [f"{seed} {outcome}" for seed, outcome in sorted(found.items())]
        Path(f"{report}.{kind}").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert len(found) == NUM_CASES
    faults = {seed: outcome for seed, outcome in found.items() if outcome.startswith("FAULT")}
    assert not faults, f"{len(faults)} of {NUM_CASES}: {dict(list(faults.items())[:5])}"
    solved = sum("models" in outcome or outcome.startswith(("solved", "partial")) for outcome in found.values())
    assert 0.1 * NUM_CASES < solved < 0.95 * NUM_CASES, "the cases are neither all hopeless nor all harmless"
