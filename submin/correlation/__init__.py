"""Correlation functions of distance: a joint covariance in a few numbers a point, made consistent (2008 MIN paper, section 6)."""

from submin.correlation.assembly import assemble
from submin.correlation.compact import CompactCovariance, bounded, condense, expand
from submin.correlation.families import FAMILIES, Correlation, Family, family_named
from submin.correlation.sparse import SparseFactor, assemble_sparse

__all__ = [
    "FAMILIES", "CompactCovariance", "Correlation", "Family", "SparseFactor",
    "assemble", "assemble_sparse", "bounded", "condense", "expand", "family_named",
]  # fmt: skip
