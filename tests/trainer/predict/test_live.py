"""The page of `photonfarm live`: a drag changes the network's picture, and the truth is refined at rest."""

import base64
import io
import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chromium import Page, chromium, needs_chromium
from PIL import Image
from small_room import rendered, trained

from photonfarm.predict import open_run
from photonfarm.predict.live import TRUTHS, Live, Speed
from photonfarm.scene.groups import Fov
from photonfarm.scene.spec import Film
from photonfarm.scene.spec_loading import load_spec
from photonfarm.web.server import PageServer

AT_REST = {"place": {}, "without": [], "camera": [-1.6, 1.5, 0.4], "look_at": [0.5, 0.8, -0.2]}


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Live:
    folder = tmp_path_factory.mktemp("live")
    room = load_spec("room")
    view = room.view.model_copy(update={"fov": Fov(min=30, max=110)})
    store = rendered(room.model_copy(update={"view": view}), folder)
    run = trained(store, folder / "run", "guided_transport")
    return Live(lambda: open_run(run, store), most_spp=24)


@pytest.fixture(scope="module")
def address(shown: Live) -> Iterator[str]:
    with serving(shown) as address:
        yield address


@contextmanager
def serving(shown: Live) -> Iterator[str]:
    """The address at which it is served."""
    with PageServer(shown.routes(), "127.0.0.1", 0, writes=shown.writes()) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()
        thread.join()


def ask(
    address: str, kind: str, state: dict[str, Any] | None = None, method: str = "GET", origin: str = "", site: str = ""
) -> dict[str, Any]:
    """What the server tells of a state; where it refuses, with the `status`."""
    path = "" if state is None else "/" + base64.urlsafe_b64encode(json.dumps(state).encode()).decode().rstrip("=")
    headers = {"Origin": (origin or address).rstrip("/")} | ({"Sec-Fetch-Site": site} if site else {})
    asked = urllib.request.Request(f"{address}{kind}{path}", method=method, headers=headers)
    try:
        with urllib.request.urlopen(asked) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as refused:
        with refused:
            return json.load(refused) | {"status": refused.code}


def read_picture(told: dict[str, Any]) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(told["picture"]))))


def test_pictures_follow_the_state_and_the_truth_goes_on_from_one_request_to_the_next(
    shown: Live, address: str
) -> None:
    room = ask(address, "room")
    sofa = next(group for group in room["groups"] if group["name"] == "sofa")
    assert sofa["box"]["min"][0] <= sofa["at"][0] <= sofa["box"]["max"][0]
    moved = {**AT_REST, "place": {"sofa": sofa["box"]["min"]}, "without": ["vase"]}
    pictures = [read_picture(ask(address, "full", state)) for state in (AT_REST, moved, AT_REST)]
    assert pictures[0].shape == (16, 24, 3)
    assert not np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[0], pictures[2])
    beyond = {**AT_REST, "place": {"sofa": [0.9, 0, 3]}}
    assert [len(ask(address, kind, beyond)["warnings"]) for kind in ("frame", "full")] == [1, 2], "at rest also by rays"
    first, second = ask(address, "truth", AT_REST), ask(address, "truth", moved)
    spp = first["spp"]
    for _ in range(20):
        told = ask(address, "truth", AT_REST)
        assert told["spp"] >= spp, "it is kept while another one is shown"
        spp = told["spp"]
        if told["done"]:
            break
    assert spp == 24
    judged = next(reversed(shown._judged.values()))
    image = judged.frame.radiance.numpy(force=True)
    assert told["error"] == (truth := judged.refined.result()).describe_estimate(truth.error(image), image)
    assert second["picture"] != told["picture"]
    assert "--place sofa=" in ask(address, "command", moved)["command"]
    assert "--without vase" in ask(address, "command", moved)["command"]
    for step in range(TRUTHS + 2):
        ask(address, "truth", {**AT_REST, "camera": [-1.6, 1.5, 0.1 * step]})
    assert len(shown._judged) == TRUTHS


def test_what_is_wrong_is_said_and_nothing_can_be_written(address: str) -> None:
    wrong = ask(address, "frame", {**AT_REST, "without": ["sofaa"]})
    assert "'sofaa'" in wrong["error"]
    others = [("frame/AAAA", None), ("truth", {**AT_REST, "view": 1}), ("full", {**AT_REST, "turn": {"sofa": 30}})]
    assert [each["status"] for each in (wrong, *(ask(address, *other) for other in others))] == [400] * 4
    assert ask(address, "submit", AT_REST, method="POST")["status"] == 403
    assert ask(address, "submit", AT_REST, method="PUT")["status"] == 405


def test_what_another_site_s_page_asks_for_is_not_rendered(shown: Live, address: str) -> None:
    state = {**AT_REST, "camera": [-1.2, 1.5, 0.2]}
    for site in ("cross-site", "same-site"):  # the latter: another server of this machine
        assert ask(address, "truth", state, site=site)["status"] == 403
    assert state not in [json.loads(base64.urlsafe_b64decode(key + "==")) for key in shown._judged]
    assert "picture" in ask(address, "truth", state, site="same-origin")
    link = urllib.request.Request(address, headers={"Sec-Fetch-Site": "cross-site"})
    with urllib.request.urlopen(link) as page:
        assert page.status == 200


def test_what_is_shown_is_planned_where_that_is_allowed_and_a_page_of_the_server_asks(shown: Live) -> None:
    scene = shown.run.store.scene(shown.run.scene_id)
    before, state = len(scene.plans()), {**AT_REST, "without": ["vase"]}
    allowed = replace(shown, open=lambda: shown.run, may_submit=True)
    with serving(allowed) as address:
        assert ask(address, "submit", state, method="POST", origin="http://elsewhere:1/")["error"].startswith(
            "only a page"
        )
        assert len(scene.plans()) == before
        assert ask(address, "submit", state, method="POST")["said"] == "planned as a sample, row 4"
        assert ask(address, "submit", state, method="POST")["said"] == "planned as a sample before, row 4"
    assert len(scene.plans()) == before + 1


def test_the_fewest_samples_make_a_truth_too(shown: Live) -> None:
    with serving(replace(shown, open=lambda: shown.run, most_spp=1)) as address:
        told = ask(address, "truth", {**AT_REST, "camera": [-1.5, 1.4, 0.3]})
    assert told["done"]
    assert "95 % interval" in told["error"]


def test_viewers_take_turns_so_that_no_truth_holds_up_another_s_frames(shown: Live) -> None:
    rests, moves = {**AT_REST, "without": ["vase"]}, {**AT_REST, "without": ["sofa"]}
    with serving(replace(shown, open=lambda: shown.run, most_spp=10**6)) as address:
        alone, slices, is_over = read_picture(ask(address, "full", moves)), [], threading.Event()

        def refine() -> None:
            while not is_over.is_set():
                slices.append(ask(address, "truth", rests)["spp"])

        viewer = threading.Thread(target=refine)
        viewer.start()
        pictures = [read_picture(ask(address, "full", moves)) for _ in range(8)]
        is_over.set()
        viewer.join()
    assert 1 < len(slices) < 24, "they take turns"
    assert slices == sorted(slices)
    assert all(np.array_equal(picture, alone) for picture in pictures)


def test_images_in_motion_become_smaller_until_they_are_fluent_and_grow_again() -> None:
    speed = Speed(Film(width=256, height=192))
    for seconds, film in ((0.9, (128, 96)), (0.3, (64, 48)), (0.16, (64, 48)), (0.05, (64, 48)), (0.02, (128, 96))):
        speed.learn(seconds)
        assert (speed.film().width, speed.film().height) == film


@needs_chromium
def test_a_drag_on_the_plan_changes_the_picture_and_the_truth_follows_at_a_desks_and_a_phones_width(
    address: str,
) -> None:
    with chromium() as page:
        for width in (1280, 390):
            page.open(address, width, 1500)
            page.wait_for("document.querySelector('#error').textContent.includes('95 % interval')", 60)
            before = page.value("document.querySelector('#network').toDataURL()")
            drag(page, "sofa", 0.2)
            page.wait_for(f"document.querySelector('#network').toDataURL() !== {json.dumps(before)}")
            page.wait_for("document.querySelector('#of-truth').textContent.startsWith('truth · 24 samples')", 60)
            page.wait_for("!document.querySelector('#truth').classList.contains('old')")
            before = page.value("document.querySelector('#network').toDataURL()")
            page.value(
                "(() => { const lens = document.querySelector('input[aria-label=\"field of view\"]'); lens.value = 100;"
                "lens.dispatchEvent(new Event('input')); })()"
            )
            page.wait_for(f"document.querySelector('#network').toDataURL() !== {json.dumps(before)}")
            click(page, "Random")
            page.wait_for("document.querySelector('#truth').classList.contains('old')")
            page.wait_for("!document.querySelector('#truth').classList.contains('old')", 60)
            assert page.value("document.documentElement.scrollWidth") <= width
        assert page.errors == []


@needs_chromium
def test_what_was_never_seen_stays_said_an_old_error_is_pale_and_the_camera_is_held_in_its_box(
    shown: Live, address: str
) -> None:
    said = "document.querySelector('#{}').textContent"
    with chromium() as page:
        page.open(address, 1280)
        page.wait_for("window.live?.isDone", 60)
        assert page.value(f"{said.format('doubts')}") == ""
        pale = "window.live.set(() => {{ window.live.{} }}), getComputedStyle(document.querySelector('#error')).opacity"
        assert page.value(pale.format("place.sofa[1] += 1; window.live.fov = 99.6")) == "0.35"
        page.wait_for(f"{said.format('doubts')}.startsWith('sofa stands at')")
        assert page.value("document.querySelector('#actions output').textContent") == "100°"
        click(page, "Copy as a command")
        page.wait_for(f"{said.format('said')}.includes('--truth 24 --place sofa=')")
        page.wait_for("window.live.isDone && !document.querySelector('#error').classList.contains('old')", 60)
        assert page.value(f"{said.format('doubts')}").startswith("sofa stands at")
        assert "--place sofa=" in page.value(f"{said.format('said')}")
        with held(shown):  # until then no command is told, and it comes too late
            click(page, "Copy as a command")
            click(page, "Random")
            assert page.value(said.format("said")) == ""
        page.wait_for("window.live.isDone && !document.querySelector('#error').classList.contains('old')", 60)
        assert page.value(said.format("said")) == ""
        drag(page, "camera", -9)
        camera, box = page.value("[window.live.camera, window.live.room.camera_box]")
        assert camera[0] in (box["min"][0], box["max"][0])
        assert camera[2] in (box["min"][2], box["max"][2])
        assert page.errors == []


@needs_chromium
def test_it_is_said_that_the_page_loads_and_that_the_server_does_not_answer_until_it_does(
    shown: Live, address: str
) -> None:
    told = "['pulse', 'of-network', 'of-truth', 'failed'].map((id) => document.getElementById(id).textContent)"
    look = "getComputedStyle(document.querySelector('#network')).opacity"
    cut = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
    with chromium() as page:
        with held(shown):
            page.open(address, 1280)
            assert page.value(told) == ["loading", "network · loading", "truth · loading", ""]
        page.wait_for("window.live?.isDone", 60)
        assert "loading" not in " ".join(page.value(told))
        page.call("Network.emulateNetworkConditions", offline=True, **cut)
        page.wait_for(f"{told}[3] === 'the server does not answer'")
        assert page.value(look) == "0.35"
        before = page.value("document.querySelector('#network').toDataURL()")
        click(page, "Random")
        time.sleep(0.8)  # further requests fail
        click(page, "Copy as a command")
        page.wait_for("document.getElementById('said').textContent === 'Copy as a command: the server does not answer'")
        assert page.value(f"[{told}[3], {look}]") == ["the server does not answer", "0.35"]
        assert page.value("document.querySelector('#pulse').hidden")
        page.call("Network.emulateNetworkConditions", offline=False, **cut)
        page.wait_for(f"document.querySelector('#network').toDataURL() !== {json.dumps(before)} && !{told}[3]")
        assert page.value(look) == "1"
        assert not page.value("document.querySelector('#pulse').hidden")


@needs_chromium
def test_two_pages_see_each_their_own_configuration(address: str) -> None:
    with chromium() as one, chromium() as other:
        for page in (one, other):
            page.open(address, 800, 1500)
            page.wait_for("window.live?.isFull", 60)
            click(page, "Random")
        for page in (one, other):
            whole = "document.querySelector('#of-truth').textContent.startsWith('truth · 24 samples')"
            page.wait_for(f"{whole} && !document.querySelector('#truth').classList.contains('old')", 60)
        states = [page.value("window.live.state()") for page in (one, other)]
        assert states[0] != states[1]
        for page, state in zip((one, other), states, strict=True):
            for canvas, kind in (("network", "full"), ("truth", "truth")):
                read = "(({ width, height }, at) => [...at.getImageData(0, 0, width, height).data])"
                at = f"document.querySelector('#{canvas}')"
                pixels = np.array(page.value(f"{read}({at}, {at}.getContext('2d'))"), np.uint8).reshape(16, 24, 4)
                while not (told := ask(address, kind, state)).get("done", True):
                    pass
                np.testing.assert_array_equal(pixels[..., :3], read_picture(told))
            assert page.errors == []


@needs_chromium
def test_a_clip_shows_an_old_truth_as_pale_as_the_page(address: str) -> None:
    begin = (
        "(() => { const capture = HTMLCanvasElement.prototype.captureStream;"
        "HTMLCanvasElement.prototype.captureStream = function (...how) {"
        "window.clip = this; return capture.call(this, ...how); };"
        "[...document.querySelectorAll('button')].find((b) => b.textContent === 'Record').click(); })()"
    )
    halves = (
        "(({ width, height }, at) => [0, width / 2].map((x) => at.getImageData(x, 0, width / 2, height).data"
        ".reduce((sum, value, i) => sum + (i % 4 < 3 ? value : 0), 0)))(window.clip, window.clip.getContext('2d'))"
    )
    with chromium() as page:
        page.open(address, 800, 1500)
        page.wait_for("window.live?.isDone", 60)
        page.value(begin)
        page.wait_for(f"{halves}[1] > 0")
        network, truth = page.value(halves)
        page.value("document.querySelector('#truth').classList.add('old')")
        page.wait_for(f"{halves}[1] < {0.9 * truth}")
        time.sleep(0.2)  # further pictures of the clip, each over the one before
        assert page.value(halves) == [network, pytest.approx(0.35 * truth, rel=0.02)]


@contextmanager
def held(shown: Live) -> Iterator[None]:
    """A time in which nothing about the run is answered."""
    is_over = threading.Event()
    shown._thread.submit(is_over.wait, 30)
    try:
        yield
    finally:
        is_over.set()


def click(page: Page, button: str) -> None:
    page.value(f"[...document.querySelectorAll('button')].find((b) => b.textContent === {json.dumps(button)}).click()")


def drag(page: Page, what: str, share: float) -> None:
    """Drag a group, or the camera, by a share of its way to the middle of the plan."""
    at = "camera" if what == "camera" else f"place['{what}']"
    script = (
        "(() => { const { plan } = window.live, canvas = document.querySelector('#plan').getBoundingClientRect();"
        f"const [x, y] = plan.to(window.live.{at}).map((value) => value / plan.ratio);"
        "return [canvas.left + x, canvas.top + y, canvas.left + canvas.width / 2, canvas.top + canvas.height / 2]; })()"
    )
    x, y, middle_x, middle_y = page.value(script)
    page.press(x, y, (x + 0.05 * (middle_x - x), y), (x + share * (middle_x - x), y + share * (middle_y - y)))
