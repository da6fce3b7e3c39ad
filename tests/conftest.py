"""Fixtures that every kind of test shares."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings
from real_data import real_data

# One BLAS thread, as every worker has: matrices are small here, and two threads on two busy cores wait for each other.
for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

# How long an example takes is not what these tests are about, and machines are busy.
settings.register_profile("submin", deadline=None)
settings.load_profile("submin")


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of the real data; without it the test is skipped visibly, and in CI it fails."""
    return real_data()
