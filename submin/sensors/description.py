"""Descriptions of cameras: JSON text as it stands in a catalogue, and what it says."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

KEPT = 1024
SHORT = 1 << 14
"""Characters up to which what a text says is kept: ephemerides and attitudes of line scanners are longer, and would fill the memory."""


def camera_values(text: str) -> Any:
    """What the JSON text of a camera says; of the latest short ones the same object each time, which nobody may change.

    Raises
    ------
    json.JSONDecodeError
        When it is not JSON.
    """
    return _kept(text) if len(text) <= SHORT else json.loads(text)


@lru_cache(maxsize=KEPT)
def _kept(text: str) -> Any:
    return json.loads(text)
