"""What diagnostics mean, in sentences for people, where they say that the method does not hold."""

from collections.abc import Iterator, Sequence

from models.diagnostics import Diagnostics, KnownAction

OUTSIDE = 0.20
"""Share of the pool whose z_S no label shows. There the inverse model guesses; the score ranks the guess, and from a
fifth of the pool on, guesses can fill whole batches, since they score high."""

ABOVE_LN_2 = 0.50
"""Share of the pool with more doubt than between two actions. Steps without effect have many explanations and are
common in recordings by chance; where they are the rule, scores tell little of the world model."""

FEWEST_SEGMENTS = 30
"""Held-out segments for a rank correlation to be spoken of: its standard error is 1 / sqrt(n - 1), here 0.19."""

SPEARMAN = 0.50
"""Of score and true loss. The paper's baselines reach 0.41 and 0.62, the method 0.88: below a half it is no better."""

BACK_ACTION = 0.10
"""Rise of the share inferred wrong from the nearest to the farthest third, of steps whose z_S some label shows: an
inverse model that reads nothing else is hardly ever wrong there, so a tenth comes from what it should not see."""

FEWEST_THIRDS = 100
"""Held-out steps in support for their thirds to be compared: two standard errors of 33 steps at 5 % wrong are 0.11."""

FEWEST_STEPS = 10
"""Held-out steps of an action for its accuracy to be spoken of: 6 of 10 right is rare (1 %) where 90 % are."""

ACCURACY = 0.70
"""Of one action. The paper's inverse model is right in 87 % at its fewest labels; one that is wrong in 30 % makes cycle
errors of its own for the action, as large as the world model's."""


def warnings(diagnostics: Diagnostics, names: Sequence[str] = ()) -> list[str]:
    """One sentence for each finding, the gravest first; none where all is well or nothing could be looked at.

    names: of the actions, in order; an action without one goes by its number.
    """
    return [
        *_support(diagnostics),
        *unknown_actions(diagnostics.actions, names),
        *_ranking(diagnostics),
        *_others(diagnostics),
    ]


def _support(diagnostics: Diagnostics) -> Iterator[str]:
    support = diagnostics.support
    if support is not None and support.outside > OUTSIDE:
        yield (
            f"The verifier has left its support: {_percent(support.outside)} of the pool's segments show it something "
            f"that no label shows (more than {_percent(OUTSIDE)})."
        )


def unknown_actions(actions: Sequence[KnownAction], names: Sequence[str] = ()) -> Iterator[str]:
    """A sentence for each action that labels lack or that is often inferred wrong; names: as in `warnings`."""
    for number, action in enumerate(actions):
        reason = _too_little(action)
        if reason is not None:
            name = names[number] if number < len(names) else f"action {number}"
            yield f"The inverse model knows too little of {name}: {reason}."


def _too_little(action: KnownAction) -> str | None:
    """An action that neither labels nor held-out steps show alone may be one without an effect of its own."""
    if action.labels == 0 and action.held_out > 0:
        steps = "1 held-out step does" if action.held_out == 1 else f"{action.held_out} held-out steps do"
        return f"no label shows it, {steps}"
    if action.accuracy is None or action.held_out < FEWEST_STEPS or action.accuracy >= ACCURACY:
        return None
    labels = "1 label" if action.labels == 1 else f"{action.labels} labels"
    return f"{labels}, {_percent(action.accuracy)} right on held-out segments (less than {_percent(ACCURACY)})"


def _ranking(diagnostics: Diagnostics) -> Iterator[str]:
    ranking = diagnostics.ranking
    if ranking is None or ranking.segments < FEWEST_SEGMENTS:
        return
    if ranking.spearman is not None and ranking.spearman < SPEARMAN:
        yield (
            f"The score does not rank: Spearman {ranking.spearman:.2f} with the true loss on held-out segments "
            f"(less than {SPEARMAN:.2f})."
        )


def _others(diagnostics: Diagnostics) -> Iterator[str]:
    aliasing, back = diagnostics.aliasing, diagnostics.back_action_in_support
    if aliasing is not None and aliasing.above_ln_2 > ABOVE_LN_2:
        yield (
            f"Several actions explain most of the pool alike: on {_percent(aliasing.above_ln_2)} of it the inverse "
            f"model is in more doubt than between two (more than {_percent(ABOVE_LN_2)})."
        )
    if back is not None and back.steps >= FEWEST_THIRDS and back.farthest - back.nearest > BACK_ACTION:
        yield (
            f"What the verifier does not look at misleads it: {_percent(back.farthest)} inferred wrong where that is "
            f"farthest from the labels, {_percent(back.nearest)} where it is nearest."
        )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
