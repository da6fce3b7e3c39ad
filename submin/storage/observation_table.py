"""The table ``observations`` of a catalogue: positions and baselines with the full covariance of each cluster, read and laid out.

Row i of a cluster holds in ``covariance_row`` the 3 x 3(i+1) values of its rows of the lower triangle, row-major, geocentric, m2: the
layout of query output (`submin.formats.tables`). In CSV it is a text of numbers with blanks between them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.linalg import lapack

from submin.errors import CatalogueError, InputError
from submin.formats.columns import number, number_values, numbers, refuse, table_runs, text, text_values
from submin.formats.tables import covariance_of_rows, covariance_rows, row_groups
from submin.geodesy import Ellipsoid
from submin.network.observations import Cluster
from submin.storage.catalogue_schema import CONTROL_PREFIX

Array = NDArray[np.float64]

STEM = "observations"
KINDS = ("position", "baseline")
OBSERVATION_COLUMNS = (
    text("cluster"), text("kind"), text("from"), text("to", blank=True), number("x"), number("y"), number("z"), numbers("covariance_row"),
)  # fmt: skip

_BATCH_ROWS = 64
"""Rows that are read at once: in a cluster of a thousand observations each holds nine thousand values."""
_ROUND_OFF = 1e-9
"""Relative difference of two places of a symmetric matrix that was written with fewer digits than float64 has."""
_GROUND = (0.5, 2.0)
"""Least and greatest distance of ground points from the centre of their body, in its semimajor axis: other numbers are no metres."""


def read_clusters(path: Path, ellipsoid: Ellipsoid, blocks: Collection[str] = frozenset()) -> Iterator[Cluster]:
    """Clusters of an observations table, one after the other; memory is bounded by one of them.

    Parameters
    ----------
    path : table ``observations``
    ellipsoid : of the body
    blocks : ids that no cluster may have: those of the catalogue's blocks of images

    Raises
    ------
    CatalogueError
        When the table lacks a column, a cluster comes back after another, has an id that is taken, or cannot be used: a kind that is
        none, a position with an end, a baseline without one, a number that is not finite, a position that is not on the ground of its
        body, or a covariance that is not positive definite.
    """
    found = False
    for cluster_id, row, table in table_runs(path, OBSERVATION_COLUMNS, "cluster", "cluster", _BATCH_ROWS):
        found = True
        if cluster_id in blocks:
            raise CatalogueError(f"{path}: row {row}: cluster is {cluster_id!r}, a block of images; expected an id of its own")
        if cluster_id.startswith(CONTROL_PREFIX):
            raise CatalogueError(
                f"{path}: row {row}: cluster is {cluster_id!r}; expected another id: {CONTROL_PREFIX!r} begins those of control points"
            )
        yield _cluster(cluster_id, table, path, row, ellipsoid)
    if not found:
        raise CatalogueError(f"{path}: holds no observations; expected at least one row")


def cluster_tables(cluster: Cluster) -> Iterator[pa.Table]:
    """The rows of a cluster in the layout of the table, a part of them after the other, each of 64 MiB at most."""
    kinds = np.where(cluster.positions, *KINDS)
    for first, last in row_groups(len(cluster)):
        rows = slice(first, last)
        yield pa.table(
            [
                pa.array([cluster.cluster_id] * (last - first), pa.string()),
                *(pa.array(ids[rows], pa.string()) for ids in (kinds, cluster.from_ids, cluster.to_ids)),
                *(pa.array(cluster.values[rows, k]) for k in range(3)),
                covariance_rows(cluster.covariance, first, last),
            ],
            schema=pa.schema([(c.name, c.type) for c in OBSERVATION_COLUMNS]),
        )


def _cluster(cluster_id: str, table: pa.Table, path: Path, row: int, ellipsoid: Ellipsoid) -> Cluster:
    position = pc.equal(table["kind"], KINDS[0])
    known = pc.is_in(table["kind"], value_set=pa.array(KINDS))
    refuse(pc.invert(known), table["kind"], "kind", path, row, " or ".join(repr(kind) for kind in KINDS))
    ended = pc.not_equal(table["to"], "")
    refuse(pc.and_(position, ended), table["to"], "to", path, row, "an empty text: a position has no end")
    refuse(pc.and_not(pc.invert(position), ended), table["to"], "to", path, row, "the point where the baseline ends")
    refuse(pc.equal(table["from"], table["to"]), table["to"], "to", path, row, "another point than that where the baseline starts")
    values = np.stack([number_values(table, name) for name in ("x", "y", "z")], axis=1)
    for k, name in enumerate(("x", "y", "z")):
        refuse(pa.array(~np.isfinite(values[:, k])), table[name], name, path, row, "a finite number of metres")
    axes = np.linalg.norm(values, axis=1) / ellipsoid.semimajor_axis
    nowhere = np.asarray(position.to_numpy()) & ((axes < _GROUND[0]) | (axes > _GROUND[1]))
    points = pa.array([", ".join(f"{v:.10g}" for v in place) for place in values.tolist()])
    refuse(pa.array(nowhere), points, "x, y, z", path, row, "geocentric metres of a point on the ground")
    lengths = pc.fill_null(pc.list_value_length(table["covariance_row"]), 0)
    asked = 9 * np.arange(1, table.num_rows + 1)
    wrong = np.asarray(lengths.to_numpy()) != asked
    if wrong.any():
        k = int(np.argmax(wrong))
        raise CatalogueError(
            f"{path}: row {row + k}: covariance_row has {lengths[k].as_py()} values; expected {asked[k]} "
            f"(3 x 3(i+1) for row i from 0 of cluster {cluster_id!r})"
        )
    try:
        covariance = covariance_of_rows(table["covariance_row"].chunks, table.num_rows, str(path), row)
    except InputError as error:
        raise CatalogueError(str(error)) from None
    own = covariance.reshape(table.num_rows, 3, table.num_rows, 3)[np.arange(table.num_rows), :, np.arange(table.num_rows), :]
    uneven = np.abs(own - own.transpose(0, 2, 1)).max(axis=(1, 2)) > _ROUND_OFF * np.abs(own).max(axis=(1, 2))
    expected = f"a symmetric covariance of the observation itself in its last nine values, of cluster {cluster_id!r}"
    refuse(pa.array(uneven), pa.array(own.reshape(-1, 9).tolist()), "covariance_row", path, row, expected)
    minor = lapack.dpotrf(covariance, lower=1)[1]
    if minor:
        raise CatalogueError(
            f"{path}: row {row + (minor - 1) // 3}: the covariance of cluster {cluster_id!r} (covariance_row) is not positive definite; "
            "expected that of observations that all have an error of their own (m2)"
        )
    return Cluster(cluster_id, text_values(table, "from"), text_values(table, "to"), values, covariance)


__all__ = ["KINDS", "OBSERVATION_COLUMNS", "STEM", "cluster_tables", "read_clusters"]
