"""Records of benchmarks that are kept: rows, machine, versions and date, as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.machine import machine

PACKAGES = ("dask", "icechunk", "zarr", "numba", "pyarrow")


def write_record(
    out: Path, name: str, scale: float, workers: int, rows: Sequence[Mapping[str, Any]], versions: Mapping[str, str] | None = None
) -> None:
    """Write ``NAME.json`` into a folder that is made; ``versions`` of packages beside those that every record has."""
    out.mkdir(parents=True, exist_ok=True)
    host = machine() | {package: version(package) for package in PACKAGES} | dict(versions or {})
    record = {"benchmark": name, "date": date.today().isoformat(), "scale": scale, "workers": workers, "machine": host, "rows": list(rows)}
    (out / f"{name}.json").write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
