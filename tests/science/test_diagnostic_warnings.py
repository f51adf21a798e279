"""What diagnostics say to people."""

from dataclasses import replace
from typing import Any

from models.diagnostic_warnings import warnings
from models.diagnostics import Aliasing, BackAction, Diagnostics, KnownAction, Mask, Ranking, Support

WELL = Diagnostics(
    sampled=2000,
    mask=Mask(3.0, 37),
    support=Support(0.05, 0.1, 1.0),
    aliasing=Aliasing(0.2, 0.9, 0.1),
    back_action=BackAction(1000, 0.2, 0.4, 0.3),
    back_action_in_support=BackAction(700, 0.01, 0.02, 0.0),
    ranking=Ranking(1000, 0.9, 0.7),
    ranking_by_group={},
    actions=(KnownAction(50, 100, 0.95),) * 2,
)


def test_where_all_is_well_or_unknown_there_is_nothing_to_say() -> None:
    assert warnings(WELL) == []
    unknown = replace(
        WELL, mask=None, support=None, aliasing=None, back_action_in_support=None, ranking=None, actions=()
    )
    assert warnings(unknown) == []
    few = replace(WELL, ranking=Ranking(14, 0.1, 0.1), back_action_in_support=BackAction(14, 0.0, 0.9, 0.8))
    assert warnings(replace(few, actions=(KnownAction(3, 2, 0.0), KnownAction(0, 0, None)))) == []


FINDINGS: list[tuple[dict[str, Any], str]] = [
    (
        {"support": Support(0.412, 1.0, 4.0)},
        "The verifier has left its support: 41 % of the pool's segments show it something that no label shows "
        "(more than 20 %).",
    ),
    (
        {"actions": (KnownAction(50, 100, 0.95), KnownAction(3, 20, 0.4))},
        "The inverse model knows too little of swap: 3 labels, 40 % right on held-out segments (less than 70 %).",
    ),
    (
        {"ranking": Ranking(300, 0.314, 0.2)},
        "The score does not rank: Spearman 0.31 with the true loss on held-out segments (less than 0.50).",
    ),
    (
        {"aliasing": Aliasing(1.0, 2.0, 0.6)},
        "Several actions explain most of the pool alike: on 60 % of it the inverse model is in more doubt than "
        "between two (more than 50 %).",
    ),
    (
        {"back_action_in_support": BackAction(700, 0.05, 0.3, 0.4)},
        "What the verifier does not look at misleads it: 30 % inferred wrong where that is farthest from the labels, "
        "5 % where it is nearest.",
    ),
]


def test_each_finding_is_a_sentence() -> None:
    for changed, sentence in FINDINGS:
        assert warnings(replace(WELL, **changed), ("forward", "swap")) == [sentence]
    everything = replace(WELL, **{name: value for changed, _ in FINDINGS for name, value in changed.items()})
    assert warnings(everything, ("forward", "swap")) == [sentence for _, sentence in FINDINGS]
    one = replace(WELL, actions=(KnownAction(1, 20, 0.4),))
    assert warnings(one)[0].startswith("The inverse model knows too little of action 0: 1 label, 40 % right")


def test_an_action_that_no_label_shows_is_told_however_few_held_out_steps_do() -> None:
    for held_out, steps in ((1, "1 held-out step does"), (12, "12 held-out steps do")):
        unseen = replace(WELL, actions=(KnownAction(50, 100, 0.95), KnownAction(0, held_out, 0.5)))
        sentence = f"The inverse model knows too little of swap: no label shows it, {steps}."
        assert warnings(unseen, ("forward", "swap")) == [sentence]
    nowhere = replace(WELL, actions=(KnownAction(50, 100, 0.95), KnownAction(0, 0, None)))
    assert warnings(nowhere) == []  # it may have no effect of its own at all
