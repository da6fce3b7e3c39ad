"""What a network holds, in a few numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from submin import Network
from submin.sensors import SURVEYS
from submin.storage.accuracy_map import accuracy_of_all
from submin.storage.dense_reader import DenseReader
from submin.storage.ledger import Ledger
from submin.storage.place import is_remote
from submin.storage.reconciled import ReconciledStore
from submin.storage.validity import today


def describe(network: Network) -> dict[str, Any]:
    """Numbers of ``submin info``: counts, median accuracy, size."""
    if network.dense is not None:
        return _describe_dense(network, network.dense)
    snapshot = network.snapshot
    cells = snapshot.cell_counts(network.cell_numbers())
    images = snapshot.image_columns(["image_id", "sensor", "released", "withdrawn"])
    here = (images["withdrawn"] == 0) & ~np.isin(images["sensor"], SURVEYS)
    ledger = Ledger.of(snapshot)
    accuracy = accuracy_of_all(network, today())
    reported = ~accuracy.thinned & ~accuracy.retired
    return {
        "version": network.version,
        "points": len(accuracy.ids),
        "points_reported": int(reported.sum()),
        "points_thinned": int(accuracy.thinned.sum()),
        "points_retired": int(accuracy.retired.sum()),
        "points_pending": int(sum(c["points"] for c in cells)) - len(accuracy.ids),
        "rays": int(sum(c["rays"] for c in cells)),
        "rays_rejected": int(sum(c["rays"] - c["accepted"] for c in cells)),
        "images": int(here.sum()),
        "images_flagged": ", ".join(images["image_id"][here & (images["released"] == 1)].tolist()),
        "blocks": len(ledger.fused()),
        "control_points": len(ledger.control_points()),
        "control_sets": len(ledger.control_sets()),
        "tiles": len(snapshot.tile_numbers()),
        "tiles_of_the_area": network.cover.tile_count,
        "cells": len(cells),
        "reconciled": _reconciled(network),
        "ce90_median": float(np.median(accuracy.ce90[reported])) if reported.any() else float("nan"),
        "le90_median": float(np.median(accuracy.le90[reported])) if reported.any() else float("nan"),
        "tile_km": network.cover.core / 1000.0,
        "overlap_km": network.cover.overlap / 1000.0,
        "thin_metres": snapshot.metadata.thinning,
        "frame": snapshot.metadata.frame,
        "bytes": _size(snapshot.place),
    }


def _reconciled(network: Network) -> str:
    """Version to which tiles were last reconciled, such as ``v9``; with ``, and changed since`` where some were; ``no`` without any."""
    known = ReconciledStore.of(network.snapshot)
    trees = known.trees().values()
    if not trees:
        return "no"
    last = max(tree.version for tree in trees)
    return f"v{last}" if known.current(network.snapshot.tile_numbers()) else f"v{last}, and changed since"


def _describe_dense(network: Network, dense: DenseReader) -> dict[str, Any]:
    """Of a dense network: what it is about, and how well all of it fits together."""
    snapshot, points = network.snapshot, dense.points
    there = {entry.block_id for entry in Ledger.of(snapshot).entries.values() if entry.status == "fused"}
    degrees = points.redundancy
    return {
        "version": network.version,
        "form": snapshot.metadata.form,
        "points": len(points.ids),
        "observations": int(sum(len(member.cluster) for member in dense.members)),
        "blocks": sum(member.kind != "control" for member in dense.members),
        "blocks_pending": len(there - set(points.blocks)),
        "control_points": len(dense.control_points),
        "tiles": 1,
        "chi_square": points.chi_square,
        "degrees_of_freedom": degrees,
        "variance_factor": points.chi_square / degrees if degrees else float("nan"),
        "ce90_median": float(np.median(dense.ce90())) if len(points.ids) else float("nan"),
        "le90_median": float(np.median(dense.le90())) if len(points.ids) else float("nan"),
        "frame": snapshot.metadata.frame,
        "bytes": _size(snapshot.place),
    }


def _size(place: str) -> int:
    """Bytes of a network in a folder; -1 where it is none."""
    return sum(f.stat().st_size for f in Path(place).rglob("*") if f.is_file()) if not is_remote(place) else -1
