"""The commands against a running service: what they print, and what a mistake costs the user: one sentence."""

import json
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from uuid import UUID, uuid4

import numpy as np
import pytest

from api_schemas.collections import CollectionCreate
from api_schemas.rounds import Round
from asim.client import Client
from service.store.database import open_database
from service.store.tables import RoundRow
from tests.command import Command

SPACES = {
    "observations": {"grid": {"dtype": "uint8", "shape": [6, 6, 3]}, "carried": {"dtype": "uint8", "shape": [3]}},
    "actions": {"kind": "discrete", "n": 7},
}


@pytest.fixture
def asim(url: str, command: Command, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Commands that ask the running service."""
    monkeypatch.setenv("ASIM_URL", url)
    return command


def recording(path: Path, seed: int, *, labeled: bool) -> Path:
    """Twelve transitions of noise in the spaces above."""
    generator = np.random.default_rng(seed)
    arrays = {
        "grid": generator.integers(0, 2, (13, 6, 6, 3), dtype=np.uint8),
        "carried": generator.integers(0, 2, (13, 3), dtype=np.uint8),
    }
    actions = {"actions": generator.integers(0, 7, 12)} if labeled else {}
    np.savez(path, **arrays, **actions)
    return path


@pytest.fixture
def own(asim: Command, tmp_path: Path) -> str:
    """A project of the user's own environment, named after the test's folder."""
    (tmp_path / "spaces.json").write_text(json.dumps(SPACES))
    asim("project", "create", tmp_path.name, "--spaces", str(tmp_path / "spaces.json"), "--round-labels", "0")
    return tmp_path.name


def test_recordings_are_imported_once_and_labeled_ones_with_their_labels(
    asim: Command, url: str, own: str, tmp_path: Path
) -> None:
    plain = [str(recording(tmp_path / f"{seed}.npz", seed, labeled=False)) for seed in range(3)]
    labeled = str(recording(tmp_path / "labeled.npz", 9, labeled=True))
    printed = asim("import", own, *plain, labeled, "--split", "pool")
    assert printed.count(": created ") == 3
    assert "1 labeled trajectories or parts of them: 12 labels, 0 known before" in printed
    again = asim("import", own, *plain, labeled, "--split", "pool")
    assert again.count(": duplicate ") == 3
    assert "0 labels, 12 known before" in again
    counts = json.loads(asim("project", "show", own))["counts"]
    assert (counts["pool_trajectories"], counts["pool_segments"], counts["labeled"]) == (4, 48, 12)
    with Client(url) as client, np.load(labeled) as file:
        project = client.find_project(own)
        stored = {label.start: label.actions for label in client.labels(project.id)}
        assert stored == {start: [action] for start, action in enumerate(file["actions"].tolist())}


def test_a_recording_of_more_segments_than_a_request_takes_is_sent_in_several(
    asim: Command, own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asim.importing.MOST_SEGMENTS", 5)
    labeled = [str(recording(tmp_path / f"{seed}.npz", seed, labeled=True)) for seed in (1, 2)]
    printed = asim("import", own, *labeled, "--split", "pool")
    assert re.findall(r"(\d+) labels, (\d+) known", printed) == [("5", "0"), ("5", "0"), ("2", "0")] * 2
    counts = json.loads(asim("project", "show", own))["counts"]
    assert (counts["pool_trajectories"], counts["labeled"]) == (2, 24)


@pytest.mark.parametrize("labeled", [False, True])
def test_an_import_names_the_file_that_is_refused_and_says_what_is_in(
    asim: Command, own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, labeled: bool
) -> None:
    monkeypatch.setattr("asim.importing.UPLOAD_FILES", 3)
    monkeypatch.setattr("asim.importing.BATCH_FILES", 3)
    files = [recording(tmp_path / f"{seed}.npz", seed, labeled=labeled) for seed in range(20)]
    with np.load(files[7]) as whole:
        np.savez(files[7], **{**whole, "carried": whole["carried"].astype(np.int32)})
    said = asim("import", own, *map(str, files), "--split", "pool", status=1)
    assert f"{files[7]}: " in said
    assert "carried: dtype" in said
    assert said.count("\n") == 1
    told = re.search(r"(\d+) of 20 files are in", said)
    assert told is not None
    assert 7 <= int(told[1]) <= 13  # two requests that were on their way already are answered
    assert json.loads(asim("project", "show", own))["counts"]["pool_trajectories"] == int(told[1])
    recording(files[7], 7, labeled=labeled)
    asim("import", own, *map(str, files), "--split", "pool")
    assert json.loads(asim("project", "show", own))["counts"]["pool_trajectories"] == 20


def test_a_file_that_cannot_be_read_stops_an_import_once_the_others_are_told(
    asim: Command, own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asim.importing.BATCH_FILES", 2)
    files = [recording(tmp_path / f"{seed}.npz", seed, labeled=True) for seed in range(5)]
    with np.load(files[4]) as whole:
        np.savez(files[4], **{**whole, "actions": whole["actions"].astype("U1")})
    said = asim("import", own, *map(str, files), "--split", "pool", status=1)
    assert f"{files[4]}: actions have dtype <U1, not integers or floats; 4 of 5 files are in" in said


def test_a_policy_is_changed_field_by_field(asim: Command, own: str) -> None:
    policy = json.loads(asim("project", "set", own, "--strategy", "random", "--label-budget", "5"))
    assert (policy["strategy"], policy["label_budget"], policy["round_labels"]) == ("random", 5, 0)
    assert re.search(rf"{own} .* random .* 5\b", asim("project", "list"))


def test_a_robot_project_is_created_in_a_preset(asim: Command, tmp_path: Path) -> None:
    for name, words, preset in (("a", (), "small"), ("b", ("--preset", "paper"), "paper")):
        asim("project", "create", f"{tmp_path.name}-{name}", "--simulator", "robosuite", *words)
        told = json.loads(asim("project", "show", f"{tmp_path.name}-{name}"))
        assert (told["family"], told["preset"]) == ("robot", preset)
    refused = {
        ("--simulator", "minigrid", "--preset", "small"): "preset: 'small' is for the robot family",
        ("--simulator", "robosuite", "--preset", "huge"): "preset: Input should be 'small' or 'paper'",
    }
    for mistake, sentence in refused.items():
        assert sentence in asim("project", "create", "x", *mistake, status=1)


def test_mistakes_cost_one_sentence(asim: Command, own: str, tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no npz")
    mistakes = {
        ("project", "show", "nothing"): "no project is named 'nothing'",
        ("project", "create", own, "--simulator", "minigrid"): f"a project '{own}' exists already",
        (
            "project",
            "create",
            "x",
            "--simulator",
            "minigrit",
        ): "'minigrit' is not one of ['maniskill', 'minigrid', 'robosuite']",
        ("project", "create", "x", "--simulator", "minigrid", "--option", "size"): "'size' is not of the form",
        ("project", "create", "x", "--spaces", str(tmp_path / "none.json")): "No such file or directory",
        ("project", "set", own, "--strategy", "best"): "strategy: Input should be 'random'",
        ("import", own, str(tmp_path / "text.npz")): "not an npz file",
        ("acquire", own, "--strategy", "best"): "best",
        ("acquire", own, "--count", "7"): "asked for 7 segments",
        ("label", own): "names no simulator",
        ("collect", own, "--transitions", "5"): "names no simulator",
        ("round", own): "has no pool labels to train on",
        ("error", own, "nothing"): "no project is named 'nothing'",
        ("jobs", "nothing"): "no project is named 'nothing'",
        ("events", "nothing"): "no project is named 'nothing'",
        ("cancel", str(UUID(int=3))): f"there is no job '{UUID(int=3)}'",
        ("acquire", own, "--mode", "explore"): "could start from",
        ("acquire", own, "--mode", "explore", "--purpose", "held_out"): "'held_out' cannot be explored",
    }
    for arguments, sentence in mistakes.items():
        said = asim(*arguments, status=1)
        assert sentence in said, (arguments, said)
        assert said.startswith("asim: ")
        assert said.count("\n") == 1, said


def test_a_batch_that_is_smaller_says_why(asim: Command, url: str, own: str, tmp_path: Path) -> None:
    asim("import", own, str(recording(tmp_path / "one.npz", 1, labeled=False)), "--split", "pool")
    with Client(url) as client:
        client.acquire(client.find_project(own).id, 4, wait=60)
    said = asim("acquire", own, "--count", "30", stderr=True)
    assert "a smaller batch: 30 were asked for, 8 are left in the pool split" in said


def test_states_to_explore_from_come_with_the_actions_to_execute(asim: Command, own: str, tmp_path: Path) -> None:
    asim("import", own, str(recording(tmp_path / "one.npz", 2, labeled=False)), "--split", "pool")
    printed = asim("acquire", own, "--mode", "explore", "--count", "5")
    assert len(re.findall(r"^\d +[0-9a-f]{64} +\d+ +1 +\[[0-6]\] *$", printed, re.MULTILINE)) == 5
    assert "5 states to explore from by random" in printed
    items = json.loads(asim("acquire", own, "--mode", "explore", "--count", "5", "--json"))["items"]
    assert [len(item["actions"]) for item in items] == [1] * 5


def test_jobs_are_listed_and_cancelled_and_events_say_who_did_what(asim: Command, url: str) -> None:
    name = f"cancel-{uuid4().hex[:8]}"
    asim("project", "create", name, "--simulator", "minigrid")
    with Client(url) as client:
        project = client.find_project(name).id
        job = client.collect(CollectionCreate(project=project, transitions=10_000_000)).id
    assert f"job {job} (collect) is cancelled" in asim("cancel", str(job))
    assert f"job {job} (collect) is cancelled" in asim("cancel", str(job))
    row = next(line for line in asim("jobs", name).splitlines() if line.startswith(str(job)))
    assert re.search(r"collect +cancelled +[01] of \d +\d+%", row)
    (as_json,) = map(json.loads, asim("jobs", name, "--json").splitlines())
    assert (as_json["id"], as_json["state"]) == (str(job), "cancelled")
    lines = asim("events", name).splitlines()
    moment, told_of = lines[0].split("Z ", 1)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", moment)
    assert told_of == f'local project.created {{"name": "{name}"}}'
    assert any(" local job.cancelled " in line for line in lines)
    told = [json.loads(line) for line in asim("events", name, "--json").splitlines()]
    assert [event["kind"] for event in told] == [line.split()[3] for line in lines]
    assert told[0]["correlation"]


def test_followed_events_arrive_as_they_happen_until_ctrl_c(asim: Command, url: str, own: str) -> None:
    argv = [sys.executable, "-m", "asim", "events", own, "--follow", "--url", url]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as following:
        watchdog = threading.Timer(90, following.kill)
        watchdog.start()
        try:
            assert following.stdout is not None
            assert " project.created " in following.stdout.readline()
            asim("project", "set", own, "--round-labels", "7")
            assert following.stdout.readline().endswith(' project.changed {"round_labels": 7}\n')
            following.send_signal(signal.SIGINT)
            assert following.wait(timeout=45) == 0
        finally:
            watchdog.cancel()
            following.kill()


def test_where_nothing_listens_the_url_is_named(asim: Command) -> None:
    said = asim("project", "list", "--url", "http://127.0.0.1:9", status=1)
    assert said.startswith("asim: no answer from http://127.0.0.1:9 to GET /projects")


def test_the_error_of_a_project_without_rounds_is_an_empty_table(asim: Command, own: str, tmp_path: Path) -> None:
    picture = tmp_path / "curve.png"
    assert "test loss" in asim("error", own, "--plot", str(picture))
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert json.loads(asim("error", own, "--json"))["points"] == []


def test_what_a_rounds_diagnostics_warn_of_is_said_below_its_error(
    asim: Command, own: str, served_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = open_database(f"sqlite:///{served_folder / 'asim.db'}")
    parts = dict.fromkeys(("mask", "support", "aliasing", "back_action", "back_action_in_support", "ranking"))

    def at_once(client: Client, round_id: UUID, _: object) -> Round:
        """In the place of training: the round as it may end."""
        job = client.round(round_id).job
        assert job is not None
        client.cancel_job(job)
        with database.write() as session:
            row = session.get_one(RoundRow, round_id)
            row.diagnostics = {**parts, "sampled": 9, "actions": [], "warnings": ["The score does not rank."]}
            row.status = "current"
        return client.round(round_id)

    monkeypatch.setattr("asim.rounds.await_round", at_once)
    asim("import", own, str(recording(tmp_path / "labeled.npz", 4, labeled=True)), "--split", "pool")
    sentence = f"warning: {own}, round 1: The score does not rank.\n"
    assert asim("round", own, stderr=True).endswith(sentence)
    assert asim("error", own, stderr=True).endswith(sentence)
    assert sentence not in asim("error", own, "--json")
    database.close()
