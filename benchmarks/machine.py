"""The machine that a benchmark ran on."""

from __future__ import annotations

import os
import platform
from typing import Any

import numpy as np
import scipy


def machine() -> dict[str, Any]:
    """Processor, cores, versions, and the kernel that BLAS uses."""
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "blas": f"{blas.get('name')} {blas.get('version')}",
        "blas_kernel": os.environ.get("OPENBLAS_CORETYPE", "chosen by the library"),
    }


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
