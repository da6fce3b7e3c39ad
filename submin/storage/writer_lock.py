"""One writer at a time: a lock on a network in a folder, that ends with the process that holds it.

The operating system holds the lock (``flock`` on a file in the folder), so a writer that is killed leaves none behind. The file itself
stays and means nothing by itself. Object stores have no such lock; there the commit decides (`submin.storage.commit`).
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from submin.errors import BusyError, StoreError
from submin.storage.place import is_remote
from submin.storage.repository import clear_write_errors, write_error
from submin.storage.snapshot import Snapshot

LOCK_FILE = "writer.lock"
NO_LOCKS_HERE = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""A file system without locks answers with one of these; the commit decides there, as on object stores."""


@contextmanager
def writing(place: str) -> Iterator[None]:
    """Be the only writer of a network while the body runs; it does not wait for another.

    Raises
    ------
    BusyError
        When another process, or this one, is writing to the network.
    StoreError
        When there is no network, or it cannot be written; nothing is left behind then.
    """
    if is_remote(place):
        with clear_write_errors(place):
            yield
        return
    Snapshot.open(place)  # a folder that is no network gets no lock file
    path = Path(place) / LOCK_FILE
    try:
        # opened as it is: what the holder has written there must stay, should this process be refused
        file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), "r+b", buffering=0)
    except OSError as error:
        raise write_error(place, error.strerror or str(error)) from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BusyError(f"{place}: {_holder(file)} is writing to this network; wait until it ends, or stop it, and try again") from None
        except OSError as error:
            if error.errno not in NO_LOCKS_HERE:
                raise StoreError(f"{place}: cannot be locked for writing ({error.strerror})") from None
        _enter(file)
        try:
            with clear_write_errors(place):
                yield
        finally:
            file.truncate(0)


def _enter(file: BinaryIO) -> None:
    """Say who holds the lock, for those who are refused."""
    holder = {
        "pid": os.getpid(), "host": socket.gethostname(), "since": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }  # fmt: skip
    with suppress(OSError):  # the lock counts; on a full disk it bears no name
        file.seek(0)
        file.truncate(0)
        file.write(json.dumps(holder).encode())


def _holder(file: BinaryIO) -> str:
    """Who holds the lock; in the moment after it was taken this is not written yet."""
    try:
        holder = json.loads(file.read())
        return f"process {holder['pid']} on {holder['host']} (since {holder['since']}, {holder['command']!r})"
    except (ValueError, KeyError, TypeError):
        return "another process"
