"""One network on disk: an Icechunk repository with a version per batch. Readers see one version, whole, whatever is being written."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields, replace
from datetime import datetime
from functools import cached_property, lru_cache
from inspect import signature
from pathlib import Path
from typing import Any
from uuid import uuid4

import icechunk
import numpy as np
import zarr
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.priors import ImagePrior
from submin.errors import ConflictError, QueryError, StoreError
from submin.network.cell import Cell, empty_cell, empty_sums, widened_sums
from submin.network.network_image import NetworkImage, image_priors
from submin.network.sub_min import SubMin
from submin.storage.arrays import (
    TABLE_CHUNK,
    attributes_of,
    create_table,
    existing_groups,
    group_of,
    member_names,
    read_attributes,
    read_record,
    read_records,
    read_spans,
    read_table,
    table_length,
)
from submin.storage.directory import Directory
from submin.storage.place import is_remote, reason_of, storage_of, unreachable
from submin.storage.schema import (
    CELL_PARTS,
    CHANGE_COLUMNS,
    DIRECTORY_COLUMNS,
    FLAG_COLUMNS,
    IMAGE_COLUMNS,
    LEDGER_COLUMNS,
    SUMS_PARTS,
    NetworkMetadata,
    cell_of,
    network_images,
    read_sub_min,
    sums_of,
    with_joint,
)
from submin.tiling.cover import Cover

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
READ_OVER_ROWS = 32
DIRECTORY_PIECE = 16 * TABLE_CHUNK
"""Entries of the directory that are looked through at a time."""
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


def _open_repository(place: str) -> icechunk.Repository:
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
        create_table(root, "images", IMAGE_COLUMNS)
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
    repository = _open_repository(place)
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
        _open_repository(place).create_tag(tag, snapshot_id=version.snapshot)
    return replace(version, tags=(*version.tags, tag))


@dataclass(frozen=True)
class RayTotals:
    """Rays of cells, the accepted ones, those of these that are measured in pixels, and the sum of their squared residuals, px2."""

    rays: int
    accepted: int
    pixel_rays: int
    square_px: float

    def changed(self, before: RayTotals, after: RayTotals) -> RayTotals:
        """Totals in which what some cells summed to is exchanged for what they sum to now."""
        return RayTotals(*(t - b + a for t, b, a in zip(astuple(self), astuple(before), astuple(after), strict=True)))

    @property
    def rms_px(self) -> float:
        """Residual of the accepted rays that are measured in pixels, RMS of one coordinate; 0 without any."""
        return float(np.sqrt(max(self.square_px, 0.0) / (2.0 * self.pixel_rays))) if self.pixel_rays else 0.0


def summed_cells(root: zarr.Group, names: Iterable[str] | None = None) -> RayTotals:
    """What the rays of some cells (names) that are there sum to, or of all; ``root`` may be of a version that is being written."""
    group = group_of(root, "cells")
    cells = [cell for cell in read_attributes(group, member_names(group) if names is None else names) if cell is not None]
    return RayTotals(*(sum(cell[field.name] for cell in cells) for field in fields(RayTotals)))


@lru_cache(maxsize=4)
def _cover(text: str) -> Cover:
    """The cover of a description: versions share it, and with it what it has worked out of its cells."""
    return Cover.from_mapping(json.loads(text))


class Snapshot:
    """One version of a network, read only. Everything is read when asked for; only names, flags and the directory are kept."""

    def __init__(self, root: zarr.Group, place: str, cover: Cover | None = None, parameters: int = 0) -> None:
        """``cover`` and ``parameters`` are those of the version being made: its tiles may be finer, its images may need more parameters."""
        self.root = root
        self.place = place
        stored = NetworkMetadata.from_attributes(attributes_of(root), place)
        self.metadata = replace(stored, parameters=max(stored.parameters, parameters))
        self.cover = _cover(json.dumps(self.metadata.cover)) if cover is None else cover
        self.number = int(attributes_of(root)["version"])

    @classmethod
    def open(cls, place: str, version: str | None = None, parameters: int = 0) -> Snapshot:
        """Open the newest version, or the one named (``v12``, or a tag), with at least so many parameters an image.

        Raises
        ------
        StoreError, QueryError
            When there is no network, or no such version.
        """
        repository = _open_repository(place)
        if version is None:
            session = repository.readonly_session(BRANCH)
        else:
            session = repository.readonly_session(snapshot_id=find_version(place, version).snapshot)
        try:
            return cls(_root(session), place, parameters=parameters)
        except FileNotFoundError:
            raise StoreError(f"{place}: holds a repository but no network; make one with 'submin create'") from None

    @property
    def version(self) -> str:
        """``v12``."""
        return f"v{self.number}"

    @property
    def commit(self) -> str:
        """The snapshot of the repository that holds the version."""
        store = self.root.store
        assert isinstance(store, icechunk.IcechunkStore)
        return str(store.session.snapshot_id)

    def cell(self, number: int, *, with_sums: bool = True) -> Cell:
        """A cell, empty when it has no points yet."""
        return self.cells([number], with_sums=with_sums)[0]

    def cells(self, numbers: Sequence[int], *, with_sums: bool = True) -> list[Cell]:
        """Cells, those empty that have no points yet; they are read side by side."""
        names, parameters = map(self.cover.cell_name, numbers), self.metadata.parameters
        records = read_records(group_of(self.root, "cells"), names, None if with_sums else CELL_PARTS)
        return [
            empty_cell(number, parameters) if record is None else cell_of(record, parameters, with_sums=with_sums)
            for number, record in zip(numbers, records, strict=True)
        ]

    def cell_sums(self, number: int) -> tuple[NDArray[np.int32], Sums]:
        """A cell's images (rows of the network) and sums, without its points and rays; nothing of a cell that has no points."""
        return self.some_sums([number])[0]

    def some_sums(self, numbers: Sequence[int]) -> list[tuple[NDArray[np.int32], Sums]]:
        """Images and sums of cells as `cell_sums` has them, read side by side."""
        parameters, found = self.metadata.parameters, []
        for record in read_records(group_of(self.root, "cells"), map(self.cover.cell_name, numbers), SUMS_PARTS):
            if record is None:
                found.append((np.empty(0, dtype=np.int32), empty_sums(0, parameters)))
            else:
                images = record.parts["images"].astype(np.int32)
                found.append((images, widened_sums(sums_of(record), len(images), parameters)))
        return found

    def cell_numbers(self) -> tuple[int, ...]:
        """Cells that hold points or rays, ascending."""
        return self._cell_numbers

    @cached_property
    def _cell_numbers(self) -> tuple[int, ...]:
        return tuple(sorted(map(self.cover.cell_number, member_names(group_of(self.root, "cells")))))

    def existing_cells(self, numbers: Sequence[int]) -> tuple[int, ...]:
        """Those of some cells that hold points or rays, without a list of all."""
        there = existing_groups(group_of(self.root, "cells"), map(self.cover.cell_name, numbers))
        return tuple(number for number, exists in zip(numbers, there, strict=True) if exists)

    def cell_counts(self, numbers: Sequence[int]) -> list[Mapping[str, Any]]:
        """Counts of some cells that are there, without reading their arrays."""
        found = read_attributes(group_of(self.root, "cells"), map(self.cover.cell_name, numbers))
        return [attributes for attributes in found if attributes is not None]

    def ray_totals(self) -> RayTotals:
        """What the rays of all cells sum to."""
        stated = attributes_of(self.root).get("rays")
        changed = read_table(group_of(self.root, "changes"), ["changed"])["changed"]
        # where another release has changed cells since, they say nothing
        if stated is None or stated["version"] < changed.max(initial=0):
            return summed_cells(self.root)
        return RayTotals(*(stated[field.name] for field in fields(RayTotals)))

    def tile_numbers(self) -> tuple[int, ...]:
        """Tiles that have a sub-MIN, ascending."""
        return self._tile_numbers

    @cached_property
    def _tile_numbers(self) -> tuple[int, ...]:
        return tuple(sorted(map(self.cover.tile_number, member_names(group_of(self.root, "tiles")))))

    def has_tile(self, tile: int) -> bool:
        """Whether a tile has a sub-MIN."""
        return existing_groups(group_of(self.root, "tiles"), [self.cover.tile_name(tile)])[0]

    def sub_min(self, tile: int, images: NDArray[np.int32] | None = None) -> SubMin:
        """A tile's sub-MIN, or its marginal on some images."""
        return read_sub_min(group_of(self.root, "tiles/" + self.cover.tile_name(tile)), self.metadata.parameters, images)

    def tile_images(self, tile: int) -> NDArray[np.int32]:
        """Rows of the images that a tile sees."""
        return np.asarray(read_record(group_of(self.root, "tiles/" + self.cover.tile_name(tile)), ["images"])["images"], dtype=np.int32)

    def image_count(self) -> int:
        """Number of images in the network."""
        return table_length(group_of(self.root, "images"))

    def images(self, rows: Sequence[int] | NDArray[np.integer] | None = None) -> list[NetworkImage]:
        """Images of these rows (ascending), or all."""
        return with_joint(self.root, self.plain_images(np.arange(self.image_count()) if rows is None else rows))

    def plain_images(self, rows: Sequence[int] | NDArray[np.integer]) -> list[NetworkImage]:
        """Images of these rows (ascending), views of correlated control without their rows of the common factor (`with_joint`)."""
        table = group_of(self.root, "images")
        wanted = [k for k in IMAGE_COLUMNS if k not in ("platform", "acquired", "footprint", "licence", "withdrawn")]
        if not len(rows):
            return []
        wanted_rows = np.asarray(rows, dtype=np.int64)
        found: list[NetworkImage] = []
        # rows of a long gap between neighbours are not decoded; runs that lie in one chunk are read together
        runs = np.split(wanted_rows, np.flatnonzero(np.diff(wanted_rows) > READ_OVER_ROWS) + 1)
        for run, columns in zip(runs, read_spans(table, wanted, [(int(run[0]), int(run[-1]) + 1) for run in runs]), strict=True):
            found.extend(network_images({name: values[run - run[0]] for name, values in columns.items()}))
        return found

    def image_priors(self) -> tuple[ImagePrior, ...]:
        """What is believed a priori of every image, by row; cameras are not read."""
        columns = self.image_columns(["image_id", "block_id", "pass_id", "sensor", "width", "height", "seconds", "a_priori", "released"])
        columns["camera"] = np.full(len(columns["image_id"]), "")
        return image_priors(with_joint(self.root, network_images(columns)))

    def image_columns(self, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Columns of the image table."""
        return read_table(group_of(self.root, "images"), wanted)

    def ledger(self, wanted: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
        """Columns of the ledger of blocks; a block's last row counts."""
        return read_table(group_of(self.root, "ledger"), wanted)

    def flags(self) -> frozenset[tuple[int, int]]:
        """Pairs of tile and image row: the tile finds the image's camera bad."""
        return self._flags

    @cached_property
    def _flags(self) -> frozenset[tuple[int, int]]:
        table = read_table(group_of(self.root, "flags"))
        return frozenset(zip(table["tile"].tolist(), table["image"].tolist(), strict=True))

    def candidate_cells(self, point_ids: NDArray[np.str_]) -> NDArray[np.int64]:
        """Cell (n,) in which each point would be, by the directory; -1 for points that are not in the network."""
        return self.directory_of(point_ids).cells_of(point_ids)

    def directory_of(self, point_ids: NDArray[np.str_]) -> Directory:
        """What the directory says of some points: in memory is a piece of it at a time, however many points the network has."""
        return Directory.of_points(self._directory_pieces(), point_ids)

    def _directory_pieces(self) -> Iterator[Directory]:
        if "_directory" in vars(self):
            yield self._directory
            return
        table = group_of(self.root, "directory")
        for start in range(0, table_length(table), DIRECTORY_PIECE):
            yield Directory(**read_table(table, DIRECTORY_COLUMNS, start, start + DIRECTORY_PIECE))

    def directory(self) -> Directory:
        """The directory of all points, 16 bytes each; it is kept."""
        return self._directory

    @cached_property
    def _directory(self) -> Directory:
        return Directory(**read_table(group_of(self.root, "directory"), DIRECTORY_COLUMNS))


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


def _root(session: icechunk.Session) -> zarr.Group:
    """The root of a version. What Zarr would look for beside, an older format and metadata of all members in one place, is never there."""
    return zarr.open_group(session.store, mode="r", zarr_format=3, use_consolidated=False)


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
    repository = _open_repository(place)
    session = repository.writable_session(BRANCH)
    if known is not None and known.number == version and known.commit == session.snapshot_id:
        return session, known
    base = repository.readonly_session(snapshot_id=session.snapshot_id)
    try:
        snapshot = Snapshot(_root(base), place)
    except FileNotFoundError:  # it was there when the change was decided: what Zarr makes of a service that is gone
        raise write_error(place, "the network's root is not found any more") from None
    if snapshot.number != version:
        raise ConflictError(
            f"another run committed to this network meanwhile (v{snapshot.number} after v{version}); nothing of this change was written: "
            "give the same command again"
        )
    return session, snapshot


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
