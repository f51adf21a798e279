"""A round's diagnostics: a stage of its own, stored once, shown with the round, and told where they warn."""

import pytest
import torch

from api_schemas.rounds import Diagnostics
from tests.workers.conftest import ROOM, OpenLoop, new_project
from tests.workers.in_process import Loop
from tests.workers.test_rounds import STAGES, disk_is_full, hashes, interrupt, start
from workers import diagnosis
from workers.diagnosis import SAMPLE, draw_places
from workers.dispatch import run_next

ACTIONS = ["left", "right", "forward", "pickup", "drop", "toggle", "swap"]


def shown(loop: Loop) -> Diagnostics:
    """Of the project's current round."""
    current = loop.project.current_round
    assert current is not None
    found = loop.client.round(current).diagnostics
    assert found is not None
    return found


def test_a_round_is_diagnosed_on_its_labels_the_pool_and_the_held_out_labels(trained: Loop) -> None:
    found, counts = shown(trained), trained.project.counts
    assert found.sampled == counts.pool_segments - 60
    assert found.mask is not None
    assert (found.mask.kept, found.mask.coordinates) == (3, 37)
    assert found.support is not None
    assert 0 < found.support.outside < 1
    assert found.aliasing is not None
    assert 0 < found.aliasing.mean < torch.tensor(7.0).log()
    assert found.back_action is not None
    assert found.back_action.steps == 14
    assert found.ranking is not None
    assert found.ranking.segments == counts.held_out_labeled == 14
    assert {name: group.segments for name, group in found.ranking_by_group.items()} == {"movement": 6, "interaction": 8}
    assert [(each.action, each.name) for each in found.actions] == list(enumerate(ACTIONS))
    assert sum(each.labels for each in found.actions) <= 60
    assert sum(each.held_out for each in found.actions) <= 14


def test_what_it_warns_of_is_said_with_the_round_and_as_an_event(trained: Loop) -> None:
    found = shown(trained)
    assert found.support is not None
    assert found.support.outside > 0.2  # 60 labels by chance, 20 steps of training
    assert found.warnings[0].startswith("The verifier has left its support: ")
    (told,) = [event for event in trained.client.events(trained.project.id) if event.kind == "round.warned"]
    assert told.data == {"round": str(trained.project.current_round), "number": 1, "warnings": found.warnings}


def test_a_round_without_warnings_is_no_event(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis, "warnings", lambda *_: [])
    labeled.train()
    assert shown(labeled).warnings == []
    assert "round.warned" not in {event.kind for event in labeled.client.events(labeled.project.id)}


def test_without_held_out_labels_the_rest_is_still_there(empty: Loop) -> None:
    empty.collect(200, seed=1, split="pool")
    empty.label(20, "random")
    empty.train()
    found = shown(empty)
    assert (found.back_action, found.ranking, found.ranking_by_group) == (None, None, {})
    assert found.sampled == empty.project.counts.pool_segments - 20
    assert None not in (found.mask, found.support, found.aliasing)
    assert all(each.held_out == 0 and each.accuracy is None for each in found.actions)


def test_a_pool_that_is_labeled_to_the_last_leaves_only_the_held_out_parts(opened: OpenLoop) -> None:
    loop = opened()
    new_project(loop, environment=ROOM)
    loop.collect(40, seed=1, split="pool")
    loop.collect(3000, behavior="balanced", seed=2, split="held_out", per_action=1)
    loop.label(loop.project.counts.pool_segments, "random")
    loop.train()
    found = shown(loop)
    assert (found.sampled, found.mask, found.support, found.aliasing) == (0, None, None, None)
    assert found.ranking is not None
    assert found.ranking.segments == 7


def test_it_is_stored_once_and_a_crash_before_that_keeps_the_stages_before_it(
    labeled: Loop, undisturbed: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = start(labeled)
    calls = interrupt(monkeypatch, 1, disk_is_full, diagnosis, "diagnose")
    run_next(labeled.worker)
    crashed = labeled.client.round(asked.id)
    assert ([stage.name for stage in crashed.stages], crashed.diagnostics) == (STAGES[:-1], None)
    labeled.clock.advance(10)
    labeled.drain()
    done = labeled.client.round(asked.id)
    assert ([stage.name for stage in done.stages], done.status) == (STAGES, "current")
    assert done.model_error == crashed.model_error
    assert {kind: undisturbed[kind] for kind in done.models} == hashes(labeled, done)
    (job,) = labeled.jobs("train_round")
    labeled.requeue(job.id)
    labeled.drain()
    assert labeled.client.round(asked.id) == done
    assert len(calls) == 2
    assert len([event for event in labeled.client.events(labeled.project.id) if event.kind == "round.warned"]) == 1


def test_a_worker_that_stops_gives_the_diagnostics_up_in_the_middle(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = start(labeled)
    interrupt(monkeypatch, 1, labeled.worker.stopping.set, diagnosis, "diagnose")
    run_next(labeled.worker)
    (job,) = labeled.jobs("train_round")
    assert (job.state, job.attempts, job.error) == ("queued", 0, None)
    assert labeled.client.round(asked.id).diagnostics is None
    labeled.drain(labeled.another_worker())
    assert labeled.client.round(asked.id).diagnostics is not None


def test_equal_projects_are_diagnosed_alike(opened: OpenLoop, labeled: Loop) -> None:
    other = opened(labeled.folder)
    labeled.train()
    other.train()
    assert shown(labeled) == shown(other)


def test_places_are_drawn_once_each_and_never_a_labeled_one() -> None:
    generator = torch.Generator().manual_seed(0)
    for total, labeled, count in (
        (50, [], 7),
        (50, [0, 1, 49], 47),
        (50, [3, 9, 10], 46),
        (9, range(9), 4),
        (0, [], 3),
    ):
        places = draw_places(total, list(labeled), count, generator)
        assert len(set(places)) == len(places) == min(count, total - len(labeled))
        assert set(places) <= set(range(total)) - set(labeled)


def test_all_free_places_are_drawn_where_they_are_few() -> None:
    assert draw_places(6, [4, 1], 100, torch.Generator()) == [0, 2, 3, 5]


def test_every_free_place_is_as_likely_as_any() -> None:
    generator = torch.Generator().manual_seed(0)
    hits = torch.zeros(30)
    for _ in range(3000):
        hits[draw_places(30, [2, 17, 18], 9, generator)] += 1  # 27 free ones, 9 runs of 3
    assert hits[[2, 17, 18]].tolist() == [0, 0, 0]
    free = hits[hits > 0]
    assert len(free) == 27
    assert float((free - 1000).abs().max()) < 130  # five standard deviations of 3000 draws by 1 in 3


def test_the_sample_of_a_large_pool_is_bounded() -> None:
    places = draw_places(30_000_000, range(5, 500_000, 7), SAMPLE, torch.Generator().manual_seed(0))
    assert len(set(places)) == SAMPLE
    assert max(places) > 29_900_000
