"""Control points and truth of a catalogue, and what is wrong with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from catalogues import points, put, put_one, rewrite

from submin.errors import CatalogueError
from submin.geodesy import local_axes, rotate_covariance
from submin.storage.catalogue import Catalogue, CatalogueMetadata
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.point_table import read_point_table


class TestPoints:
    def test_control_and_truth(self, folder: Path) -> None:
        catalogue = Catalogue.open(folder)
        control, truth = catalogue.points("control"), catalogue.points("truth")
        assert control is not None and truth is not None and catalogue.points("check") is None
        np.testing.assert_array_equal(control.covariance_enu, points().covariance_enu)
        np.testing.assert_array_equal(control.geodetic, points().geodetic)
        assert control.area.tolist() == ["west"] * 3
        assert len(truth) == 7 and not truth.covariance_enu.any() and truth.area.tolist() == [""] * 7

    def test_sigmas_stand_for_covariances(self, tmp_path: Path) -> None:
        path = tmp_path / "check.csv"
        path.write_text("point_id,longitude,latitude,height,sigma_e,sigma_n,sigma_u\n7,10,50,100,1,2,3\n")
        table = read_point_table(path)
        assert table.point_ids.tolist() == ["7"]
        np.testing.assert_array_equal(table.covariance_enu[0], np.diag([1.0, 4.0, 9.0]))

    def test_joint_covariance_of_correlated_points(self, tmp_path: Path) -> None:
        factor = np.random.default_rng(2).normal(size=(9, 12))
        joint = factor @ factor.T
        table = points()
        own = np.stack([joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(3)])
        table = replace(table, covariance_enu=rotate_covariance(own, local_axes(table.geodetic)), joint_covariance=joint)
        with CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")) as writer:
            writer.write_points("control", table)
        path = tmp_path / "c" / "control.parquet"
        read = read_point_table(path, "definite")
        assert read.joint_covariance is not None
        np.testing.assert_array_equal(read.joint_covariance, joint)
        pq.write_table(pq.read_table(path).drop_columns(["cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu"]), path)
        np.testing.assert_allclose(read_point_table(path).covariance_enu, table.covariance_enu, rtol=1e-12)

    @pytest.mark.parametrize(
        ("kind", "change", "message"),
        [
            ("any", lambda t: put_one(t, "point_id", 3, "c0"), "row 3: point_id 'c0' is that of row 1 too"),
            ("any", lambda t: put_one(t, "latitude", 2, 91.0), "row 2: latitude is 91.0; expected degrees from -90 to 90"),
            ("any", lambda t: put_one(t, "height", 2, None), "row 2: height is None; expected metres"),
            ("any", lambda t: put_one(t, "cov_nn", 2, -1.0), "row 2: covariance is .* expected a matrix without negative eigenvalues"),
            ("any", lambda t: put_one(t, "cov_uu", 2, float("nan")), "row 2: cov_uu is nan; expected a finite number"),
            ("any", lambda t: t.drop_columns(["cov_en"]), "column 'cov_en' is missing"),
            ("any", lambda t: t.select(["point_id", "longitude", "latitude", "height"]), "columns of the covariance are missing"),
            ("any", lambda t: t.drop_columns(["height"]), "column 'height' is missing"),
            (
                "definite",
                lambda t: put(put(put(t, "cov_uu", [0.0] * 3), "cov_eu", [0.0] * 3), "cov_nu", [0.0] * 3),
                "row 1: covariance is .* expected a positive definite matrix",
            ),
            ("any", lambda t: put(t, "covariance_row", [[1.0]] * 3), "covariance_row"),
        ],
    )
    def test_errors(self, folder: Path, kind: Any, change: Any, message: str) -> None:
        rewrite(folder, "control", change)
        with pytest.raises(CatalogueError, match=rf"control.parquet: .*{message}"):
            read_point_table(folder / "control.parquet", kind)

    def test_validate_reads_the_points(self, folder: Path) -> None:
        rewrite(folder, "control", lambda t: put_one(t, "latitude", 2, 91.0))
        with pytest.raises(CatalogueError, match="control.parquet: row 2"):
            Catalogue.open(folder).validate()
