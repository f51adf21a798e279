"""Names of the strategies and batch rules. A contract test holds them equal to models.acquisition's registries."""

from typing import Literal, get_args

from api_schemas.base import Schema

StrategyName = Literal[
    "random",
    "cycle",
    "confident_cycle",
    "masked_cycle",
    "vanilla_cycle",
    "self_inverse",
    "uncertainty",
    "progress",
    "fidelity",
    "reachability",
    "forward_cycle",
    "true_progress",
    "oracle",
    "oracle_easy",
    "oracle_uniform",
]
BatchRuleName = Literal["top", "rank_noise", "kmeans_plus_plus", "k_center", "signatures"]
BATCH_RULE_NAMES: tuple[str, ...] = get_args(BatchRuleName)
DEFAULT_BATCH_RULE: BatchRuleName = "signatures"
DEFAULT_STRATEGY: StrategyName = "confident_cycle"
COLD_START_STRATEGY: StrategyName = "random"
STRATEGY_NAMES: tuple[str, ...] = get_args(StrategyName)


class Strategy(Schema):
    """`privileged` strategies see hidden actions: benchmarks only, a project is refused them.

    `needs` names the networks that it reads: the round trains them, but for the previous round's world model.
    explores: it proposes what to execute in explore mode; for the others chance does. boxes: it takes actions in a box;
    what tries every action does not.
    """

    name: StrategyName
    privileged: bool
    needs: tuple[str, ...]
    explores: bool = False
    boxes: bool = True
    summary: str


def _strategy(
    name: StrategyName,
    needs: tuple[str, ...],
    summary: str,
    *,
    privileged: bool = False,
    explores: bool = False,
    boxes: bool = True,
) -> Strategy:
    return Strategy(name=name, privileged=privileged, needs=needs, explores=explores, boxes=boxes, summary=summary)


_CYCLE = ("inverse_dynamics", "world_model")
CATALOG: tuple[Strategy, ...] = (
    _strategy("random", (), "Segments in uniformly random order; needs no model."),
    _strategy(
        "cycle", _CYCLE, "Forward-inverse cycle error under the sparse inverse model (equation 7).", explores=True
    ),
    _strategy(
        "confident_cycle",
        _CYCLE,
        "Cycle error over all actions that the inverse model thinks possible: what it doubts ranks lower.",
        explores=True,
    ),
    _strategy(
        "masked_cycle",
        ("masked_inverse_dynamics", "world_model"),
        "The same cycle error under an inverse model that learns what to look at.",
        explores=True,
    ),
    _strategy(
        "vanilla_cycle",
        ("dense_inverse_dynamics", "world_model"),
        "The same cycle error under an inverse model that sees the whole observation.",
        explores=True,
    ),
    _strategy(
        "self_inverse",
        ("world_model",),
        "Cycle error with the world model as its own inverse: a control.",
        boxes=False,
    ),
    _strategy(
        "uncertainty",
        ("ensemble", "inverse_dynamics"),
        "Disagreement of an ensemble of world models under the inferred action.",
    ),
    _strategy(
        "progress",
        ("inverse_dynamics", "previous_world_model", "world_model"),
        "How much the loss under the inferred action fell since the round before; in the first round the loss itself.",
    ),
    _strategy(
        "fidelity",
        ("inverse_dynamics", "subgoal_generator", "world_model"),
        "Distance from the prediction to the nearest of several samples of the subgoal generator.",
    ),
    _strategy(
        "reachability", _CYCLE, "How little the inverse model recognises the action in what it is predicted to do."
    ),
    _strategy(
        "forward_cycle",
        _CYCLE,
        "The forward-first cycle: predict under every action, then recover the action.",
        boxes=False,
    ),
    _strategy(
        "true_progress",
        ("previous_world_model", "world_model"),
        "Progress under the true actions.",
        privileged=True,
    ),
    _strategy("oracle", ("world_model",), "The true loss, hardest first.", privileged=True),
    _strategy("oracle_easy", ("world_model",), "The true loss, easiest first.", privileged=True),
    _strategy("oracle_uniform", ("world_model",), "Ten intervals of the true loss by turns.", privileged=True),
)
TRY_EVERY_ACTION: frozenset[str] = frozenset(strategy.name for strategy in CATALOG if not strategy.boxes)
PRIVILEGED: frozenset[str] = frozenset(strategy.name for strategy in CATALOG if strategy.privileged)
