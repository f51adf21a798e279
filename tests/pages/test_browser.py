"""The page in a real browser, over canned answers."""

import time
from collections.abc import Callable
from uuid import uuid4

from playwright.sync_api import Page, expect

from api_schemas.rounds import OpenLoopError
from tests.pages.canned_api import CannedApi, serving
from tests.pages.conftest import Site

HOSTILE = "<img src=x onerror=alert(1)>"


def wait_for(condition: Callable[[], bool]) -> None:
    """Let the page run until the condition holds, for 5 s at most."""
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_the_page_shows_projects_labels_and_the_learning_curve(api: CannedApi, site: Site, page: Page) -> None:
    first = api.add_project("kitchen cycle", labeled=300)
    api.add_project("kitchen random", labeled=100)
    for loss in (3.2, 1.9, 1.4):
        api.add_round(first, loss)
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#projects .name")).to_have_text(["kitchen cycle", "kitchen random"])
    expect(page.locator("#project-name")).to_have_text("kitchen cycle")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(3)
    expect(page.locator("#chart-accuracy .plot .point")).to_have_count(9)  # overall, movement, interaction
    expect(page.locator("#round .big")).to_have_text("3 current")
    expect(page.locator("#labels .big")).to_have_text("300 of 500 spent")
    expect(page.get_by_role("img", name="Pool: 300 labeled, 20 leased, 3,680 unlabeled")).to_be_visible()
    expect(page.locator("#rounds tbody tr").first).to_contain_text("1.4")
    assert str(first) in page.url  # the choice is kept in the address


def test_the_current_round_is_known_by_the_project_and_a_round_at_work_shows_its_job(
    api: CannedApi, site: Site, page: Page
) -> None:
    project = api.add_project("arm", labeled=200)
    api.add_round(project, 2.5)
    working = api.add_round(project, None, status="training")
    job = api.add_job(project, "train_round", "running", 0.42, "world_model step 420 of 1000")
    api.jobs = [job.model_copy(update={"id": working.job})]
    api.add_job(project, "collect", "failed", 0.1, error="options: room_size 7 is not 6 or 8")
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#round .big")).to_have_text("1 current")
    expect(page.locator("#round .working")).to_contain_text("Round 2 training")
    expect(page.locator("#round progress")).to_have_js_property("value", 0.42)
    expect(page.locator(".job").first).to_contain_text("options: room_size 7 is not 6 or 8")
    expect(page.locator(".job").last).to_contain_text("attempt 1 of 5 · world_model step 420 of 1000")


def test_a_new_round_appears_without_a_reload_and_unchanged_curves_come_as_304(
    api: CannedApi, site: Site, page: Page
) -> None:
    project = api.add_project("arm", labeled=100)
    api.add_round(project, 2.5)
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(1)
    page.evaluate("window.untouched = true")
    wait_for(lambda: api.not_modified > 0)
    api.add_round(project, 1.7)
    expect(page.locator("#chart-loss .plot .point")).to_have_count(2)
    expect(page.locator("#round .big")).to_have_text("2 current")
    assert page.evaluate("window.untouched") is True


def test_what_users_typed_shows_as_text(api: CannedApi, site: Site, page: Page) -> None:
    project = api.add_project(HOSTILE, labeled=100)
    api.add_round(project, 2.5)
    api.add_job(project, "collect", "running", 0.5, HOSTILE, error=HOSTILE)
    api.add_event(project, "labels_accepted", {"source": HOSTILE, "created": 3})
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#project-name")).to_have_text(HOSTILE)
    expect(page.locator("#projects .name")).to_have_text(HOSTILE)
    expect(page.locator(".job .error")).to_have_text(HOSTILE)
    expect(page.locator(".event .hint").last).to_have_text(f"source {HOSTILE}, created 3")
    assert page.locator("img").count() == 0


def test_the_newest_of_many_events_are_shown_and_new_ones_join_them(api: CannedApi, site: Site, page: Page) -> None:
    project = api.add_project("arm")
    for number in range(1205):  # more than one page
        api.add_event(project, "labels_accepted", {"number": number})
    page.goto(f"{site.address}/dashboard")
    expect(page.locator(".event > .hint").first).to_have_text("number 1204")
    expect(page.locator(".event")).to_have_count(30)
    for number in range(1205, 1280):
        api.add_event(project, "labels_accepted", {"number": number})
    expect(page.locator(".event > .hint").first).to_have_text("number 1279")
    expect(page.locator(".event > .hint").last).to_have_text("number 1250")


def test_cancelled_work_is_shown_as_such_and_events_name_who_did_it(api: CannedApi, site: Site, page: Page) -> None:
    project = api.add_project("arm", labeled=200)
    api.add_round(project, 2.5)
    stopped = api.add_round(project, None, status="cancelled")
    job = api.add_job(project, "train_round", "cancelled", 0.3, "world_model step 300 of 1000")
    api.jobs = [job.model_copy(update={"id": stopped.job})]
    api.add_event(project, "job.cancelled", {"kind": "train_round"}, actor=f"key 7 {HOSTILE}")
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#round .big")).to_have_text("1 current")
    expect(page.locator("#round .working")).to_contain_text("Round 2 cancelled")
    expect(page.locator("#round progress")).to_have_count(0)
    expect(page.locator("#rounds tbody tr").first).to_contain_text("cancelled")
    expect(page.locator(".job .badge")).to_have_text("cancelled")
    expect(page.locator(".job progress")).to_have_count(0)
    expect(page.locator(".event .name")).to_have_text("job cancelled")
    expect(page.locator(".event .actor")).to_have_text(f"by key 7 {HOSTILE}")


def test_a_project_without_a_model_family_says_that_it_trains_nothing(api: CannedApi, site: Site, page: Page) -> None:
    project = api.add_project("own robot", labeled=20)
    api.update_project(project, family=None)
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#project-about")).to_contain_text("no model family")
    for place in ("#round", "#curve-empty", "#rounds"):
        expect(page.locator(place)).to_contain_text("No model family takes this project's spaces")
    expect(page.locator("#labels .big")).to_have_text("20 of 500 spent")


def test_what_the_current_rounds_diagnostics_warn_of_stands_beside_it(api: CannedApi, site: Site, page: Page) -> None:
    project = api.add_project("arm", labeled=200)
    left = "The verifier has left its support: 41 % of the pool's segments show it something that no label shows."
    knows_too_little = f"The inverse model knows too little of {HOSTILE}: 3 labels, 40 % right on held-out segments."
    api.add_round(project, 2.5, warnings=["long gone"])
    api.add_round(project, 2.0, warnings=[left, knows_too_little])
    page.goto(f"{site.address}/dashboard")
    expect(page.get_by_role("list", name="Warnings of round 2").get_by_role("listitem")).to_have_text(
        [left, knows_too_little]
    )
    assert page.locator("img").count() == 0
    api.add_round(project, 1.5, warnings=[])
    expect(page.locator("#round .big")).to_have_text("3 current")
    expect(page.locator("#round .warnings")).to_have_count(0)


def test_a_second_project_is_overlaid_and_the_address_keeps_it(api: CannedApi, site: Site, page: Page) -> None:
    chosen, other = api.add_project("cycle", labeled=200), api.add_project("random", labeled=100)
    for project, losses in ((chosen, (2.0, 1.2)), (other, (2.6, 2.2, 2.0))):
        for loss in losses:
            api.add_round(project, loss)
    page.goto(f"{site.address}/dashboard#project={chosen}")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(2)
    page.get_by_label("random").check()
    expect(page.locator("#chart-loss .plot .point")).to_have_count(5)
    page.get_by_label("interaction").uncheck()
    expect(page.locator("#chart-accuracy .plot .point")).to_have_count(10)
    page.reload()
    expect(page.locator("#chart-loss .plot .point")).to_have_count(5)
    page.get_by_role("link", name="random").click()
    expect(page.locator("#project-name")).to_have_text("random")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(3)


def open_loop(share: float) -> list[OpenLoopError]:
    """At two horizons; of what standing still errs by, this share."""
    still = {"front": 0.02, "proprioception": 0.005}
    return [
        OpenLoopError(
            horizon=horizon,
            errors={name: share * part * each for name, each in still.items()},
            standing_still={name: part * each for name, each in still.items()},
        )
        for horizon, part in ((8, 0.5), (16, 1.0))
    ]


def test_a_robots_loss_is_a_share_and_its_rounds_tell_their_open_loop_errors(
    api: CannedApi, site: Site, page: Page
) -> None:
    project, grid = api.add_project("lift", labeled=200), api.add_project("rooms", labeled=100)
    api.update_project(project, family="robot")
    for share in (0.75, 0.5):
        api.add_round(project, share, open_loop=open_loop(share))
    api.add_round(grid, 2.5)
    page.goto(f"{site.address}/dashboard#project={project}&compare={grid}")
    expect(page.locator("#loss-unit")).to_have_text("share of what changes that is not foreseen, lower is better")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(2)  # nats do not stand on an axis of shares
    expect(page.locator("#curve-empty")).to_have_text("The loss of rooms is of another kind.")
    expect(page.locator("#chart-loss .tick").filter(has_text="%")).not_to_have_count(0)
    expect(page.locator("#error tbody tr").first).to_have_text("overall50.0 %95.0 %93.0 %")
    newest = page.locator("#error").get_by_role("region", name="Open-loop errors of round 2")
    expect(newest.locator("tbody tr")).to_have_text(
        [
            "front, 8 steps0.005000.0100",
            "proprioception, 8 steps0.001250.00250",
            "front, 16 steps0.01000.0200",
            "proprioception, 16 steps0.002500.00500",
        ]
    )
    first = page.locator("#rounds [aria-label='Open-loop errors of round 1']")
    expect(first).to_be_hidden()
    page.locator("#rounds summary").last.click()
    expect(first.locator("tbody tr").last).to_have_text("proprioception, 16 steps0.003750.00500")
    api.add_round(project, 0.25, open_loop=open_loop(0.25))
    expect(page.locator("#rounds summary")).to_have_count(3)
    expect(first).to_be_visible()  # what was unfolded stays so
    page.get_by_role("link", name="rooms").click()
    expect(page.locator("#loss-unit")).to_have_text("nats a transition, lower is better")
    expect(page.locator("#rounds summary")).to_have_count(0)


def test_an_empty_service_and_an_empty_project_say_what_to_do_next(api: CannedApi, site: Site, page: Page) -> None:
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#notice")).to_contain_text("POST /projects")
    project = api.add_project("new", held_out_labeled=0, pool=0)
    expect(page.locator("#curve-empty")).to_have_text("No model error yet: upload held-out labels, then start a round.")
    expect(page.locator("#labels")).to_contain_text("The pool is empty. Upload trajectories with POST /trajectories")
    expect(page.locator("#jobs")).to_contain_text("No jobs yet")
    counts = api.projects[0].counts.model_copy(update={"held_out_labeled": 30})
    api.update_project(project, counts=counts)
    expect(page.locator("#curve-empty")).to_contain_text("label segments of the pool, then start a round")
    api.update_project(project, counts=counts.model_copy(update={"labeled": 5}))
    expect(page.locator("#curve-empty")).to_contain_text("start a round, or add labels")


def test_an_unknown_project_in_the_address_is_explained(api: CannedApi, site: Site, page: Page) -> None:
    site.expected.append("404")
    api.add_project("arm")
    page.goto(f"{site.address}/dashboard#project={uuid4()}")
    expect(page.locator("#notice")).to_contain_text("there is no project")
    page.get_by_role("link", name="arm").click()
    expect(page.locator("#project-name")).to_have_text("arm")


def test_a_banner_tells_that_the_service_is_away_and_goes_when_it_is_back(
    api: CannedApi, page: Page, site: Site
) -> None:
    site.expected.append("net::ERR_")
    with serving(site.app) as port:
        project = api.add_project("arm", labeled=100)
        api.add_round(project, 2.5)
        page.goto(f"http://127.0.0.1:{port}/dashboard")
        expect(page.locator("#connection")).to_have_text("live")
        expect(page.locator("#banner")).to_be_hidden()
    expect(page.locator("#banner")).to_contain_text("Service not reachable, retrying")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(1)  # the last answer stays
    with serving(site.app, port):
        expect(page.locator("#banner")).to_be_hidden()
        expect(page.locator("#connection")).to_have_text("live")


def test_a_service_that_asks_for_a_key_gets_the_one_that_was_typed(api: CannedApi, site: Site, page: Page) -> None:
    api.add_project("arm")
    site.expected.append("401")
    api.key = "secret-1"
    page.goto(f"{site.address}/dashboard")
    page.get_by_label("API key").fill("secret-1")
    page.get_by_role("button", name="Use key").click()
    expect(page.locator("#project-name")).to_have_text("arm")
    expect(page.locator("#key-form")).to_be_hidden()
    assert "secret-1" not in page.url


def test_a_hidden_tab_asks_nothing(api: CannedApi, site: Site, page: Page) -> None:
    api.add_project("arm")
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#connection")).to_have_text("live")
    look = "hidden => {Object.defineProperty(document, 'hidden', {value: hidden, configurable: true});"
    look += " document.dispatchEvent(new Event('visibilitychange'))}"
    page.evaluate(look, True)
    expect(page.locator("#connection")).to_have_text("paused")
    page.wait_for_timeout(100)  # what was under way has arrived
    asked = len(api.requests)
    page.wait_for_timeout(700)
    assert len(api.requests) == asked
    page.evaluate(look, False)
    wait_for(lambda: len(api.requests) > asked)


def test_the_keyboard_reaches_the_projects_and_reads_the_curve(api: CannedApi, site: Site, page: Page) -> None:
    project = api.add_project("arm", labeled=200)
    api.add_round(project, 2.5)
    api.add_round(project, 1.25)
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(2)
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")  # the skip link leads into the project and leaves the choice alone
    assert page.evaluate("document.activeElement.id") == "main"
    assert str(project) in page.url
    page.locator("#chart-loss svg[tabindex]").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    expect(page.locator("#chart-loss .readout")).to_have_text("1.25 arm200 labels, round 2")


def test_the_page_fits_a_phone(api: CannedApi, site: Site, page: Page) -> None:
    project = api.add_project("a-name-with-no-space-" + "x" * 59, labeled=200)
    api.add_round(project, 2.5)
    api.add_job(project, "train_round", "failed", 0.4, "m" * 90, error="e" * 200)
    api.add_event(project, "labels_accepted", {"note": "n" * 300}, actor="worker " + "w" * 150)
    page.set_viewport_size({"width": 360, "height": 740})
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(1)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
