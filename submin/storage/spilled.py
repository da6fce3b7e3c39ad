"""Bytes of which few stay in memory: the others wait in a file without a name, in the system's folder for such files."""

from __future__ import annotations

import io
import os
import tempfile

from submin.errors import StoreError

MOST_IN_MEMORY = 16 << 20
"""Bytes; once there are more, all of them go to the file."""


class Spilled:
    """Bytes one after the other, first written, then read, also by several threads. The file is gone once it is closed or its process ends.

    Raises
    ------
    StoreError
        By `append`, where there is no room for the file; by `read`, when somebody has cut it short.
    """

    def __init__(self, what: str) -> None:
        """``what`` the bytes are, for messages."""
        self._what = what
        self._held = bytearray()
        self._file: io.FileIO | None = None

    def append(self, piece: bytes) -> None:
        """Add bytes at the end."""
        self._held += piece
        if self._file is None and len(self._held) <= MOST_IN_MEMORY:
            return
        left = memoryview(bytes(self._held))
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - closed by `close`
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            folder = tempfile.gettempdir()
            raise StoreError(
                f"{folder}: {self._what} cannot be kept there ({error.strerror}); make room, or set TMPDIR to another folder"
            ) from None
        self._held.clear()

    def read(self, start: int, end: int) -> bytes:
        """Bytes from ``start`` to before ``end``."""
        if self._file is None:
            return bytes(self._held[start:end])
        found = os.pread(self._file.fileno(), end - start, start)  # no seek, which threads would share
        if len(found) != end - start:
            raise StoreError(f"{tempfile.gettempdir()}: the file with {self._what} is shorter now; give the command again")
        return found

    def close(self) -> None:
        """Let go of the file."""
        if self._file is not None:
            self._file.close()
