"""Proposals of explorations: futures imagined at states of the pool, those most worth executing queued for acquire."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from uuid import UUID

import torch
from sqlalchemy.orm import Session

from models.acquisition import BATCH_RULES, EXPLORING, Cycle, Models
from models.chance import scoring_generator
from models.exploration import Asked, asked, distinct, explore, looks, states_to_look_at
from models.exploration_queue import order
from models.segments import Observations, at, take
from service import draws, projects, proposals, rounds, scorings
from service.scorings import Ranked
from service.store.queries import acquisitions as acquisition_queries
from service.store.queries import pool as pool_queries
from service.store.tables import ModelVersionRow, ProjectRow, ScoringRow
from workers import data
from workers.diagnosis import draw_places
from workers.evaluation import load_network
from workers.job import RunningJob
from workers.scoring import load_models


@dataclass(frozen=True)
class Plan:
    """What one job proposes from: states (trajectory, observation), those of `total`, networks, chance.

    explored: what is not proposed again, states with actions. blobs: by trajectory, where its content is.
    """

    project: ProjectRow
    scoring: ScoringRow
    states: list[tuple[str, int]]
    total: int
    explored: list[tuple[str, int, list[object]]]
    blobs: dict[str, str]
    subgoal_generator: ModelVersionRow
    generator: torch.Generator

    @property
    def strategy(self) -> Cycle:
        """Who proposes."""
        return EXPLORING[self.scoring.strategy]

    def windows(self, states: Iterable[tuple[str, int]]) -> list[data.Windows]:
        """Where to read what was observed in them."""
        return [data.Windows(name, self.blobs[name], (start,)) for name, start in states]


def run_proposals(job: RunningJob, scoring_id: UUID, length: int) -> dict[str, object]:
    """Queue what a strategy finds most worth executing; every prefix of the queue is a good batch.

    It replaces what is left of the queue. Cut short it proposes the same again; once its queue is stored, other ones.
    """
    with job.worker.database.read() as session:
        plan = _plan(session, scoring_id)
    if plan is None:
        return {"queued": 0}
    ranked = _ranked(job, plan, length)
    with job.transaction() as session:
        scorings.publish(session, scoring_id, ranked, job.now())
    exhausted = not ranked and len(plan.states) == plan.total
    return {"queued": len(ranked), "states": len(plan.states), "exhausted": exhausted}


def _plan(session: Session, scoring_id: UUID) -> Plan | None:
    """None where nobody waits for it any more."""
    scoring = scorings.find(session, scoring_id)
    project = projects.find(session, scoring.project_id)
    assert scoring.round_id is not None  # noqa: S101  # proposals are made under a round's models
    round_row = rounds.find(session, scoring.round_id)
    subgoal_generator = proposals.generator_of(session, round_row)
    if scoring.status == "failed" or subgoal_generator is None:
        return None
    what = f"exploration {acquisition_queries.times_proposed(session, scoring)}"
    members = pool_queries.count_members(session, project.id, "pool", scoring.memberships)
    generator = scoring_generator(project.seed, scoring.strategy, round_row.number, members, what)
    there = draws.states(session, project, last=scoring.memberships)
    count = states_to_look_at(data.model_spaces(projects.spaces_of(project)).action, project.segment_length)
    states = [there.at(project, place) for place in draw_places(there.count, [], count, generator)]
    explored = acquisition_queries.explored(session, project.id, scoring.round_id)
    names = sorted({name for name, _ in states} | {name for name, *_ in explored})
    blobs = {name: row.blob_sha256 for name, row in pool_queries.contents(session, names).items()}
    return Plan(project, scoring, states, there.count, explored, blobs, subgoal_generator, generator)


def _ranked(job: RunningJob, plan: Plan, length: int) -> list[Ranked]:
    """The `length` best new explorations as the policy's batch rule orders them."""
    strategy, project, before = plan.strategy, plan.project, _explored(job, plan)
    models = _models(job, plan)
    observed = _observed(job, plan, plan.states)
    rooms = distinct(looks(observed))
    states, names = take(observed, rooms), [plan.states[int(room)] for room in rooms]
    job.report(0.2, f"imagining futures of {len(names)} states")
    found = explore(strategy, models, states, project.segment_length, plan.generator, after_each=job.go_on)
    found = found.without(looks(states), before)
    rule = BATCH_RULES[projects.policy_of(project).batch_rule]
    job.report(0.9, f"ordering {len(found.scores)} explorations by {rule.name}")
    chosen = found.take(order(rule, models, states, found, length, plan.generator))
    proposed = zip(chosen.states.tolist(), chosen.scores.tolist(), chosen.actions.tolist(), strict=True)
    return [Ranked(*names[int(state)], score=score, actions=actions) for state, score, actions in proposed]


def _explored(job: RunningJob, plan: Plan) -> set[Asked]:
    """What was executed already, by what it looked like there: another state may look the same."""
    if not plan.explored:
        return set()
    seen = looks(_observed(job, plan, [(name, start) for name, start, _ in plan.explored]))
    return {asked(look, actions) for look, (*_, actions) in zip(seen, plan.explored, strict=True)}


def _observed(job: RunningJob, plan: Plan, states: Sequence[tuple[str, int]]) -> Observations:
    """What was observed in the states: (B, ...). What came next is another strategy's business."""
    windows = plan.windows(states)
    batch = data.load_in_order(job.worker.blobs, windows, plan.project.segment_length, job.go_on)
    return at(batch.observations, 0)


def _models(job: RunningJob, plan: Plan) -> Models:
    """The strategy's networks, and the subgoal generator, which may be the project's and no round's."""
    worker, needs = job.worker, frozenset(plan.strategy.needs)
    models = load_models(worker.database, worker.blobs, plan.project, plan.scoring.round_id, needs)
    generator = load_network(worker.blobs, plan.subgoal_generator, plan.project)
    return replace(models, subgoal_generator=generator)  # type: ignore[arg-type]  # the checkpoint's kind was checked
