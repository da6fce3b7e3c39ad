"""What imports have in common: their summary, passes by gaps in time, and notes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

PASS_GAP_SECONDS = 180.0
"""Images of one platform further apart in time than this are of two passes."""


@dataclass(frozen=True)
class ImportSummary:
    """What an import has written: sizes, and notes on what was assumed or left out.

    Attributes
    ----------
    catalogue : folder
    dataset : name of the catalogue, prefix of its point ids
    blocks, passes, images, points, rays, control : numbers of them
    notes : one line each
    """

    catalogue: Path
    dataset: str
    blocks: int
    passes: int
    images: int
    points: int
    rays: int
    notes: tuple[str, ...]
    control: int = 0


@dataclass(frozen=True)
class Taken:
    """When and by what an image was taken; ``pass_id`` is empty where nothing states it."""

    platform: str
    time: datetime | None
    pass_id: str


def passes(images: Sequence[Taken], dataset: str, notes: list[str]) -> list[str]:
    """Pass of each image: as stated, else by gaps in time within a platform, else one for all images without a time."""
    pass_ids = [image.pass_id for image in images]
    timed = [(image.platform, image.time, i) for i, image in enumerate(images) if image.time and not image.pass_id]
    last: tuple[str, datetime] | None = None
    for platform, time, i in sorted(timed):
        if last is None or last[0] != platform or (time - last[1]).total_seconds() > PASS_GAP_SECONDS:
            current = f"{platform or dataset}-{time:%Y%m%dT%H%M%S}"
        pass_ids[i], last = current, (platform, time)
    untimed = [i for i, image in enumerate(images) if not image.time and not image.pass_id]
    if untimed:
        for i in untimed:
            pass_ids[i] = f"{dataset}-pass"
        notes.append(
            f"neither pass_id nor acquisition_utc is known of {len(untimed)} images of {len(images)}: "
            f"they are taken as one pass, {dataset}-pass"
        )
    return pass_ids


def named(ids: Iterable[str]) -> str:
    """The first few of some ids, and how many more."""
    names = list(ids)
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


__all__ = ["PASS_GAP_SECONDS", "ImportSummary", "Taken", "named", "passes"]
