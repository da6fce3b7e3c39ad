"""Commands run in the process of a test."""

from __future__ import annotations

from collections.abc import Callable

Call = Callable[..., tuple[int, str, str]]
"""Runs ``submin WORDS``: its exit code, standard output and standard error."""
