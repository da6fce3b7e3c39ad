"""Where a network lies: a folder, or ``s3://BUCKET/PREFIX`` on Amazon's object store or a service that speaks its language.

Everything but bucket and prefix comes from the environment, by the names that Amazon's own tools read (docs/cluster.md), so that no key
is in a command line or in a network. An object store must have conditional writes: by them the commit decides between two writers
(docs/decisions/007-one-writer.md).
"""

from __future__ import annotations

import os
import re

import icechunk

from submin.errors import StoreError

ANY_REGION = "us-east-1"
"""Region of a service of one's own, where none is told: a request bears one, and these services take this."""
_CODE_AND_MESSAGE = re.compile(r'code: "([^"]+)", message: "([^"]*)"')


def is_remote(place: str) -> bool:
    """True for an address, False for a folder."""
    return "://" in place


def storage_of(place: str) -> icechunk.Storage:
    """What Icechunk reads and writes at a place. Workers that are given it take credentials from their own environment.

    Raises
    ------
    StoreError
        When the address is none of a bucket.
    """
    if not is_remote(place):
        return icechunk.local_filesystem_storage(place)
    scheme, _, rest = place.partition("://")
    bucket, _, prefix = rest.partition("/")
    if scheme != "s3" or not bucket:
        raise StoreError(f"network is {place!r}; expected a folder, or s3://BUCKET/PREFIX")
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or (ANY_REGION if endpoint else None)
    return icechunk.s3_storage(
        bucket=bucket, prefix=prefix.strip("/") or None, region=region, endpoint_url=endpoint, from_env=True,
        allow_http=(endpoint or "").startswith("http://"),
        force_path_style=bool(endpoint),  # a name for each bucket is what few services but Amazon's have
    )  # fmt: skip


def reason_of(error: Exception) -> str:
    """The innermost cause in a few words: Icechunk tells causes a line each, from the outside in."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    lines = [line for line in (line.strip(" │├╰─|`->") for line in str(error).splitlines()) if line]
    coded = _CODE_AND_MESSAGE.search(lines[-1]) if lines else None
    return f"{coded[1]}: {coded[2]}" if coded else lines[-1] if lines else type(error).__name__


def unreachable(place: str, reason: str) -> StoreError:
    """The error that says that a service did not give what was asked for, and why."""
    return StoreError(
        f"{place}: cannot be reached ({reason}); check the bucket, AWS_ENDPOINT_URL, AWS_REGION and the credentials (docs/cluster.md)"
    )


def unreadable(error: Exception) -> StoreError | None:
    """What Icechunk raised while a network was read, as an error of ours; None for any other error."""
    if not isinstance(error, icechunk.IcechunkError):
        return None
    return StoreError(
        f"the network cannot be read ({reason_of(error)}); where its store answers, 'submin verify' tells what of it is damaged"
    )
