"""Benchmarks: one file a claim. ``python -m benchmarks`` lists them, ``python -m benchmarks NAME`` runs one."""
