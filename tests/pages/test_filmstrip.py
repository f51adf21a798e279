"""The newest recording of a project with cameras is shown as a filmstrip: frames of the service, drawn by the page."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page, expect

from tests.pages.canned_api import CannedApi
from tests.pages.conftest import Site

PIXELS = "canvas => [...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data]"


def recording(seed: int, transitions: int = 30) -> dict[str, NDArray[Any]]:
    """Two cameras of different sizes, and numbers."""
    rng, rows = np.random.default_rng(seed), transitions + 1
    return {
        "wrist": rng.integers(0, 256, (rows, 16, 24, 3), np.uint8),
        "front": rng.integers(0, 256, (rows, 64, 64, 3), np.uint8),
        "proprioception": rng.normal(size=(rows, 9)).astype(np.float32),
    }


def test_eight_frames_of_each_camera_are_drawn_pixel_for_pixel(api: CannedApi, site: Site, page: Page) -> None:
    project, arrays = api.add_project("arm"), recording(1)
    name = api.add_recording(project, arrays)
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#strip canvas")).to_have_count(16)
    expect(page.locator("#recording-id")).to_have_text(name[:12])
    labels = page.locator("#strip .strip-row").first.locator("figcaption").all_text_contents()
    assert labels == [f"front {step}" for step in (0, 4, 9, 13, 17, 21, 26, 30)]
    for camera, step in (("front", 0), ("front", 13), ("wrist", 30)):
        canvas = page.get_by_role("img", name=f"{camera}, step {step}", exact=True)
        drawn = np.array(canvas.evaluate(PIXELS), np.uint8).reshape(*arrays[camera].shape[1:3], 4)
        assert np.array_equal(drawn[..., :3], arrays[camera][step])
        assert (drawn[..., 3] == 255).all()


def test_a_strip_is_asked_for_once(api: CannedApi, site: Site, page: Page) -> None:
    api.add_recording(api.add_project("arm"), recording(1))
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#strip canvas")).to_have_count(16)
    page.wait_for_timeout(700)  # three polls
    assert sum(path.endswith("/content") for path in api.requests) == 8


def test_a_project_without_cameras_or_recordings_has_no_strip(api: CannedApi, site: Site, page: Page) -> None:
    grid = {"grid": np.zeros((5, 6, 6, 3), np.uint8)}
    api.add_recording(api.add_project("rooms", labeled=10), grid)
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#project-name")).to_have_text("rooms")
    expect(page.locator("#recording")).to_be_hidden()
    assert not any(path.endswith("/content") for path in api.requests)


def test_a_recording_that_is_lost_leaves_the_page_as_it_is(api: CannedApi, site: Site, page: Page) -> None:
    site.expected.append("404")
    project = api.add_project("arm", labeled=300)
    api.add_round(project, 2.5)
    api.add_event(project, "trajectory.added", {"trajectory": "../none", "split": "pool"})
    page.goto(f"{site.address}/dashboard")
    expect(page.locator("#chart-loss .plot .point")).to_have_count(1)
    expect(page.locator("#recording")).to_be_hidden()
