"""A catalogue: what is written is read, whatever the format."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from catalogues import FOOTPRINT, IMAGES, as_csv, block, put, put_one, rewrite, same_rays

from submin.adjustment.priors import APriori
from submin.errors import CatalogueError, InputError
from submin.formats import columns as reading
from submin.storage.catalogue import Catalogue, CatalogueMetadata, defects
from submin.storage.catalogue_schema import parse_utc


class TestRoundTrip:
    def test_all_that_is_written_is_read(self, folder: Path) -> None:
        catalogue = Catalogue.open(folder)
        assert catalogue.metadata == CatalogueMetadata("test", epoch="2020.0")
        assert tuple(catalogue.images) == IMAGES
        assert catalogue.block_ids == ("A", "B")
        assert catalogue.block_count == 2
        assert catalogue.a_priori("A") == APriori(bias_px=5.0)
        assert catalogue.a_priori("B") == APriori(drift_px=0.1)
        read = list(catalogue.blocks())
        assert [b.block_id for b in read] == ["A", "B"]
        assert same_rays(read[0], block("A")) and same_rays(read[1], block("B", 2))
        assert read[0].images == IMAGES[:2]
        assert read[0].a_priori == APriori(bias_px=5.0)
        summary = catalogue.validate()
        assert (summary.blocks, summary.images, summary.rays) == (2, 3, 10)

    @pytest.mark.parametrize("compressed", [False, True])
    def test_csv_holds_the_same(self, folder: Path, compressed: bool) -> None:
        parquet = Catalogue.open(folder)
        expected, control = list(parquet.blocks()), parquet.points("control")
        as_csv(folder, compressed)
        catalogue = Catalogue.open(folder)
        assert tuple(catalogue.images) == IMAGES
        assert all(same_rays(a, b) for a, b in zip(catalogue.blocks(), expected, strict=True))
        assert [b.content_hash() for b in catalogue.blocks()] == [b.content_hash() for b in expected]
        found = catalogue.points("control")
        assert control is not None and found is not None
        np.testing.assert_array_equal(found.covariance_enu, control.covariance_enu)
        assert catalogue.validate().rays == 10

    def test_ids_that_look_like_numbers_stay_texts(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: put(t, "point_id", [f"00{k}" for k in range(t.num_rows)]))
        as_csv(folder, False)
        assert next(Catalogue.open(folder).blocks()).point_ids[:2].tolist() == ["000", "001"]

    def test_batches_do_not_show(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        expected = list(Catalogue.open(folder).blocks())
        monkeypatch.setattr(reading, "BATCH_ROWS", 3)
        assert all(same_rays(a, b) for a, b in zip(Catalogue.open(folder).blocks(), expected, strict=True))

    def test_blocks_can_be_skipped_or_taken_one_at_a_time(self, folder: Path) -> None:
        catalogue = Catalogue.open(folder)
        assert [b.block_id for b in catalogue.blocks(skip={"A"})] == ["B"]
        assert same_rays(catalogue.block("B"), block("B", 2))
        with pytest.raises(CatalogueError, match="no block 'C'; expected one of A, B$"):
            catalogue.block("C")

    def test_a_block_without_measurements_comes_last_and_is_defect(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: t.slice(8))
        read = list(Catalogue.open(folder).blocks())
        assert [b.block_id for b in read] == ["B", "A"]
        assert str(defects(read[1])).startswith("the block has no measurements")
        assert len(Catalogue.open(folder).block("A")) == 0

    def test_sigmas_default_to_half_a_pixel(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: put_one(t, "sigma_sample", 1, None).drop_columns(["sigma_line"]))
        read = next(Catalogue.open(folder).blocks())
        assert (read.sigma_line == 0.5).all()
        assert read.sigma_sample[0] == 0.5

    def test_footprints_are_geoparquet(self, folder: Path) -> None:
        schema = pq.read_schema(folder / "images.parquet")
        geo = json.loads(schema.metadata[b"geo"])
        assert geo["columns"][geo["primary_column"]]["encoding"] == "WKB"
        assert pq.read_table(folder / "images.parquet")["geometry"].to_pylist() == [FOOTPRINT, FOOTPRINT, None]

    def test_footprint_as_well_known_text(self, folder: Path) -> None:
        as_csv(folder, False)
        text = (folder / "images.csv").read_text().replace(FOOTPRINT.hex(), shapely.box(10.0, 50.0, 10.1, 50.1).wkt)
        (folder / "images.csv").write_text(text)
        assert shapely.from_wkb(Catalogue.open(folder).images[0].footprint).equals(shapely.from_wkb(FOOTPRINT))

    def test_times_of_images(self) -> None:
        assert IMAGES[1].seconds - IMAGES[0].seconds == 10.5
        assert np.isnan(IMAGES[2].seconds)

    @pytest.mark.parametrize("text", ["2014-10-05", "20141005", "yesterday", "20141305160138"])
    def test_a_text_that_is_no_time_is_refused(self, text: str) -> None:
        with pytest.raises(InputError, match="expected 20141005160138 or ISO 8601"):
            parse_utc(text)

    def test_priors_of_a_block_start_from_the_default(self, folder: Path) -> None:
        (folder / "priors.json").write_text('{"default": {"bias_px": 3}, "blocks": {"A": {"drift_px": 2}}}')
        assert Catalogue.open(folder).a_priori("A") == APriori(bias_px=3.0, drift_px=2.0)
        (folder / "priors.json").unlink()
        assert Catalogue.open(folder).a_priori("A") == APriori()

    def test_entries_by_parameter_of_a_block_stand_beside_those_of_the_default(self, folder: Path) -> None:
        entries = {"default": {"parameters": {"rate": {"sigma": 1}}}, "blocks": {"A": {"parameters": {"position": {"sigma": 2}}}}}
        (folder / "priors.json").write_text(json.dumps(entries))
        assert Catalogue.open(folder).a_priori("A").parameters == {"rate": {"sigma": 1}, "position": {"sigma": 2}}


def test_the_documented_priors_are_read_as_they_stand(folder: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "catalogue.md").read_text(encoding="utf-8")
    values = json.loads(text.split("```json")[1].split("```")[0])
    values["blocks"] = {"A": values["blocks"]["block 1"]}
    (folder / "priors.json").write_text(json.dumps(values))
    catalogue = Catalogue.open(folder)
    assert catalogue.default_prior == APriori()
    assert catalogue.a_priori("A").parameters["attitude kappa"] == {"sigma": 1e-4, "common_to_pass": 0.5}
