"""A network written under one Python opens under another, which goes on with it, and the other way round."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OTHER = ROOT / ".venv-other" / "bin" / "python"
"""Interpreter of the second environment, made by ``make other-environment``."""


@pytest.fixture(scope="module")
def other() -> str:
    if not OTHER.exists():
        pytest.skip("no second Python: 'make other-environment OTHER_PYTHON=python3.13' makes its environment")
    return str(OTHER)


def side(python: str, step: str, folder: Path) -> None:
    """One step of the exchange in a process of its own."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    script = str(Path(__file__).with_name("interchange.py"))
    done = subprocess.run([python, script, step, str(folder)], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_other_python_is_another(other: str) -> None:
    shown = subprocess.run([other, "-c", "import sys; print(sys.version_info[:2])"], capture_output=True, text=True, check=True).stdout
    assert shown.strip() != str(sys.version_info[:2])


@pytest.mark.parametrize("begins", ["this", "other"])
def test_a_network_goes_from_python_to_python(other: str, begins: str, tmp_path: Path) -> None:
    first, second = (sys.executable, other) if begins == "this" else (other, sys.executable)
    side(first, "write", tmp_path)
    side(second, "read", tmp_path)
    side(second, "continue", tmp_path)
    side(first, "read", tmp_path)
