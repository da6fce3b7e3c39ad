"""Simulating a campaign: its scenes in parallel, its catalogue as they come."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from orchestration.executors import Executor
from orchestration.progress import Reporter
from submin.errors import InputError
from submin.simulation.campaign import Campaign
from submin.storage.simulated import CampaignPart, CampaignSize, campaign_part, write_campaign

SCENES_AT_ONCE = 24
"""Scenes of one task: some 50,000 rays, 5 MB and a quarter of a second."""
DATA = "SUBMIN_DATA"


def simulate_campaign(campaign: Campaign, path: str | Path, executor: Executor, reporter: Reporter) -> CampaignSize:
    """Write the catalogue of a campaign; it does not depend on the executor.

    Raises
    ------
    CatalogueError
        When the folder holds something already.
    """
    starts = range(0, len(campaign.scenes), SCENES_AT_ONCE)
    design = executor.share(campaign.design)
    tasks = ((design, campaign.scenes[start : start + SCENES_AT_ONCE]) for start in starts)
    advance = reporter.stage("simulate scenes", len(starts))

    def parts() -> Iterator[CampaignPart]:
        for part in executor.stream(campaign_part, tasks, "simulate"):
            yield part
            advance()

    return write_campaign(campaign, parts(), path)


def shared_data(name: str) -> Path:
    """A file or folder of the shared data, which ``SUBMIN_DATA`` names.

    Raises
    ------
    InputError
        When it is not there.
    """
    folder = Path(os.environ.get(DATA, Path(__file__).parents[2] / "shared" / "data"))
    path = folder / name
    if not path.exists():
        raise InputError(f"{path}: not found; set {DATA} to the folder of the shared data, which holds {name}")
    return path
