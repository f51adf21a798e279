"""The queue of explorations: those most worth executing, so ordered that every prefix is a good batch."""

import torch
from torch import Tensor

from models.acquisition.base import CHUNK, Models
from models.acquisition.batch_rules import BatchRule, Candidates, top
from models.acquisition.batch_rules.base import description, weights
from models.acquisition.reachability import predicted_chain
from models.exploration import Explorations
from models.segments import Observations, SegmentBatch


@torch.inference_mode()
def order(
    rule: BatchRule,
    models: Models,
    observations: Observations,
    found: Explorations,
    count: int,
    generator: torch.Generator,
    chunk: int = CHUNK,
) -> Tensor:
    """Rows of `found` that have the `count` highest scores, so ordered that every prefix is a good batch.

    Of each state only the best is among them: several actions there may have no effect, whatever the world model
    expects, and that is one trajectory and one label. The best are shared out among the actions, of which the rule
    orders each one's by themselves: what the world model is wrong about most may all be of one action, and teach one
    thing. Of actions in a box the rule orders all. observations: the states (B, ...) that `explore` was given.
    """
    best = _best_of_each(found)
    best = best[top(found.scores[best], count)]
    world_model = models.world_model
    candidates = Candidates(found.scores[best])
    if rule.reads is not None and world_model is not None and len(best):
        parts = []
        for start in range(0, len(best), chunk):
            rows = best[start : start + chunk]
            states = {name: stream[found.states[rows]].unsqueeze(1) for name, stream in observations.items()}
            actions = found.actions[rows].to(next(iter(states.values())).device)
            chain = SegmentBatch(predicted_chain(world_model, states, actions))
            parts.append(description(rule.reads, world_model, chain, actions))
        candidates = Candidates(found.scores[best], **{rule.reads: torch.cat(parts).cpu()})
    if found.actions.dim() == 3:  # vectors: no two actions are the same
        return best[rule.order(candidates, len(best), generator)]
    return best[_shared_out(rule, candidates, found.actions[best, 0], generator)]


def _shared_out(rule: BatchRule, candidates: Candidates, first: Tensor, generator: torch.Generator) -> Tensor:
    """Rows of all candidates, so ordered that every prefix is a good batch. first int64 (M,): their first actions.

    As seats are shared out by D'Hondt: the n-th of an action in the rule's order stands for its weight over n, and for
    no more than the one before it, so that the rule's order holds within an action.
    """
    rows, averages = [torch.zeros(0, dtype=torch.int64)], [torch.zeros(0, dtype=torch.float64)]
    for action in sorted(set(first.tolist())):
        own = torch.nonzero(first == action).flatten()
        own = own[rule.order(candidates.take(own), len(own), generator)]
        averages.append((weights(candidates.scores[own]) / torch.arange(1, len(own) + 1)).cummin(0).values)
        rows.append(own)
    return torch.cat(rows)[top(torch.cat(averages), candidates.count)]


def _best_of_each(found: Explorations) -> Tensor:
    """Rows of `found`, of each state the one with the highest score, of equal ones the first: int64, in order."""
    best = found.scores.argsort(descending=True, stable=True)
    count = int(found.states.max()) + 1 if len(best) else 0
    first = torch.full((count,), len(best)).scatter_reduce(0, found.states[best], torch.arange(len(best)), "amin")
    return best[first[first < len(best)]].sort().values
