"""A catalogue is written whole or not at all, and over nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from catalogues import IMAGES, block

from submin.errors import CatalogueError
from submin.storage.catalogue import Catalogue, CatalogueMetadata
from submin.storage.catalogue_writer import CatalogueWriter


class TestWriter:
    def test_a_failure_leaves_nothing(self, tmp_path: Path) -> None:
        with pytest.raises(RuntimeError, match="on purpose"), CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")) as writer:
            writer.write_images(IMAGES)
            raise RuntimeError("on purpose")
        assert list(tmp_path.iterdir()) == []

    def test_what_is_there_is_not_written_over(self, folder: Path) -> None:
        with pytest.raises(CatalogueError, match="is not empty"):
            CatalogueWriter(folder, CatalogueMetadata("n"))

    def test_overwrite_replaces_a_catalogue_or_leaves_it(self, folder: Path) -> None:
        with pytest.raises(RuntimeError), CatalogueWriter(folder, CatalogueMetadata("n"), overwrite=True):
            raise RuntimeError
        assert Catalogue.open(folder).validate().rays == 10
        with CatalogueWriter(folder, CatalogueMetadata("n"), overwrite=True) as writer:
            writer.write_images([IMAGES[2]])
            writer.write_block(block("B"))
        assert Catalogue.open(folder).block_ids == ("B",)
        assert not (folder / "control.parquet").exists()
        assert [p.name for p in folder.parent.iterdir()] == ["catalogue"]

    def test_only_a_catalogue_is_overwritten(self, tmp_path: Path) -> None:
        (tmp_path / "letters.txt").write_text("dear")
        with pytest.raises(CatalogueError, match="holds other things than a catalogue"):
            CatalogueWriter(tmp_path, CatalogueMetadata("n"), overwrite=True)

    def test_an_empty_folder_is_used(self, tmp_path: Path) -> None:
        (tmp_path / "c").mkdir()
        with CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")) as writer:
            writer.write_images(IMAGES)
        assert len(Catalogue.open(tmp_path / "c").images) == 3

    def test_a_block_is_written_once(self, tmp_path: Path) -> None:
        with (
            pytest.raises(CatalogueError, match="block 'A' is written twice"),
            CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")) as writer,
        ):
            writer.write_block(block("A"))
            writer.write_block(block("A"))

    def test_writing_needs_an_open_writer(self, tmp_path: Path) -> None:
        with pytest.raises(CatalogueError, match="not open"):
            CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")).write_block(block("A"))
