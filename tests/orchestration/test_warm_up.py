"""What `compile_kernels` has not called each worker of a new installation would compile for itself, seconds for each kernel."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

_RUN = """
import importlib, json, pkgutil, sys
from numba.core.dispatcher import Dispatcher
import submin
from orchestration.executors import SerialExecutor
from orchestration.run import run
from orchestration.create import create, fit_catalogue
from submin.query.warm_up import compile_kernels
from submin.storage.catalogue import Catalogue

catalogue, network = sys.argv[1:]
modules = [importlib.import_module(found.name) for found in pkgutil.walk_packages(submin.__path__, "submin.")]
found = [(f"{module.__name__}.{name}", value, module.__name__) for module in modules for name, value in vars(module).items()]
kernels = {name: value for name, value, module in found if isinstance(value, Dispatcher) and value.__module__ == module}
compile_kernels()
before = {name: set(kernel.signatures) for name, kernel in kernels.items()}
opened = Catalogue.open(catalogue)
area, tile_km, overlap_km = fit_catalogue(opened)
create(network, area, opened.metadata, tile_km, overlap_km)
done = run(opened, network, SerialExecutor(), batch_blocks=4)
new = sorted(name for name, kernel in kernels.items() if set(kernel.signatures) - before[name])
print(json.dumps({"kernels": len(kernels), "new": new, "fused": done.fused}))
"""


def test_a_run_compiles_nothing_more(catalogue: Path, tmp_path: Path) -> None:
    """In a process of its own: here other tests have called kernels already. Batches of four: later blocks are tested by the network."""
    done = subprocess.run(
        [sys.executable, "-c", _RUN, str(catalogue), str(tmp_path / "network")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["kernels"] > 30
    assert found["fused"] == 12
    assert found["new"] == []
