"""Bytes that spill to a file are read as they were written."""

from __future__ import annotations

import os

import pytest

from submin.errors import StoreError
from submin.storage import spilled
from submin.storage.spilled import Spilled

PIECES = [bytes([k]) * (k % 9) for k in range(200)]


@pytest.mark.parametrize("most", [0, 100, 1 << 20])
def test_what_was_written_is_read(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spilled, "MOST_IN_MEMORY", most)
    kept, whole = Spilled("cameras"), b"".join(PIECES)
    for piece in PIECES:
        kept.append(piece)
    assert kept.read(0, len(whole)) == whole
    assert [kept.read(k, k + 7) for k in range(0, len(whole) - 7, 13)] == [whole[k : k + 7] for k in range(0, len(whole) - 7, 13)]
    assert kept.read(5, 5) == b""
    kept.close()


def test_a_file_that_was_cut_short_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spilled, "MOST_IN_MEMORY", 0)
    kept = Spilled("cameras")
    kept.append(b"camera")
    assert kept._file is not None
    os.ftruncate(kept._file.fileno(), 3)
    with pytest.raises(StoreError, match="is shorter now; give the command again"):
        kept.read(0, 6)
    kept.close()
