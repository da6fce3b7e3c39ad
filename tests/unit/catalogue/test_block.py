"""A block of a catalogue: what makes it another one, and what is wrong inside it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from catalogues import IMAGES, as_csv, block, camera, image, put_one, rewrite

from submin.adjustment.priors import APriori
from submin.storage.catalogue import Block, Catalogue, defects


class TestContentHash:
    def test_order_and_layout_leave_no_trace(self) -> None:
        first = block("A")
        order = np.random.default_rng(1).permutation(len(first))
        images = tuple(replace(i, camera=json.dumps(json.loads(i.camera), indent=2, sort_keys=True)) for i in first.images[::-1])
        second = Block(
            "A", images, first.a_priori, first.point_ids[order], (1 - first.image[order]).astype(np.int32),
            first.sample[order], first.line[order], first.sigma_sample[order], first.sigma_line[order],
        )  # fmt: skip
        assert first.content_hash() == second.content_hash()
        assert len(first.content_hash()) == 64

    def test_footprint_and_licence_do_not_count(self) -> None:
        first = block("A")
        images = tuple(replace(i, footprint=b"", licence="other") for i in first.images)
        assert replace(first, images=images).content_hash() == first.content_hash()

    @pytest.mark.parametrize(
        "change",
        [
            lambda b: replace(b, sample=b.sample + np.eye(1, len(b), 3)[0] * 1e-9),
            lambda b: replace(b, sigma_line=b.sigma_line * 2.0),
            lambda b: replace(b, image=b.image[::-1].copy()),
            lambda b: replace(b, point_ids=np.char.add(b.point_ids, "x")),
            lambda b: replace(b, a_priori=APriori(bias_px=9.0)),
            lambda b: replace(b, images=(replace(b.images[0], image_id="a0"), b.images[1])),
            lambda b: replace(b, images=(replace(b.images[0], pass_id="other"), b.images[1])),
            lambda b: replace(b, images=(replace(b.images[0], width=999), b.images[1])),
            lambda b: replace(b, images=(replace(b.images[0], acquired=""), b.images[1])),
            lambda b: replace(b, images=(replace(b.images[0], camera=json.dumps(camera(LINE_OFF=500.1))), b.images[1])),
        ],
    )
    def test_what_an_adjustment_depends_on_counts(self, change: Any) -> None:
        assert change(block("A")).content_hash() != block("A").content_hash()


def with_value(name: str, row: int, value: Any) -> Block:
    b = block("A")
    values = getattr(b, name).copy()
    values[row] = value
    return replace(b, **{name: values})


class TestDefects:
    def test_a_good_block_has_none(self) -> None:
        assert defects(block("A")) is None

    @pytest.mark.parametrize(
        ("bad", "reason"),
        [
            (with_value("sample", 3, np.nan), "point D/p1 in image a2: sample is nan; expected a finite number of pixels"),
            (with_value("line", 2, np.inf), "point D/p1 in image a1: line is inf; expected a finite number of pixels"),
            (with_value("sigma_sample", 0, 0.0), "point D/p0 in image a1: sigma_sample is 0.0; expected a positive number of pixels"),
            (with_value("sigma_line", 7, -0.5), "point D/p3 in image a2: sigma_line is -0.5; expected a positive number of pixels"),
            (with_value("sigma_line", 7, np.nan), "point D/p3 in image a2: sigma_line is nan; expected a finite number of pixels"),
            (
                with_value("point_ids", 5, "D/p0"),
                "point D/p0 in image a2 is measured twice, the second time at sample 21.25, line 42.5; expected one ray",
            ),
            (
                replace(block("A"), images=(*IMAGES[:2], image("a3", "A"))),
                "image a3 has no measurements; expected some in every image of the block",
            ),
            (block("A", 0), "the block has no measurements; measure it, or remove its images"),
            (block("B", 2), "the block has 2 rays; expected at least 3: measure more, or join it to another block"),
            (
                block("B", a_priori=APriori(correlation="gaussian", correlation_parameter=60.0)),
                "image b1 has no time; the gaussian correlation of the priors needs column 'acquired'",
            ),
        ],
    )
    def test_each_is_named(self, bad: Block, reason: str) -> None:
        assert defects(bad) == reason

    def test_nan_survives_parquet_and_csv(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: put_one(t, "sample", 4, float("nan")))
        assert "sample is nan" in str(defects(next(Catalogue.open(folder).blocks())))
        as_csv(folder, False)
        catalogue = Catalogue.open(folder)
        catalogue.validate()  # no structural error: it rejects its block only
        assert "point D/p1 in image a2: sample is nan" in str(defects(next(catalogue.blocks())))
