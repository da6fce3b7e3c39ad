"""The product's own commands as processes of their own: what they print as JSON, and what their processes took."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
_COMMAND = "from orchestration.cli import main; main()"
_ENVIRONMENT = {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def submin_json(*words: object, cores: Sequence[int] | None = None) -> Mapping[str, Any]:
    """What a command of ``submin`` prints with ``--json``; a process of its own, so that its memory is its own.

    ``cores`` are places among those of this process, the only ones that it and its workers may use then (Linux only).

    Raises
    ------
    RuntimeError
        With what it said, when it ends with an error; exit code 1 is an answer.
    """
    bound = []
    if cores is not None:
        there = sorted(os.sched_getaffinity(0))
        bound = ["taskset", "--cpu-list", ",".join(str(there[place]) for place in cores)]
    done = subprocess.run(
        [*bound, sys.executable, "-c", _COMMAND, *map(str, words), "--json"], capture_output=True, text=True, env=os.environ | _ENVIRONMENT,
        check=False,
    )  # fmt: skip
    if done.returncode not in (0, 1):
        raise RuntimeError(f"submin {' '.join(map(str, words))}: exit code {done.returncode}: {done.stderr.strip()[-2000:]}")
    answer: Mapping[str, Any] = json.loads(done.stdout)
    return answer
