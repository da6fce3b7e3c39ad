"""A change of a network: begun after one version, committed as the next, or nothing."""

from __future__ import annotations

import pickle

import icechunk

from submin.errors import ConflictError
from submin.storage.repository import BRANCH, open_repository, write_error
from submin.storage.snapshot import Snapshot, root_of


def begin_change(place: str, version: int, known: Snapshot | None = None) -> tuple[icechunk.Session, Snapshot]:
    """A session in which to write what follows a version, and that version, which what is written does not change.

    ``known`` is that version where it is open already: what it has read is not read again.

    Raises
    ------
    ConflictError
        When it is not the newest version any more: what was decided by its ledger may not hold.
    StoreError
        When its store is gone.
    """
    repository = open_repository(place)
    session = repository.writable_session(BRANCH)
    if known is not None and known.number == version and known.commit == session.snapshot_id:
        return session, known
    base = repository.readonly_session(snapshot_id=session.snapshot_id)
    try:
        snapshot = Snapshot(root_of(base), place)
    except FileNotFoundError:  # it was there when the change was decided: what Zarr makes of a service that is gone
        raise write_error(place, "the network's root is not found any more") from None
    if snapshot.number != version:
        raise ConflictError(
            f"another run committed to this network meanwhile (v{snapshot.number} after v{version}); nothing of this change was written: "
            "give the same command again"
        )
    return session, snapshot


def commit(session: icechunk.Session, version: int, message: str) -> None:
    """Commit a batch as one version.

    Raises
    ------
    ConflictError
        When another coordinator committed meanwhile; nothing of this batch is in the network then.
    """
    try:
        session.commit(message, metadata={"version": version})
    except icechunk.ConflictError:
        raise ConflictError(
            "another run committed to this network meanwhile; nothing of this batch was written: give the same command again"
        ) from None


def unread(writes: icechunk.ForkSession) -> icechunk.ForkSession:
    """A fork with the same changes, which holds nothing of what was read through it: that is the names of all that its version has.

    Forks wait in memory until a change is committed, one of every task.
    """
    fork: icechunk.ForkSession = pickle.loads(pickle.dumps(writes))
    return fork
