"""What every world model offers, whatever its family."""

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from models.network import Network
from models.segments import Observations


class WorldModel(Network, Protocol):
    """f_theta(z_t, a_t) -> z_{t+1} with an encoder and a decoder.

    A state z is one tensor (B, ...); its layout belongs to the family. The loss takes labeled segments and raises
    ValueError for a batch without actions.
    """

    @property
    def symbolic(self) -> bool:
        """Whether it predicts symbols: such a prediction can be right exactly, and distances, in nats of what is seen,
        compare between models. Else they compare within one."""
        ...

    def encode(self, observations: Observations) -> Tensor:
        """Observations (B, ...) -> states (B, ...)."""
        ...

    def predict(self, state: Tensor, actions: Tensor) -> Tensor:
        """One step: states (B, ...), actions (B,) or (B, D) -> next states (B, ...)."""
        ...

    def decode(self, state: Tensor) -> Observations:
        """States (B, ...) -> parameters of the distribution over observations, in the family's layout."""
        ...

    def observe(self, state: Tensor) -> Observations:
        """The likeliest observation of each state: (B, ...) -> (B, ...), in the dtype of the space."""
        ...

    def infer_state(
        self, observations: Observations, actions: Tensor | None = None, context: Tensor | None = None
    ) -> Tensor:
        """State at the last of the observations (B, T, ...), given actions between them where known.

        `context` is a state before the first observation. A model that is no function of one frame states its burn-in.
        """
        ...

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Equation 6: state (B, ...), actions (B, L, ...) -> predicted states (B, L, ...)."""
        ...

    def distance(self, prediction: Tensor, reference: Observations) -> Tensor:
        """Equation 7's l, summed over the L steps: predicted states (B, L, ...), observations (B, L, ...) -> (B,)."""
        ...

    def disagreement(self, decoded: Sequence[Observations]) -> Tensor:
        """How far an ensemble's decoded predictions of the same B steps differ -> (B,), at least 0."""
        ...

    def latent_features(self, observations: Observations, actions: Tensor) -> Tensor:
        """Features of what is predicted where the action acts: (B, L+1, ...), (B, L, ...) -> (B, D), for diversity."""
        ...

    def signatures(self, observations: Observations, actions: Tensor) -> Tensor:
        """What happens in each segment, without where: (B, L+1, ...), (B, L, ...) -> int64 (B, S), equal for equals."""
        ...

    def changes(self, prediction: Tensor, observations: Observations) -> tuple[Tensor, Tensor]:
        """Predicted states (B, ...) of pairs (B, 2, ...) -> int64 (B,) changes predicted right, and changes."""
        ...
