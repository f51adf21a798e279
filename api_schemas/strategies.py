"""Names of the acquisition strategies. A contract test holds them equal to models.acquisition.STRATEGIES."""

from typing import Literal, get_args

from api_schemas.base import Schema

StrategyName = Literal["random", "cycle", "vanilla_cycle", "uncertainty"]
DEFAULT_STRATEGY: StrategyName = "cycle"
COLD_START_STRATEGY: StrategyName = "random"
STRATEGY_NAMES: tuple[str, ...] = get_args(StrategyName)


class Strategy(Schema):
    """`privileged` strategies see hidden actions: benchmarks only. `needs` names the networks a round trains for it."""

    name: StrategyName
    privileged: bool
    needs: tuple[str, ...]
    summary: str


CATALOG: tuple[Strategy, ...] = (
    Strategy(name="random", privileged=False, needs=(), summary="Segments in uniformly random order; needs no model."),
    Strategy(
        name="cycle",
        privileged=False,
        needs=("inverse_dynamics", "world_model"),
        summary="Forward-inverse cycle error under the sparse inverse model (equation 7).",
    ),
    Strategy(
        name="vanilla_cycle",
        privileged=False,
        needs=("dense_inverse_dynamics", "world_model"),
        summary="The same cycle error under an inverse model that sees the whole observation.",
    ),
    Strategy(
        name="uncertainty",
        privileged=False,
        needs=("ensemble", "inverse_dynamics", "world_model"),
        summary="Disagreement of an ensemble of world models under the inferred action.",
    ),
)
