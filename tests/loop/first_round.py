"""The loop as a client goes through it, up to the first round: collect, acquire, label, retrain."""

import numpy as np

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.projects import LabelingPolicy, Project, ProjectCreate
from api_schemas.rounds import Round
from asim.client import Client
from tests.workers.conftest import ROOM
from workers.labeling import run_labeling

START_SECONDS = 90.0
JOB_SECONDS = 120.0
SEED_LABELS = 60


def collected(client: Client, transitions: int) -> Project:
    """A project with a pool and 35 held-out labels."""
    policy = LabelingPolicy(round_labels=SEED_LABELS)
    project = client.create_project(ProjectCreate(name="scaled", environment=ROOM, policy=policy))
    pool = CollectionCreate(project=project.id, transitions=transitions, seed=1, split="pool")
    held_out = CollectionCreate(
        project=project.id,
        behavior="balanced",
        transitions=5000,
        seed=2,
        split="held_out",
        labels=CollectionLabels(per_action=5),
    )
    for asked in (pool, held_out):
        client.wait_for_job(client.collect(asked).id, timeout=START_SECONDS)
    counts = client.project(project.id).counts
    assert (counts.pool_segments, counts.held_out_labeled) == (transitions, 35)
    return project


def first_round(
    client: Client, project: Project, generator: np.random.Generator
) -> tuple[Round, list[tuple[str, int]]]:
    """A batch by chance, labeled; the round that its labels asked for, and the segments that were acknowledged."""
    seeds = client.acquire(project.id, SEED_LABELS, wait=JOB_SECONDS)
    assert seeds.strategy == "random"
    accepted = run_labeling(client, seeds, generator)
    assert accepted.round is not None  # the policy asks for one after so many labels
    done = client.wait_for_round(accepted.round, timeout=JOB_SECONDS)
    assert done.status == "current"
    return done, [(receipt.trajectory, receipt.start) for receipt in accepted.receipts]
