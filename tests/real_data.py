"""Where the real data are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

FOLDER = Path(os.environ.get("SUBMIN_DATA", Path(__file__).parents[2] / "shared" / "data"))


def real_data(*, whole_module: bool = False) -> Path:
    """Folder of the real data; without it the test, or the whole module, is skipped visibly, and in CI it fails."""
    if not FOLDER.is_dir():
        message = f"real data not found in {FOLDER}: set SUBMIN_DATA to their folder"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message, allow_module_level=whole_module)
    return FOLDER
