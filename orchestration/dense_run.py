"""Sets of observations into a dense network and out of it again: each exactly once, a batch to a commit."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain, islice
from typing import Any

import numpy as np
import zarr

from orchestration.batch import Rejected
from orchestration.control import ControlAdded, RejectedPoint
from orchestration.dense_blocks import control_members, free_points
from orchestration.memory import own_peak_memory_mb
from orchestration.progress import Reporter, Silent
from orchestration.run import DEFAULT_BATCH_BLOCKS, check_frames
from orchestration.stage_one import BlockRays
from orchestration.withdraw import Withdrawn
from submin.errors import InputError, NumericalError
from submin.network.network_image import NetworkImage
from submin.network.observations import Cluster
from submin.network.pending import DenseNetwork, check_regular
from submin.storage.arrays import append_table, group_of, set_rows
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, ImageRecord, PointTable, defects
from submin.storage.commit import begin_change, commit
from submin.storage.dense_store import Member, append_members, read_members, read_points, read_state, write_state
from submin.storage.ledger import Entry, Ledger, append_entries
from submin.storage.schema import image_columns
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import writing

FAR_METRES = 1000.0
"""Observations that are off by more from where the network has their points are of other points of the same name."""

DOUBTFUL = 0.001
"""A good block agrees with what was there as badly as a doubtful one in one case of a thousand (decision 012)."""

Arrival = Block | Member


@dataclass(frozen=True)
class Doubtful:
    """Blocks that were fused (together, mostly one) and hardly agree with what was there; which of the two is wrong is not told."""

    block_ids: tuple[str, ...]
    d2: float
    degrees_of_freedom: int
    probability: float


@dataclass(frozen=True)
class DenseRunResult:
    """What a run into a dense network did; the keys of ``submin run --json``.

    Attributes
    ----------
    version : of the network afterwards; fused, skipped : numbers of blocks and clusters; control_fused : of control points
    pending : blocks of the network that wait for a point of theirs to be determined
    observations : positions and baselines that came
    doubtful : blocks that hardly agree with what was there when they came
    chi_square, degrees_of_freedom : of the whole network
    """

    version: str
    fused: int
    skipped: int
    control_fused: int
    rejected: tuple[Rejected, ...]
    pending: tuple[str, ...]
    doubtful: tuple[Doubtful, ...]
    points: int
    observations: int
    chi_square: float
    degrees_of_freedom: int
    seconds: float
    peak_memory_mb: float

    def to_json(self) -> dict[str, Any]:
        """Plain values, those of a factored network that have a meaning here among them."""
        return {
            "version": self.version, "blocks_fused": self.fused, "blocks_skipped": self.skipped, "blocks_pending": list(self.pending),
            "control_fused": self.control_fused,
            "blocks_rejected": [{"block_id": r.block_id, "reason": r.reason} for r in self.rejected],
            "blocks_doubtful": [asdict(d) for d in self.doubtful], "images_flagged": [],
            "points": self.points, "observations": self.observations,
            "chi_square": self.chi_square, "degrees_of_freedom": self.degrees_of_freedom,
            "seconds": self.seconds, "peak_memory_mb": self.peak_memory_mb,
        }  # fmt: skip


@dataclass
class DenseTally:
    """What has become of arrivals so far; ``version`` is the last one known."""

    version: int
    fused: int = 0
    control: int = 0
    skipped: int = 0
    control_skipped: int = 0
    observations: int = 0
    rejected: list[Rejected] = field(default_factory=list)
    doubtful: list[Doubtful] = field(default_factory=list)


class Working:
    """A dense network in memory while it is written to: its state, and the sets of observations behind it by their name.

    What is fused stays in memory from one batch to the next; a batch that cannot be committed ends the command, and this with it.
    """

    def __init__(self, snapshot: Snapshot) -> None:
        ledger = Ledger.of(snapshot)
        there = [entry.block_id for entry in ledger.entries.values() if entry.status == "fused"]
        self.ledger = ledger
        self.ellipsoid = snapshot.metadata.ellipsoid
        self.members = {member.block_id: member for member in read_members(snapshot, there)}
        self.network = DenseNetwork((member.cluster for member in self.members.values()), read_state(snapshot))
        self.content = {name: ledger.entries[name].content for name in there}
        self.near = dict(zip(self.network.state.ids.tolist(), self.network.state.geocentric, strict=True))

    def taken(self, arrival: Arrival) -> bool | None:
        """True when the network has the same already, False when it has something else of that name, None when it has nothing."""
        name = arrival.block_id
        return None if name not in self.content else self.content[name] == arrival.content_hash()

    def admitted(self, arrival: Arrival) -> Member:
        """The observations of an arrival, which is entered as one that is there.

        Raises
        ------
        InputError, NumericalError
            With the reason for which it cannot come in.
        """
        if isinstance(arrival, Block):
            reason = self.ledger.refusal(arrival) or defects(arrival)
            if reason is not None:
                raise InputError(reason)
            member = free_points(arrival, self.ellipsoid)
            self._refuse_shared_pass(member)
        else:
            member = arrival
            self._refuse_twice(member)
        check_regular(member.cluster)
        self._refuse_far(member.cluster)
        if isinstance(arrival, Block):
            self.ledger.enter(arrival)
        self.members[member.block_id] = member
        self.content[member.block_id] = arrival.content_hash()
        return member

    def inner(self) -> Mapping[str, tuple[float, int]]:
        """Chi-square and redundancy that stayed behind in blocks of images."""
        return {name: (member.inner_square, member.inner_redundancy) for name, member in self.members.items()}

    def _refuse_twice(self, member: Member) -> None:
        """Refuse control of a point that is control already, in another set: a survey counts once."""
        for other in self.members.values():
            common = sorted(set(member.point_ids) & set(other.point_ids)) if member.kind == other.kind == "control" else []
            if common:
                raise InputError(
                    f"point {common[0]} is control of the network already, in block {other.block_id}; a survey counts once; "
                    f"withdraw that first ('submin withdraw --control {common[0]}')"
                )

    def _refuse_shared_pass(self, member: Member) -> None:
        for other in self.members.values():
            common = sorted(set(member.passes) & set(other.passes))
            if common:
                raise InputError(
                    f"its images share errors of pass {common[0]} with those of block {other.block_id}, so their points are correlated; a "
                    "dense network takes uncorrelated blocks: put the pass into one block, or use a factored network"
                )

    def _refuse_far(self, cluster: Cluster) -> None:
        """Refuse observations that contradict where their points are by kilometres."""
        ids = cluster.point_ids.tolist()
        known = np.array([self.near.get(point, np.full(3, np.nan)) for point in ids])
        at = cluster.approximate(known)
        off = np.linalg.norm(np.nan_to_num(cluster.misclosure(at)).reshape(-1, 3), axis=1)
        if (off > FAR_METRES).any():
            k = int(np.argmax(off))
            start, end = cluster.from_ids[k], cluster.to_ids[k]
            what = f"point {start}" if cluster.positions[k] else f"the baseline from {start} to {end}"
            raise InputError(
                f"{what} is {off[k] / 1000.0:.1f} km from where the network has it; expected the same point under the same id: check ids "
                "and frame"
            )
        self.near.update((point, place) for point, place in zip(ids, at, strict=True) if not np.isnan(place[0]))


def run_dense(
    catalogue: Catalogue, place: str, *, batch_blocks: int = DEFAULT_BATCH_BLOCKS, reporter: Reporter | None = None
) -> DenseRunResult:
    """Fuse everything of a catalogue that a dense network does not have yet: clusters, control, and blocks of images by their points.

    Raises
    ------
    InputError
        When the catalogue breaks its contract, or its frame is not the network's: found before anything is written.
    BusyError, ConflictError
        When another process is writing to the network.
    """
    started, reporter = time.monotonic(), reporter or Silent()
    check_frames(catalogue, Snapshot.open(place))
    summary = catalogue.validate(truth=False)
    control = catalogue.points("control")
    reporter.begin(summary.blocks + summary.clusters + (0 if control is None else len(control)))
    arrivals: Iterator[Arrival] = chain(
        (Member(cluster) for cluster in catalogue.observations()), catalogue.blocks(),
        () if control is None else control_members(control, catalogue.metadata.ellipsoid),
    )  # fmt: skip
    tally = fuse_arrivals(arrivals, place, batch_blocks, reporter)
    after = Snapshot.open(place, f"v{tally.version}")
    points = read_points(after)
    there = {entry.block_id for entry in Ledger.of(after).entries.values() if entry.status == "fused"}
    return DenseRunResult(
        after.version, tally.fused, tally.skipped, tally.control, tuple(tally.rejected), tuple(sorted(there - set(points.blocks))),
        tuple(tally.doubtful), len(points.ids), tally.observations,
        points.chi_square, points.redundancy, time.monotonic() - started, own_peak_memory_mb(),
    )  # fmt: skip


def add_dense_control(points: PointTable, place: str, reporter: Reporter | None = None) -> ControlAdded:
    """Add control points to a dense network, in one commit; correlated ones as one set."""
    reporter = reporter or Silent()
    reporter.begin(len(points))
    members = list(control_members(points, Snapshot.open(place).metadata.ellipsoid))
    tally = fuse_arrivals(members, place, max(len(members), 1), reporter)
    rejected = tuple(RejectedPoint(r.points[0] if len(r.points) == 1 else r.block_id, r.reason, r.points) for r in tally.rejected)
    return ControlAdded(f"v{tally.version}", tally.control, tally.control_skipped, rejected, ())


def fuse_arrivals(arrivals: Iterable[Arrival], place: str, batch: int, reporter: Reporter) -> DenseTally:
    """Fuse those of some arrivals that a dense network does not have yet, so many to a commit."""
    with writing(place):
        known = Snapshot.open(place)
        tally, work = DenseTally(known.number), Working(known)
        new = _new(arrivals, work, tally, reporter)
        while group := list(islice(new, max(batch, 1))):
            _fuse_batch(place, work, group, tally)
            reporter.fused(len(group))
    return tally


def withdraw_dense(place: str, *, block: str | None = None, image: str | None = None, control: str | None = None) -> Withdrawn:
    """Withdraw a block, a cluster or control: all others are fused anew. It can come again.

    A point of correlated control takes its whole set with it.

    Raises
    ------
    InputError
        When the network does not have it, exactly one is not named, or it is an image.
    """
    if image is not None:
        raise InputError(f"{place}: is a dense network, which keeps points and no images; withdraw the block of {image!r} with --block")
    if (block is None) == (control is None):
        raise InputError("give exactly one of --block and --control")
    with writing(place):
        known = Snapshot.open(place)
        work = Working(known)
        name = block if block is not None else _control_of(work, control or "")
        if name not in work.members or (block is not None and work.members[name].kind == "control"):
            kind = "block" if block is not None else "control point"
            raise InputError(
                f"{place}: {kind} {block or control!r} is not in the network; see 'submin info', or 'submin history' for what came and went"
            )
        work.network = work.network.without([name])
        gone = work.members.pop(name)
        before = work.ledger.entries[name]
        session, base = begin_change(place, known.number)
        root, version = zarr.open_group(session.store, mode="r+"), base.number + 1
        what = f"block {block}" if block is not None else f"control point {control}"
        reason = ("block" if block is not None else "control point") + " withdrawn"
        entry = Entry(name, before.content, "withdrawn", reason, version, kind=before.kind)
        append_entries(group_of(root, "ledger"), [entry])
        images = base.image_columns(["block_id", "withdrawn"])
        rows = np.flatnonzero((images["block_id"] == name) & (images["withdrawn"] == 0))
        set_rows(group_of(root, "images"), "withdrawn", rows, np.ones(len(rows), dtype=np.uint8))
        write_state(root, work.network.state, work.inner())
        root.attrs["version"] = version
        commit(session, version, f"{what} withdrawn")
    return Withdrawn(f"v{version}", what, len(rows), len(gone.cluster), (base.cover.tile_name(0),))


def _control_of(work: Working, point: str) -> str:
    """The set of control that a point is of, or no name at all."""
    of_point = [m.block_id for m in work.members.values() if m.kind == "control" and point in set(m.cluster.from_ids.tolist())]
    return of_point[0] if of_point else ""


def _new(arrivals: Iterable[Arrival], work: Working, tally: DenseTally, reporter: Reporter) -> Iterator[tuple[Arrival, Member | Rejected]]:
    """Arrivals that the network does not have, each as observations or with the reason for which it cannot come in."""
    for arrival in arrivals:
        name = arrival.block_id
        taken = work.taken(arrival)
        if taken:
            if arrival.kind == "control":
                tally.control_skipped += len(arrival.point_ids)
            else:
                tally.skipped += 1
            reporter.fused(1)
            continue
        try:
            if taken is False:
                raise InputError(_with_other_content(arrival))
            yield arrival, work.admitted(arrival)
        except (InputError, NumericalError) as error:
            points = arrival.point_ids if isinstance(arrival, Member) and arrival.kind == "control" else ()
            yield arrival, Rejected(name, str(error), arrival.kind, points)


def _with_other_content(arrival: Arrival) -> str:
    if isinstance(arrival, Member) and arrival.kind == "control":
        points = arrival.point_ids
        what = f"control point {points[0]}" if len(points) == 1 else f"set of {len(points)} control points"
        return f"{what} is already in the network with other values; withdraw it first ('submin withdraw --control')"
    return f"block {arrival.block_id} is already in the network with other content; withdraw it first, or give the new one another id"


def _fuse_batch(place: str, work: Working, group: Sequence[tuple[Arrival, Member | Rejected]], tally: DenseTally) -> None:
    """Fuse what was admitted, and commit it with the reasons of what was not."""
    members = [(arrival, found) for arrival, found in group if isinstance(found, Member)]
    refused = [found for _, found in group if isinstance(found, Rejected)]
    tally.rejected.extend(refused)
    unsaid = [r for r in refused if not work.ledger.said(r.block_id, r.reason)]
    if not members and not unsaid:
        return  # the same command again writes nothing
    for done in work.network.add(member.cluster for _, member in members):
        test = done.innovation
        if test.probability < DOUBTFUL:
            tally.doubtful.append(Doubtful(done.block_ids, test.d2, test.degrees_of_freedom, test.probability))
    session, base = begin_change(place, tally.version)
    root, version = zarr.open_group(session.store, mode="r+"), base.number + 1
    append_members(root, [member for _, member in members], version)
    if members:
        write_state(root, work.network.state, work.inner())
    new, records = _images([arrival for arrival, _ in members if isinstance(arrival, Block)])
    append_table(group_of(root, "images"), image_columns(new, records))
    entries = [_entry(arrival, member, version) for arrival, member in members]
    append_entries(
        group_of(root, "ledger"), [*entries, *(Entry(r.block_id, "", "rejected", r.reason, version, kind=r.kind) for r in unsaid)]
    )
    root.attrs["version"] = version
    commit(session, version, f"{len(members)} blocks fused, {len(refused)} rejected")
    tally.version = version
    tally.control += sum(len(member.cluster) for _, member in members if member.kind == "control")
    tally.fused += sum(member.kind != "control" for _, member in members)
    tally.observations += sum(len(member.cluster) for _, member in members)


def _entry(arrival: Arrival, member: Member, version: int) -> Entry:
    """The line of the ledger: the set is there, fused or waiting."""
    images = len(arrival.images) if isinstance(arrival, Block) else 0
    return Entry(member.block_id, arrival.content_hash(), "fused", "", version, images, len(member.cluster), kind=member.kind)


def _images(blocks: Sequence[Block]) -> tuple[list[NetworkImage], list[ImageRecord]]:
    return [image for block in blocks for image in BlockRays.of(block).images], [image for block in blocks for image in block.images]
