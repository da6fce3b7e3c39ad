"""A file is written whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from submin.errors import InputError
from submin.formats.replacing import replacing


def test_a_file_takes_the_place_of_another_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "f.txt"
    path.write_text("before")
    with replacing(path) as temporary:
        temporary.write_text("after")
        assert path.read_text() == "before"
    assert path.read_text() == "after"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("error", "raised"), [(OSError(28, "No space left on device"), InputError), (KeyError("mine"), KeyError)])
def test_a_failure_leaves_what_was_there(tmp_path: Path, error: Exception, raised: type[Exception]) -> None:
    path = tmp_path / "f.txt"
    path.write_text("before")
    with pytest.raises(raised), replacing(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_places_where_no_file_can_be(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder; expected the name of a file to write"), replacing(tmp_path):
        pass
    with pytest.raises(InputError, match="does not exist; create it first"), replacing(tmp_path / "nowhere" / "f.txt"):
        pass
