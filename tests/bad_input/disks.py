"""Disks that are full and folders that are read only, for a while."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

NOBODY = 65534


@contextmanager
def limited(size: int) -> Iterator[None]:
    """No file grows beyond a size: a disk that fills up, for any user."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def mounted(*words: object) -> Iterator[bool]:
    """Mount something on the folder named last; False where this is not allowed."""
    folder = str(words[-1])
    done = subprocess.run(["mount", *map(str, words)], capture_output=True, check=False).returncode == 0 if shutil.which("mount") else False
    try:
        yield done
    finally:
        if done:
            subprocess.run(["umount", "--lazy", folder], check=True)


@contextmanager
def somebody_else(folder: Path) -> Iterator[None]:
    """Root, whom no permission binds, is somebody else meanwhile, who can find the folder."""
    if os.geteuid() != 0:
        yield
        return
    above = [path for path in folder.parents if not path.stat().st_mode & 0o001]
    for path in above:
        path.chmod(path.stat().st_mode | 0o011)
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)
        for path in above:
            path.chmod(path.stat().st_mode & ~0o011)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Nothing can be written in a folder: by a mount where one is allowed, else by permissions."""
    inside = [folder, *folder.rglob("*")]
    with mounted("-o", "bind,ro", folder, folder) as done:
        if done:
            yield
            return
        for path in inside:
            path.chmod(0o555 if path.is_dir() else 0o444)
        try:
            with somebody_else(folder):
                yield
        finally:
            for path in inside:
                path.chmod(0o755 if path.is_dir() else 0o644)


@contextmanager
def disk(folder: Path) -> Iterator[Callable[[int], AbstractContextManager[None]]]:
    """A folder on a small file system of its own, and what fills it up to some bytes.

    Where none can be mounted the size of files is limited instead: writes fail in the middle of a commit all the same.
    """
    folder.mkdir()

    @contextmanager
    def full(room: int) -> Iterator[None]:
        ballast = folder / "ballast"
        ballast.write_bytes(bytes(shutil.disk_usage(folder).free - room))
        try:
            yield
        finally:
            ballast.unlink()

    with mounted("-t", "tmpfs", "-o", "size=4m", "tmpfs", folder) as done:
        yield full if done else limited
