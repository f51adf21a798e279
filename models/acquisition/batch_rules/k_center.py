"""k-center weighted by score (Sener and Savarese 2018): each pick is the candidate that is covered worst so far."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.batch_rules.base import Candidates, Description, followed_by_rest, top, weights


@dataclass(frozen=True)
class KCenter:
    """Takes the highest score, then always the largest sqrt(score) times squared distance to the nearest one taken.

    The greedy twin of k-means++: no draw is involved, so outliers of latent space come early. The window of high scores
    grows with the picks as it does there.
    """

    name: str = "k_center"
    reads: Description = "features"
    candidates_per_pick: int = 5
    fewest_candidates: int = 100

    def order(self, candidates: Candidates, count: int, generator: torch.Generator) -> Tensor:
        """Draws nothing from the generator. Without features it is the plain order by score."""
        scores = candidates.scores
        if candidates.features is None or len(scores) == 0:
            return top(scores, count)
        ranking = top(scores, len(scores))
        points, weight = candidates.features.double()[ranking], weights(scores)[ranking]
        order, nearest = [0], (points - points[0]).square().sum(1)
        while len(order) < min(count, len(scores)):
            window = max(self.fewest_candidates, self.candidates_per_pick * (len(order) + 1))
            gain = weight * nearest
            chosen = int(gain[:window].argmax())
            if float(gain[chosen]) <= 0.0:
                chosen = int(gain.argmax())
            if float(gain[chosen]) <= 0.0:
                break
            order.append(chosen)
            nearest = torch.minimum(nearest, (points - points[chosen]).square().sum(1))
        return followed_by_rest(scores, ranking[torch.tensor(order)], count)
