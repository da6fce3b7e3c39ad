"""The repository of a network: an Icechunk repository with a version per batch, whose versions have names and tags."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from inspect import signature
from pathlib import Path
from typing import Any
from uuid import uuid4

import icechunk
import zarr

from submin.errors import QueryError, StoreError
from submin.storage.arrays import create_table
from submin.storage.place import is_remote, reason_of, storage_of, unreachable
from submin.storage.schema import (
    CHANGE_COLUMNS,
    DIRECTORY_COLUMNS,
    FLAG_COLUMNS,
    IMAGE_CHUNK,
    IMAGE_COLUMNS,
    IMAGE_LETTERS,
    LEDGER_COLUMNS,
    NetworkMetadata,
)

icechunk.set_logs_filter("icechunk=error")
BRANCH = "main"
_FIRST_FORMAT: dict[str, Any] = {"spec_version": 1} if "spec_version" in signature(icechunk.Repository.create).parameters else {}
"""Icechunk 2 (which needs Python 3.12) reads and writes both formats, Icechunk 1 only the first: networks must travel."""
_CONFIGURATION = icechunk.RepositoryConfig(
    manifest=icechunk.ManifestConfig(
        preload=icechunk.ManifestPreloadConfig(max_total_refs=0, preload_if=icechunk.ManifestPreloadCondition.false())
    )
)
"""A question reads a few of the thousands of arrays; what Icechunk would read ahead of it at each opening is of others."""
_TAG, _OWN_NAME = re.compile(r"[A-Za-z0-9._-]+"), re.compile(r"v\d+")
_ABSENT = "no such network; make one with 'submin create'"
_TAKEN = "already exists; choose another place, or remove it first"


@dataclass(frozen=True)
class Version:
    """One version of a network: its number, the snapshot that holds it, when and with what message it was committed, its tags."""

    number: int
    snapshot: str
    written: datetime
    message: str
    tags: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """``v12``."""
        return f"v{self.number}"


def open_repository(place: str) -> icechunk.Repository:
    """The repository of a network.

    Raises
    ------
    StoreError
        When there is none, or its service is not reached.
    """
    if not is_remote(place) and Path(place).is_file():
        raise StoreError(f"{place}: is a file; expected the folder of a network: make one with 'submin create'")
    if not is_remote(place) and not Path(place).is_dir():
        raise StoreError(f"{place}: {_ABSENT}")
    try:
        return icechunk.Repository.open(storage_of(place), config=_CONFIGURATION)
    except icechunk.IcechunkError as error:
        if not is_remote(place):
            raise StoreError(f"{place}: not a network ({reason_of(error)}); make one with 'submin create'") from None
        if "repository doesn't exist" in str(error):
            raise StoreError(f"{place}: {_ABSENT}") from None
        raise unreachable(place, reason_of(error)) from None


def create_network(place: str, metadata: NetworkMetadata, begin: Callable[[zarr.Group], None] | None = None) -> Version:
    """Create an empty network, its version 0; ``begin`` writes what its form has besides.

    Raises
    ------
    StoreError
        When something is already there or the place cannot be written.
    """
    if not is_remote(place) and Path(place).exists() and (not Path(place).is_dir() or any(Path(place).iterdir())):
        raise StoreError(f"{place}: {_TAKEN}")
    remote, folder = is_remote(place), Path(place)
    # made beside the folder that is meant, or in it where it exists (it may be a mount), and moved there when all is written
    beside = folder if folder.is_dir() else folder.absolute().parent
    making = place if remote else str(beside / f".{uuid4().hex}")
    try:
        if not remote:  # Icechunk panics where it cannot make the folder
            Path(making).mkdir(parents=True)
        session = icechunk.Repository.create(storage_of(making), **_FIRST_FORMAT).writable_session(BRANCH)
        root = zarr.create_group(session.store, attributes=metadata.to_attributes() | {"version": 0})
        root.create_group("cells")
        root.create_group("tiles")
        create_table(root, "images", IMAGE_COLUMNS, rows=IMAGE_CHUNK, letters=IMAGE_LETTERS)
        create_table(root, "ledger", LEDGER_COLUMNS)
        create_table(root, "directory", DIRECTORY_COLUMNS)
        create_table(root, "flags", FLAG_COLUMNS)
        create_table(root, "changes", CHANGE_COLUMNS)
        reconciled = root.create_group("reconciled", attributes={"shared_names": []})
        reconciled.create_group("tiles")
        reconciled.create_group("trees")
        if begin is not None:
            begin(root)
        session.commit("created", metadata={"version": 0})
        if folder.is_dir():
            for part in sorted(Path(making).iterdir(), key=lambda path: path.name == "refs"):  # which make it a repository
                part.rename(folder / part.name)
        elif not remote:
            Path(making).rename(folder)
    except (icechunk.IcechunkError, OSError) as error:
        if remote:
            taken = "clean prefix" in str(error)
            raise (StoreError(f"{place}: {_TAKEN}") if taken else unreachable(place, reason_of(error))) from error
        raise StoreError(
            f"{place}: cannot be written ({reason_of(error)}); make room there, mend the permissions, or choose another place"
        ) from error
    finally:
        if not remote:
            shutil.rmtree(making, ignore_errors=True)
    return versions(place)[0]


def versions(place: str) -> list[Version]:
    """All versions of a network, the newest first."""
    repository = open_repository(place)
    tags: dict[str, list[str]] = {}
    for tag in sorted(repository.list_tags()):
        tags.setdefault(repository.lookup_tag(tag), []).append(tag)
    found = [
        Version(int(a.metadata["version"]), a.id, a.written_at, a.message, tuple(tags.get(a.id, ())))
        for a in repository.ancestry(branch=BRANCH)
        if "version" in a.metadata
    ]
    if not found:
        raise StoreError(f"{place}: holds a repository but no network; make one with 'submin create'")
    return found


def find_version(place: str, name: str) -> Version:
    """The version of a name (``v12``) or tag.

    Raises
    ------
    QueryError
        When there is none.
    """
    known = versions(place)
    for version in known:
        if name == version.name or name in version.tags:
            return version
    tags = "".join(f", {tag}" for version in known for tag in version.tags)
    raise QueryError(f"version is {name!r}; expected one of v0 to {known[0].name}{tags} (see 'submin history')")


def tag_version(place: str, tag: str, name: str | None = None) -> Version:
    """Give a version, by default the newest, a name that stays.

    Raises
    ------
    StoreError
        When the tag is taken, is no word, or would hide a version's own name.
    """
    if not _TAG.fullmatch(tag) or _OWN_NAME.fullmatch(tag):
        raise StoreError(f"tag is {tag!r}; expected a word of letters, digits, '.', '_' and '-' that is no version's own name such as v12")
    for known in versions(place):
        if tag in known.tags:
            raise StoreError(f"{place}: tag {tag!r} is that of {known.name}; expected a new one: a tag is given once")
    version = versions(place)[0] if name is None else find_version(place, name)
    with clear_write_errors(place):
        open_repository(place).create_tag(tag, snapshot_id=version.snapshot)
    return replace(version, tags=(*version.tags, tag))


@contextmanager
def clear_write_errors(place: str) -> Iterator[None]:
    """Say in one line that a batch could not be written: a full disk, a folder without permission, a store that is gone.

    Raises
    ------
    StoreError
        In place of what the store raised; nothing of the batch is in the network then.
    """
    try:
        yield
    except icechunk.IcechunkError as error:
        raise write_error(place, reason_of(error)) from error


def write_error(place: str, reason: str) -> StoreError:
    """The error that says that a change could not be written, and why."""
    return StoreError(
        f"{place}: cannot be written ({reason}); nothing of this change is in the network: "
        f"{'check the service and the credentials' if is_remote(place) else 'make room or mend the permissions'}, "
        "and give the same command again"
    )
