"""A dense network, checked: points and covariance against its observations fused anew, and these against the ledger.

Nothing is changed.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import fields

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.errors import SubminError
from submin.network.dense_sub_min import DenseSubMin
from submin.network.pending import DenseNetwork
from submin.storage.dense_store import Member, read_members, read_points, read_state
from submin.storage.ledger import Entry
from submin.storage.problems import DAMAGE, Problem, first_line, some
from submin.storage.snapshot import Snapshot
from submin.storage.verify_tables import verify_history
from submin.storage.verify_tile import TileHealth

Array = NDArray[np.float64]

STALE = 1e-9
"""Standard deviations by which a state may differ from its observations fused anew; more where round-off can make more of it."""


def verify_dense(snapshot: Snapshot) -> tuple[list[Problem], list[TileHealth]]:
    """Check a dense network, which is one tile. Problems are found, never raised.

    The replay fuses every set of observations anew, as a withdrawal would: the state is a function of them.
    """
    tile = snapshot.cover.tile_name(0)
    problems: list[Problem] = []
    numbers: dict[str, float] = {}
    parameters = 0
    try:
        problems += verify_history(snapshot)
        members = _members(snapshot, tile, problems)
    except DAMAGE as error:
        problems.append(Problem(tile, "unreadable", f"ledger and observations: {first_line(error)}"))
        members = None
    try:
        state = read_state(snapshot)
        parameters = state.adjustments.size
        numbers["symmetric_error"] = _stored_twice(snapshot, tile, state, problems)
        sound = _sound(state, read_points(snapshot).blocks, tile, problems)
    except DAMAGE as error:
        problems.append(Problem(tile, "unreadable", f"points and covariance: {first_line(error)}"))
        return problems, [TileHealth(tile, tuple(problems))]
    if members is not None and sound:
        try:
            numbers |= _replayed(snapshot, state, members, tile, problems)
        except DAMAGE as error:
            problems.append(Problem(tile, "unreadable", f"the observations cannot be fused anew: {first_line(error)}"))
    return problems, [TileHealth(tile, tuple(problems), parameters=parameters, **numbers)]  # type: ignore[arg-type]


def _members(snapshot: Snapshot, tile: str, problems: list[Problem]) -> list[Member]:
    """The sets of observations that the ledger has, each checked against its line."""
    names = [f.name for f in fields(Entry)]
    table = snapshot.ledger(names)
    last: dict[str, Entry] = {}
    for line in (Entry(*row) for row in zip(*(table[name].tolist() for name in names), strict=True)):
        before = last.get(line.block_id)
        if line.status == "fused" and before is not None and before.status == "fused":
            problems.append(
                Problem(tile, "block-twice", f"block {line.block_id} is fused in v{before.version} and again in v{line.version}")
            )
        if not 0 <= line.version <= snapshot.number:
            problems.append(Problem(tile, "ledger", f"block {line.block_id} came with version {line.version}; this is v{snapshot.number}"))
        if line.status != "rejected":
            last[line.block_id] = line
    there = {name: line for name, line in last.items() if line.status == "fused"}
    members = read_members(snapshot, there.keys())
    missing = sorted(set(there) - {member.block_id for member in members})
    if missing:
        problems.append(Problem(tile, "rays-missing", f"{len(missing)} blocks of the ledger have no observations: {some(missing)}"))
    for member in members:
        line = there[member.block_id]
        if not (np.isfinite(member.cluster.values).all() and np.isfinite(member.cluster.covariance).all()):
            problems.append(Problem(tile, "not-finite", f"observations of block {member.block_id} are not finite"))
        if len(member.cluster) != line.rays:
            problems.append(Problem(
                tile, "rays-missing", f"block {member.block_id} came with {line.rays} observations; {len(member.cluster)} are there"
            ))  # fmt: skip
        elif member.kind == "observations" and member.content_hash() != line.content:
            problems.append(Problem(tile, "ledger", f"the observations of block {member.block_id} are not those that came"))
    return members


def _stored_twice(snapshot: Snapshot, tile: str, state: DenseSubMin, problems: list[Problem]) -> float:
    """Covariances of single points are kept beside the joint one, for maps; how far they differ, relative. One triangle is stored."""
    own, joint = read_points(snapshot).covariance, state.triangle.diagonal_blocks()
    if own.shape != joint.shape:
        problems.append(Problem(tile, "unreadable", f"{len(own)} points have a covariance, {len(joint)} are in the joint one"))
        return float("nan")
    difference = float(np.max(np.abs(own - joint) / np.abs(joint).max(axis=(1, 2), keepdims=True), initial=0.0))
    if difference > 0.0:
        problems.append(Problem(tile, "not-symmetric", f"covariances of single points differ from the joint one by {difference:.1e}"))
    return difference


def _sound(state: DenseSubMin, blocks: tuple[str, ...], tile: str, problems: list[Problem]) -> bool:
    """True when points and covariance can be computed with."""
    twice = [point for point, count in Counter(state.ids.tolist()).items() if count > 1]
    if twice:
        problems.append(Problem(tile, "point-in-two-cells", f"{len(twice)} points are there twice: {some(twice)}"))
    again = [block for block, count in Counter(blocks).items() if count > 1]
    if again:
        problems.append(Problem(tile, "block-twice", f"{len(again)} blocks are fused twice: {some(again)}"))
    bad = int((~np.isfinite(state.origins)).sum() + (~np.isfinite(state.adjustments)).sum())
    bad += sum(int((~np.isfinite(panel)).sum()) for panel in state.triangle.panels)
    if bad:
        problems.append(Problem(tile, "not-finite", f"{bad} numbers of its points and covariance are not finite"))
        return False
    try:
        state.triangle.check_definite()
    except SubminError as error:
        problems.append(Problem(tile, "not-positive-definite", str(error)))
        return False
    return True


def _replayed(
    snapshot: Snapshot, state: DenseSubMin, members: list[Member], tile: str, problems: list[Problem]
) -> dict[str, float]:  # fmt: skip
    """The state against all observations fused anew."""
    anew = DenseNetwork(member.cluster for member in members).state
    if set(anew.blocks) != set(state.blocks):
        differ = sorted(set(anew.blocks) ^ set(state.blocks))
        problems.append(Problem(tile, "stale-factor", f"{len(differ)} blocks are fused that should wait, or wait: {some(differ)}"))
        return {}
    places = anew.rows_of(state.ids)
    if len(anew) != len(state) or (places < 0).any():
        problems.append(Problem(tile, "stale-factor", f"{len(state)} points are there; its observations determine {len(anew)}"))
        return {}
    at = (3 * places[:, None] + np.arange(3)).ravel()
    made, kept = anew.triangle.submatrix(at), state.triangle.submatrix(np.arange(state.triangle.size))
    sigma = np.sqrt(np.diagonal(made))
    covariance = np.abs((kept - made) / sigma / sigma[:, None]).max(initial=0.0)
    moved = (state.geocentric - anew.geocentric[places]).ravel()
    resolved = 4.0 * np.spacing(np.abs(state.geocentric).max(initial=1.0))  # what a coordinate of this size can tell apart
    position = np.max(np.maximum(np.abs(moved) - resolved, 0.0) / sigma, initial=0.0)
    inner = sum(member.inner_square for member in members if member.block_id in set(state.blocks))
    square = abs(read_points(snapshot).chi_square - anew.chi_square - inner) / max(anew.chi_square + inner, 1.0)
    error = float(max(covariance, position, square))
    condition = _condition(made / sigma / sigma[:, None])
    allowed = max(STALE, 100.0 * np.finfo(np.float64).eps * condition)
    if not error <= allowed:
        problems.append(Problem(
            tile, "stale-factor",
            f"points, covariance and chi-square differ from the observations fused anew by {error:.1e} standard deviations; expected at "
            f"most {allowed:.0e}: a state, or an observation, is not what it was",
        ))  # fmt: skip
    return {"replay_error": error, "condition": condition}


def _condition(correlation: Array) -> float:
    """Condition of a positive definite matrix, from its Cholesky factor."""
    if not len(correlation):
        return float("nan")
    norm = float(np.abs(correlation).sum(axis=0).max())
    lower, failed = la.lapack.dpotrf(np.asfortranarray(correlation), lower=1, overwrite_a=1)
    return float("inf") if failed else 1.0 / float(la.lapack.dpocon(lower, norm, uplo="L")[0])
