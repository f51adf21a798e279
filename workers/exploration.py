"""Proposals of explorations: futures imagined at states of the pool, those most worth executing queued for acquire."""

from dataclasses import dataclass, replace
from uuid import UUID

import torch
from sqlalchemy.orm import Session

from models.acquisition import BATCH_RULES, EXPLORING, Cycle, Models
from models.chance import scoring_generator
from models.exploration import STATES, Explorations, distinct, explore, order
from models.segments import at
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
    """What one job proposes from: states (trajectory, observation), where their content is, networks, chance.

    explored: what is not proposed again, states with actions.
    """

    project: ProjectRow
    scoring: ScoringRow
    states: list[tuple[str, int]]
    explored: set[tuple[str, int, tuple[object, ...]]]
    windows: list[data.Windows]
    subgoal_generator: ModelVersionRow
    generator: torch.Generator

    @property
    def strategy(self) -> Cycle:
        """Who proposes."""
        return EXPLORING[self.scoring.strategy]

    def at(self, rows: torch.Tensor) -> "Plan":
        """With some of the states alone."""
        return replace(self, states=[self.states[row] for row in rows.tolist()])

    def new(self, found: Explorations) -> Explorations:
        """Those that nobody was asked to execute yet."""
        proposed = zip(found.states.tolist(), found.actions.tolist(), strict=True)
        kept = [(*self.states[state], tuple(actions)) not in self.explored for state, actions in proposed]
        return found.take(torch.tensor(kept, dtype=torch.bool))


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
    return {"queued": len(ranked), "states": len(plan.states)}


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
    members = pool_queries.memberships(session, project.id, "pool", last=scoring.memberships)
    generator = scoring_generator(project.seed, scoring.strategy, round_row.number, len(members), what)
    there = draws.states(session, project, last=scoring.memberships)
    states = [there.at(project, place) for place in draw_places(there.count, [], STATES, generator)]
    contents = pool_queries.contents(session, sorted({trajectory for trajectory, _ in states}))
    windows = [data.Windows(name, contents[name].blob_sha256, (start,)) for name, start in states]
    explored = acquisition_queries.explored(session, project.id, scoring.round_id)
    return Plan(project, scoring, states, explored, windows, subgoal_generator, generator)


def _ranked(job: RunningJob, plan: Plan, length: int) -> list[Ranked]:
    """The `length` best new explorations as the policy's batch rule orders them."""
    strategy, project, blobs = plan.strategy, plan.project, job.worker.blobs
    models = _models(job, plan)
    seen = data.load_in_order(blobs, plan.windows, project.segment_length, job.go_on)
    rooms = distinct(at(seen.observations, 0))  # what was observed next is another strategy's business
    states, plan = at(seen.take(rooms).observations, 0), plan.at(rooms)
    job.report(0.2, f"imagining futures of {len(plan.states)} states")
    found = plan.new(explore(strategy, models, states, project.segment_length, plan.generator, after_each=job.go_on))
    rule = BATCH_RULES[projects.policy_of(project).batch_rule]
    job.report(0.9, f"ordering {len(found.scores)} explorations by {rule.name}")
    chosen = found.take(order(rule, models, states, found, length, plan.generator))
    proposed = zip(chosen.states.tolist(), chosen.scores.tolist(), chosen.actions.tolist(), strict=True)
    return [Ranked(*plan.states[int(state)], score, actions) for state, score, actions in proposed]


def _models(job: RunningJob, plan: Plan) -> Models:
    """The strategy's networks, and the subgoal generator, which may be the project's and no round's."""
    worker, needs = job.worker, frozenset(plan.strategy.needs)
    models = load_models(worker.database, worker.blobs, plan.project, plan.scoring.round_id, needs)
    generator = load_network(worker.blobs, plan.subgoal_generator, plan.project)
    return replace(models, subgoal_generator=generator)  # type: ignore[arg-type]  # the checkpoint's kind was checked
