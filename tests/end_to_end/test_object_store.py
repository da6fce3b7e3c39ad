"""Networks in a bucket of an S3-compatible service: the same commands, the same answers; two writers; a service that does not serve."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import boto3
import numpy as np
import pytest
from command_calls import Call

from benchmarks.fault_scene import EVERYWHERE, Content, Scene, make_scene
from benchmarks.started import Command, cluster, free_port, submin_command, wait_until
from orchestration.create import create, fit_catalogue
from orchestration.executors import SerialExecutor
from orchestration.progress import Silent
from orchestration.reconcile import reconcile
from orchestration.run import run
from orchestration.withdraw import withdraw
from submin.errors import ConflictError
from submin.storage.catalogue import Catalogue
from submin.storage.repository import versions
from submin.storage.snapshot import Snapshot

BUCKET = "networks"
KEYS = {"AWS_ACCESS_KEY_ID": "someone", "AWS_SECRET_ACCESS_KEY": "secret"}
OTHERS = ("AWS_ENDPOINT_URL_S3", "AWS_REGION", "AWS_DEFAULT_REGION", "AWS_SESSION_TOKEN", "AWS_PROFILE")


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def serving(log: Path) -> Iterator[tuple[Command, str]]:
    """A service with an empty bucket in a process of its own, and its address."""
    port = free_port()
    endpoint = f"http://127.0.0.1:{port}"
    with Command(["-m", "moto.server", "-H", "127.0.0.1", "-p", port], log) as server:
        wait_until(lambda: listens(port), server)
        keys = {name.lower(): value for name, value in KEYS.items()}
        boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1", **keys).create_bucket(Bucket=BUCKET)
        yield server, endpoint


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(tmp_path_factory.mktemp("service") / "service") as (_, endpoint):
        yield endpoint


@pytest.fixture
def bucket(service: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """URL of the bucket; the environment says where it is and who asks, as docs/cluster.md tells it, and nothing else does."""
    for name in OTHERS:
        monkeypatch.delenv(name, raising=False)
    for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_ENDPOINT_URL", service)
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    return f"s3://{BUCKET}"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"), 80.0, 2, 2)


@pytest.fixture(scope="module")
def in_folder(scene: Scene) -> Content:
    """The network that a run leaves in a folder."""
    network = scene.network("folder")
    run(Catalogue.open(scene.catalogue), str(network), SerialExecutor(), batch_blocks=2)
    reconcile(str(network), SerialExecutor())
    return Content.of(network)


def created(scene: Scene, place: str) -> str:
    """The scene's empty network at a place."""
    catalogue = Catalogue.open(scene.catalogue)
    create(place, fit_catalogue(catalogue)[0], catalogue.metadata, 60.0, 20.0)
    return place


def test_every_step_of_a_networks_life(bucket: str, scene: Scene, in_folder: Content, call: Call, tmp_path: Path) -> None:
    place, catalogue = f"{bucket}/some/where", Catalogue.open(scene.catalogue)
    block = catalogue.block_ids[2]
    assert call("info", place) == (2, "", f"submin: {place}: no such network; make one with 'submin create'\n")
    sizes = ("--fit", scene.catalogue, "--tile-km", 60, "--overlap-km", 20)
    assert call("create", place, *sizes)[0] == 0
    assert call("create", place, *sizes) == (2, "", f"submin: {place}: already exists; choose another place, or remove it first\n")
    with submin_command("run", scene.catalogue, place, "--batch-blocks", 2, "--json", log=tmp_path / "run") as command:
        assert command.wait() == 0, command.err
        assert json.loads(command.out)["blocks_fused"] == len(catalogue.block_ids)
    assert in_folder.faults(Content.of(place)) == []
    assert call("query", place, "--bbox", *EVERYWHERE, "--policy", "rigorous", "--out", tmp_path / "control.npz")[0] == 0
    sigma = np.sqrt(np.diag(in_folder.control.covariance))
    spread = np.load(tmp_path / "control.npz")["covariance"] - in_folder.control.covariance
    assert (np.abs(spread) / sigma / sigma[:, None]).max() <= 1e-9
    assert call("withdraw", place, "--block", block)[0] == 0
    assert call("tag", place, "without")[0] == 0
    assert versions(place)[0].tags == ("without",)
    assert call("verify", place)[0] == 0
    assert call("history", place)[0] == 0

    folder = scene.network("also-without")
    run(catalogue, str(folder), SerialExecutor(), batch_blocks=2)
    withdraw(str(folder), SerialExecutor(), block=block)
    reconcile(str(folder), SerialExecutor())
    expected, found = Content.of(folder), Content.of(place)
    assert (expected.ledger, expected.rays) == (found.ledger, found.rays)
    assert max(expected.differences(found)) <= 1e-9
    assert "other rays" in in_folder.faults(found)


@pytest.mark.parametrize("where", ["local workers", "scheduler"])
def test_workers_write_to_the_bucket(bucket: str, scene: Scene, in_folder: Content, where: str) -> None:
    """They take credentials from their own environment, and what place it is from the task."""
    name = where.replace(" ", "-")
    place = created(scene, f"{bucket}/{name}")
    if where == "scheduler":
        port = free_port()
        with cluster(scene.folder, scene.workers, name, port), scene.run(place, name, "--scheduler", f"tcp://127.0.0.1:{port}") as command:
            assert command.wait() == 0, command.err
    else:
        with scene.run(place, name) as command:
            assert command.wait() == 0, command.err
    assert Snapshot.open(place).version == "v4"  # three batches, and the reconciliation
    assert in_folder.faults(Content.of(place)) == []


def test_of_two_writers_the_later_commit_is_refused(bucket: str, scene: Scene, in_folder: Content) -> None:
    place, catalogue = created(scene, f"{bucket}/two"), Catalogue.open(scene.catalogue)

    class AnotherRun(Silent):
        def stage(self, name, total):  # type: ignore[no-untyped-def]
            if name == "factoring tiles" and Snapshot.open(place).number == 0:
                with scene.run(place, "another", "--workers", 0) as command:
                    assert command.wait() == 0, command.err
            return super().stage(name, total)

    with pytest.raises(ConflictError, match="another run committed to this network meanwhile; nothing of this batch was written"):
        run(catalogue, place, SerialExecutor(), batch_blocks=2, reporter=AnotherRun())
    assert [v.name for v in versions(place)] == ["v4", "v3", "v2", "v1", "v0"]
    assert in_folder.faults(Content.of(place)) == []
    assert run(catalogue, place, SerialExecutor()).fused == 0


def test_what_cannot_be_reached_is_one_line(bucket: str, scene: Scene, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    hint = "check the bucket, AWS_ENDPOINT_URL, AWS_REGION and the credentials (docs/cluster.md)"
    catalogue, place = scene.catalogue, created(scene, f"{bucket}/reached")
    missing = "s3://no-such-bucket/network"
    for words in (("info", missing), ("run", catalogue, missing), ("create", missing, "--fit", catalogue)):
        code, _, err = call(*words)
        assert (code, err) == (2, f"submin: {missing}: cannot be reached (NoSuchBucket: The specified bucket does not exist); {hint}\n")
    for no_bucket in ("gs://networks/one", "s3://", "https://example.org/network"):
        code, _, err = call("info", no_bucket)
        assert (code, err) == (2, f"submin: network is '{no_bucket}'; expected a folder, or s3://BUCKET/PREFIX\n")
    with monkeypatch.context() as environment:
        environment.delenv("AWS_ACCESS_KEY_ID")
        code, _, err = call("run", catalogue, place)
        assert (code, err) == (2, f"submin: {place}: cannot be reached (no providers in chain provided credentials); {hint}\n")
    with monkeypatch.context() as environment:
        environment.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
        code, _, err = call("info", place)
        assert (code, err) == (2, f"submin: {place}: cannot be reached (Connection refused (os error 111)); {hint}\n")


def test_a_service_lost_in_the_middle_of_a_run_is_one_line(
    bucket: str, scene: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:  # fmt: skip
    with serving(tmp_path / "service") as (server, endpoint):
        monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
        place = created(scene, f"{bucket}/lost")
        with scene.run(place, "lost") as command:
            wait_until(lambda: Snapshot.open(place).number >= 1, command)
            server.process.kill()
            assert command.wait() == 2
            # what is said depends on what the run was just about, a batch or the opening of the network for the next one;
            # in brackets what the store was: a connection refused, a snapshot not found
            assert re.fullmatch(
                rf"submin: {place}: (cannot be written \(.+\); nothing of this change is in the network: "
                r"check the service and the credentials, and give the same command again"
                r"|cannot be reached \(.+\); check the bucket, AWS_ENDPOINT_URL, AWS_REGION and the credentials \(docs/cluster\.md\))\n",
                command.err,
            ), command.err
