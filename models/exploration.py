"""Explore mode: Algorithm 1 with the two checks of section 2.2, as a score of every action at every state.

Algorithm 1 executes along the sampled chain with the largest cycle error. What has the largest is often a chain that
the generator gets wrong: no action leads there. So no chain is believed by itself. At a state x_t, with futures x~_m of
prior p_m and predictions x^_a = f(z_t, a) of every action, executing a is worth

    fidelity        -log sum_m w_ma exp(-l(x^_a, x~_m)),   w_ma ~ p_m h(a | x_t, x~_m), summing to 1 over m,
  + cycle error     max_m min_b l(x^_b, x~_m) sqrt(q_ma), over the futures that the generator stands by,
    reachability    q_ma ~ sqrt(h(a | x_t, x~_m)) (1 - h(a | x_t, x^_a)) (1 - p(x^_a)^3) / h(a), summing to 1 over a.

The first, times `FIDELITY`, is large where what the world model says of a is no plausible outcome of it; one wrong
future more only lowers it. The second is large where something may happen that the world model expects of no action:
one of those led there that the inverse dynamics names for it, does not recognise in what the world model expects of
them, and of which the world model is not sure: p(x^_a) is what it gives to its likeliest prediction, over what it would
give if it were certain. h(a) is how often a is inferred at all, and of futures each h is at least about `UNNAMED`: an
action that no label shows is never inferred, so else never executed, so never labeled.

Where actions are a box nobody tries every one: there Algorithm 1 is taken as it is, and a state is worth the error of
the worst of its chains.

The batch is a matter of the queue (`exploration_queue`).
"""

from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import CHUNK, Models, NonFiniteScoreError, given, require
from models.acquisition.cycle import Cycle
from models.acquisition.reachability import predicted_chain
from models.cycle_consistency import WorstChain, worst_chain
from models.inverse_dynamics.base import ActionProbabilities, DiscreteInverseDynamics
from models.segments import Observations, SegmentBatch, future
from models.spaces import BoxAction, DiscreteAction
from models.subgoal_generators.base import Futures
from models.world_models.base import WorldModel

STATES = 4000
"""Drawn of the pool each time: what is worth executing is at many states, so looking at more of them hardly helps."""

CHAINS = 8  # of a state, where actions are a box
IMAGINED = 100_000  # observations in all of them, at most: of robots each is a picture

Asked = tuple[bytes, tuple[object, ...]]  # what it looks like there, and the actions

DOUBT = 0.01  # no action is known so well that it leads nowhere else
UNNAMED = 3e-3  # what an action that the inverse dynamics knows nothing of may still explain
SHARPNESS = 3.0  # a prediction is sure where it leaves out less than about a third of a nat
FIDELITY = 0.3  # against the cycle error: what is wrong about a step that changes nothing is much alike


@dataclass(frozen=True)
class Explorations:
    """M of them. states int64 (M,): the rows they begin at. actions int64 (M, K) or float (M, K, D): to be executed.
    scores (M,), nats."""

    states: Tensor
    actions: Tensor
    scores: Tensor

    def take(self, rows: Tensor) -> "Explorations":
        """Some of them: int64 places, or bool (M,)."""
        return Explorations(self.states[rows], self.actions[rows], self.scores[rows])

    def without(self, seen: Sequence[bytes], before: AbstractSet[Asked]) -> "Explorations":
        """Those that were not executed `before` where it looks the same. seen: what each of the states looks like."""
        proposed = zip(self.states.tolist(), self.actions.tolist(), strict=True)
        new = [asked(seen[state], actions) not in before for state, actions in proposed]
        return self.take(torch.tensor(new, dtype=torch.bool))


def looks(observations: Observations) -> list[bytes]:
    """What the agent sees in each of (B, ...), equal for equals."""
    rows = torch.cat([observations[name].flatten(1).cpu() for name in sorted(observations)], 1).numpy()
    return [row.tobytes() for row in rows]


def distinct(seen: Sequence[bytes]) -> Tensor:
    """Where each look is first: int64, in order. Rooms that look the same are one."""
    first = dict[bytes, int]()
    for place, look in enumerate(seen):
        first.setdefault(look, place)
    return torch.tensor(list(first.values()), dtype=torch.int64)


def asked(look: bytes, actions: Sequence[object]) -> Asked:
    """An exploration by what it begins with; actions of one number or of several each."""
    return look, tuple(tuple(each) if isinstance(each, list) else each for each in actions)


@torch.inference_mode()
def explore(
    strategy: Cycle,
    models: Models,
    observations: Observations,
    horizon: int,
    generator: torch.Generator,
    chunk: int = CHUNK,
    after_each: Callable[[], None] = lambda: None,
) -> Explorations:
    """All actions at states x_t (B, ...), each followed by what is inferred along its likeliest future, and scored.

    Of actions in a box those inferred along the worst of CHAINS sampled chains. The strategy says whose inverse
    dynamics infers. after_each: called after each chunk of states, may raise to stop. Raises ValueError when `models`
    lacks what the strategy needs or a subgoal generator, NonFiniteScoreError.
    """
    require(strategy, models)
    subgoals = given(strategy, "subgoal_generator", models.subgoal_generator)
    world_model, inverse = given(strategy, "world_model", models.world_model), strategy.verifier(models)
    if not isinstance(inverse, ActionProbabilities):
        worst = list[WorstChain]()
        for states in _parts(observations, chunk):
            worst.append(worst_chain(world_model, inverse, subgoals, states, CHAINS, horizon, generator))
            after_each()
        return _checked(strategy, _worst(worst))
    parts = list[_Imagined]()
    for states in _parts(observations, chunk):
        futures = subgoals.futures(states, horizon, generator)
        parts.append(_Imagined(states, futures, inverse.log_prob(SegmentBatch(futures.chains))))
        after_each()
    usual = torch.cat([_possible(part.log_prob)[:, 0].exp() for part in parts]).mean(0)
    actions, scores = list[Tensor](), list[Tensor]()
    for part in parts:
        actions.append(_candidates(part))
        scores.append(_scores(world_model, inverse, part, actions[-1], usual))
        after_each()
    return _checked(strategy, _listed(torch.cat(actions), torch.cat(scores)))


def states_to_look_at(space: DiscreteAction | BoxAction, horizon: int) -> int:
    """How many to draw of the pool: STATES, or as many as have no more than IMAGINED observations in their chains."""
    return STATES if isinstance(space, DiscreteAction) else max(1, min(STATES, IMAGINED // (CHAINS * horizon)))


def _parts(observations: Observations, chunk: int) -> Iterator[Observations]:
    for start in range(0, len(next(iter(observations.values()))), chunk):
        yield {name: stream[start : start + chunk] for name, stream in observations.items()}


def _worst(parts: Sequence[WorstChain]) -> Explorations:
    """One of each state, in order."""
    scores = torch.cat([part.error for part in parts]).cpu() if parts else torch.zeros(0)
    actions = torch.cat([part.actions for part in parts]).cpu() if parts else torch.zeros(0, 1)
    return Explorations(torch.arange(len(scores)), actions, scores)


def _checked(strategy: Cycle, found: Explorations) -> Explorations:
    """Raises NonFiniteScoreError."""
    bad = torch.nonzero(~torch.isfinite(found.scores)).flatten().tolist()
    if bad:
        where = f"action {found.actions[bad[0]].tolist()} at state {int(found.states[bad[0]])}"
        raise NonFiniteScoreError(f"Strategy {strategy.name} gave {float(found.scores[bad[0]])} to {where}.")
    return found


@dataclass(frozen=True)
class _Imagined:
    """States (B, ...), their M futures, and h of every action along each: (M, K, n)."""

    states: Observations
    futures: Futures
    log_prob: Tensor

    @property
    def size(self) -> int:
        """B."""
        return len(next(iter(self.states.values())))


def _candidates(imagined: _Imagined) -> Tensor:
    """Actions (B, n, K): first each of the n, then those inferred along the future in which it is likeliest first."""
    log_prob, futures = imagined.log_prob, imagined.futures
    likeliest = _per_state(log_prob[:, 0], futures.states, imagined.size)
    best = (log_prob[:, 0] == likeliest[futures.states]).nonzero()  # (any, 2): future, action
    shape = (imagined.size, log_prob.shape[2], log_prob.shape[1])
    following = torch.zeros(shape, dtype=torch.int64, device=log_prob.device)
    following[futures.states[best[:, 0]], best[:, 1]] = log_prob.argmax(-1)[best[:, 0]]
    following[..., 0] = torch.arange(shape[1], device=log_prob.device)
    return following


def _scores(
    world_model: WorldModel, inverse: DiscreteInverseDynamics, imagined: _Imagined, actions: Tensor, usual: Tensor
) -> Tensor:
    """(B, n) nats of actions (B, n, K). usual (n,): how often each is inferred at all."""
    count, futures = imagined.size, imagined.futures
    now = {name: stream.unsqueeze(1) for name, stream in imagined.states.items()}  # (B, 1, ...)
    state, inverse_log_prob = world_model.infer_state(now), _possible(imagined.log_prob)
    least = _least(world_model, state, now, actions.shape[2])
    distances, named, unknown = list[Tensor](), list[Tensor](), list[Tensor]()  # a column an action
    for each in actions.unbind(1):  # (B, K)
        prediction = world_model.rollout(state, each)
        distances.append(world_model.distance(prediction[futures.states], future(futures.chains)))
        named.append(_log_prob(inverse_log_prob, each[futures.states]))
        unknown.append(_unknown(world_model, inverse, now, each, prediction, least).log())
    distance, inferred, rows = torch.stack(distances, 1), torch.stack(named, 1), futures.states  # (M, n)
    weight = futures.log_prob.unsqueeze(1) + inferred
    fidelity = _logsumexp(weight, rows, count) - _logsumexp(weight - distance, rows, count)
    posterior = (0.5 * inferred + torch.stack(unknown, 1)[rows] - usual.log()).softmax(1)
    unexplained = torch.where(futures.steady, distance.amin(1), 0.0).unsqueeze(1)
    return FIDELITY * fidelity + _per_state(unexplained * posterior.sqrt(), rows, count)


def _unknown(
    world_model: WorldModel,
    inverse: DiscreteInverseDynamics,
    now: Observations,
    actions: Tensor,
    prediction: Tensor,
    least: Tensor,
) -> Tensor:
    """How little is known of what actions (B, K) do at x_t (B, 1, ...): (B,), in (0, 1.1)."""
    expected = predicted_chain(world_model, now, actions)
    recognised = _log_prob(inverse.log_prob(SegmentBatch(expected)), actions).exp()
    doubt = (world_model.distance(prediction, future(expected)) - least).clamp(min=0.0)
    sure = (-SHARPNESS * doubt).exp()
    return (1.0 - recognised + DOUBT) * (1.0 - sure + DOUBT)


def _least(world_model: WorldModel, state: Tensor, now: Observations, horizon: int) -> Tensor:
    """How far away K steps are that are certain and right, (B,) nats: those of x_t itself, in which nothing happens.

    state: z_t. A floor under what is decoded is the same for every prediction; an encoder's loss is only like it.
    """
    still = {name: stream.repeat_interleave(horizon, 1) for name, stream in now.items()}  # (B, K, ...)
    return world_model.distance(torch.stack([state] * horizon, 1), still)


def _possible(log_prob: Tensor) -> Tensor:
    """log h (..., n) of n actions with `UNNAMED` added to each h, normalised again."""
    return ((log_prob.exp() + UNNAMED) / (1.0 + log_prob.shape[-1] * UNNAMED)).log()


def _listed(actions: Tensor, scores: Tensor) -> Explorations:
    """(B, n, K), (B, n) -> one row an action, on the CPU."""
    states = torch.arange(len(actions)).repeat_interleave(actions.shape[1])
    return Explorations(states, actions.flatten(0, 1).cpu(), scores.flatten().cpu())


def _log_prob(log_prob: Tensor, actions: Tensor) -> Tensor:
    """Of actions (M, K) under log_prob (M, K, n), summed over the steps: (M,)."""
    return log_prob.gather(-1, actions.unsqueeze(-1)).squeeze(-1).sum(1)


def _per_state(values: Tensor, states: Tensor, count: int) -> Tensor:
    """The largest of each state's values: (M, n) of states (M,) -> (B, n)."""
    index = states.unsqueeze(1).expand_as(values)
    return values.new_full((count, values.shape[1]), -torch.inf).scatter_reduce(0, index, values, "amax")


def _logsumexp(values: Tensor, states: Tensor, count: int) -> Tensor:
    """(M, n) of states (M,) -> (B, n)."""
    largest = _per_state(values, states, count)
    terms = (values - largest[states]).exp()
    return largest + torch.zeros_like(largest).index_add_(0, states, terms).log()
