"""`python -m benchmarks correlation`, with descents that stop at once and a small region: every bound is one, and the figure is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import correlation
from benchmarks.comparison import MET
from submin.correlation import FAMILIES


def test_every_row_is_a_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("submin.correlation.compact.STEPS", (5,))
    rows = correlation.measure(0.06, 0, tmp_path)
    judged = [row for row in rows if "verdict" in row]
    assert len(judged) == 1 + 3 * len(FAMILIES) + 3 * len(correlation.FLOORS_KM)
    assert [row for row in judged if row["verdict"] != MET] == []
    assert (tmp_path / "correlation-functions.png").read_bytes().startswith(b"\x89PNG")

    families = {row["family"]: row for row in rows if "kappa, fitted for it" in row}
    alone = families.pop("3 x 3 blocks alone")
    assert alone["kappa, fitted for it"] == pytest.approx(57.2, abs=0.1)  # what all 62 points have in common, lost
    assert alone["non-zeros"] == 6 * 62
    assert all(row["kappa, least squares"] > 9.0 > 7.5 > row["kappa, fitted for it"] for row in families.values())

    like = {row["correlation"]: row for row in rows if "correlation" in row}
    for component in correlation.COMPONENTS:
        row = like.pop(f"{component}-{component}")
        assert row["below 25 km"] > row["to 75 km"] > row["to 150 km"] > row["beyond"] > 0.5
    assert all(abs(row[name]) < 0.02 for row in like.values() for name in ("below 25 km", "to 75 km", "to 150 km", "beyond"))

    zeros = [row for row in rows if "fill" in row]
    assert all(row["non-zeros"] < row["triangle"] and np.isfinite(row["fit, s"]) for row in zeros)
