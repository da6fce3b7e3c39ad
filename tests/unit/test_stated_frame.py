"""A table of points says of which frame and epoch it is; a network takes no other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from submin.errors import CatalogueError
from submin.storage.catalogue_schema import PointTable
from submin.storage.point_table import check_stated_frame, write_point_table


def stating(tmp_path: Path, frame: str, epoch: str) -> Path:
    path = tmp_path / "control.parquet"
    points = PointTable(np.array(["A"]), np.array([[10.0, 50.0, 100.0]]), np.eye(3)[None], np.array([""]))
    write_point_table(path, points, {"frame": frame, "epoch": epoch})
    return path


@pytest.mark.parametrize(
    ("frame", "epoch", "words"),
    [
        ("ITRF2008", "2020-01-01", "frame is 'ITRF2008', but the network's is 'GDA2020'; transform the points"),
        ("GDA2020", "2020-06-04", "epoch is '2020-06-04', but the network's is '2020-01-01'; transform the points"),
    ],
)
def test_another_frame_or_epoch_is_refused(tmp_path: Path, frame: str, epoch: str, words: str) -> None:
    with pytest.raises(CatalogueError, match=words):
        check_stated_frame(stating(tmp_path, frame, epoch), "GDA2020", "2020-01-01")


@pytest.mark.parametrize(("frame", "epoch"), [("GDA2020", "2020-01-01"), ("GDA2020", "2020-01-01T12:00:00"), ("", ""), ("GDA2020", "")])
def test_its_own_or_none_is_taken(tmp_path: Path, frame: str, epoch: str) -> None:
    check_stated_frame(stating(tmp_path, frame, epoch), "GDA2020", "2020-01-01")


def test_other_files_state_nothing(tmp_path: Path) -> None:
    check_stated_frame(tmp_path / "control.csv", "GDA2020", "2020-01-01")
