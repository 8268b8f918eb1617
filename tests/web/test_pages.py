"""The pages that `photonfarm web` serves: what they say, what they refuse, and how they look in a browser."""

import http.client
import io
import json
import re
import shlex
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
from chromium import chromium, needs_chromium
from PIL import Image, PngImagePlugin

from photonfarm.core import pictures
from photonfarm.farm.watch import FarmWatch
from photonfarm.plan.request import Request
from photonfarm.plan.sample_costs import relative_variance
from photonfarm.scene.modification import rebuild
from photonfarm.store import SceneStore, Store
from photonfarm.web import images
from photonfarm.web.farm_pages import FarmPages, SceneSamples
from photonfarm.web.images import POINT, Cached
from photonfarm.web.server import PageServer, listen, make_page_routes

EVIL = "<img src=x onerror=alert(1)>"
"""A name that a page must show as it is."""


def made(store: Store) -> SceneStore:
    """A scene of four jobs, of which three are committed; its halves differ."""
    spec = samples.small_spec(film={"width": 16, "height": 8}, exposure=0.7)
    found = store.scene(store.plan(spec, Request(modifications=4, views_per_modification=2), shard_rows=2).scene_id)
    geometry, cloud = samples.base()
    spread = np.random.default_rng(0).uniform(size=(spec.points, 3)).astype(np.float32)
    group, face = np.full(spec.points, -1, np.int16), np.zeros(spec.points, np.uint32)
    whole = replace(cloud, position=spread, normal=-spread, albedo=spread, emission=0 * spread, group=group, face=face)
    found.write_base(geometry, whole)
    for job in range(3):
        given = samples.outputs(found, job)
        noisy = {row: np.stack([half, np.roll(half, 1)]) for row, (half, _) in given.radiance.items()}
        samples.commit(found, job, replace(given, radiance=noisy))
    return found


def trained(scene: SceneStore, folder: Path) -> Path:
    """The folder of a training run, with pictures of two validations."""
    (folder / "views").mkdir(parents=True)
    records = [
        {
            "kind": "validation",
            "step": step,
            "error": 1 / (step + 1),
            "standard_error": 0.1 / (step + 1),
            "held_out": held_out,
            "samples": 6,
            "seconds": {"train": float(step)},
        }
        for step, held_out in ((0, 1), (50, 2), (100, 2))
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    (folder / "settings.json").write_text('{"max_steps": 200, "validate_every": 100}')
    about = PngImagePlugin.PngInfo()
    about.add_text("scene", scene.scene_id)
    about.add_text("rows", "0 1")
    for step in (50, 100):
        Image.new("RGB", (32, 8), (step, 90, 20)).save(folder / "views" / f"step-{step:08d}.png", pnginfo=about)
    return folder


@contextmanager
def served(store: Store, runs: list[Path]) -> Iterator[PageServer]:
    watch = FarmWatch(store, "unix:///none", runs)
    with PageServer(make_page_routes(FarmPages(store.root, watch)), "127.0.0.1", 0) as serving:
        thread = threading.Thread(target=serving.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield serving
        finally:
            serving.shutdown()
            thread.join()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneStore:
    return made(Store(tmp_path_factory.mktemp("store"), create=True))


@pytest.fixture(scope="module")
def run(scene: SceneStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(scene, tmp_path_factory.mktemp("runs") / f"run {EVIL}")


@pytest.fixture(scope="module")
def server(scene: SceneStore, run: Path) -> Iterator[PageServer]:
    """The pages of a store that no test changes."""
    with served(Store(scene.folder.parent.parent), [run]) as serving:
        yield serving


def asked(server: PageServer, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=20)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, dict(answer.headers), content


def document(server: PageServer, path: str) -> Any:
    status, headers, content = asked(server, path)
    assert (status, headers["Content-Type"]) == (200, "application/json")
    return json.loads(content)


def picture(server: PageServer, path: str) -> np.ndarray:
    status, _, content = asked(server, path)
    assert status == 200
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


# ------------------------------------------------------------------------------------------------------ what they say


def test_the_state_is_that_of_store_and_run(server: PageServer, scene: SceneStore, run: Path) -> None:
    found = document(server, "/api/state")
    (shown,) = found["scenes"]
    assert (shown["scene_id"], shown["samples"], shown["missing"]) == (scene.scene_id, [6, 8], 2)
    assert (shown["jobs_committed"], shown["jobs_planned"]) == (3, 4)
    assert found["queue"].startswith("no Redis at")
    assert found["failed_before"] == []
    (training,) = found["trainings"]
    assert (training["run"], training["step"], training["steps"]) == (run.name, 100, 200)


def test_the_wall_has_what_landed_last_and_the_maps_where_it_was_seen_from(
    server: PageServer, scene: SceneStore
) -> None:
    found = document(server, f"/api/wall/{scene.scene_id}")
    assert found["rows"] == [5, 4, 3, 2, 1, 0]
    assert found["map"]["axes"] == ["x", "z"]
    reader = samples.reader_of(scene)
    by_row = {row: (x, z, noise, cost) for row, x, z, noise, cost in found["map"]["samples"]}
    assert sorted(by_row) == list(range(6))
    view, halves = reader.read(3).view, reader.read(3).radiance
    assert by_row[3][:2] == pytest.approx((view.origin[0], view.origin[2]))
    assert by_row[3][2] == pytest.approx(np.sqrt(relative_variance(halves[0], halves[1], 1.0) or 0))
    assert by_row[3][3] == samples.FIGURES.core_s / 2


def test_pictures_are_the_stored_images_at_the_specs_exposure(server: PageServer, scene: SceneStore) -> None:
    sample, base = samples.reader_of(scene).read(4), f"/sample/{scene.scene_id}/4"
    for name, radiance in (("a", sample.radiance[0]), ("b", sample.radiance[1]), ("mean", sample.radiance.mean(0))):
        assert np.array_equal(picture(server, f"{base}/{name}.png"), pictures.display(radiance, 0.7)), name
    assert np.array_equal(picture(server, f"{base}/albedo.png"), pictures.draw_albedo(sample.buffers.albedo))
    assert np.array_equal(picture(server, f"{base}/normal.png"), pictures.draw_normal(sample.buffers.normal))
    assert np.array_equal(picture(server, f"{base}/noise.png"), images.draw_noise(sample.radiance))
    assert picture(server, f"{base}/thumbnail.jpg").shape == (8, 16, 3)


def test_the_reference_is_the_mean_of_all_passes(store: Store, tmp_path: Path) -> None:
    spec = samples.small_spec()
    scene = store.scene(store.plan(spec, Request(modifications=1, passes=3), shard_rows=4).scene_id)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    pages = FarmPages(store.root, FarmWatch(store, f"unix://{tmp_path}/none"))
    reader = samples.reader_of(scene)
    mean = np.mean([reader.read(row).radiance.mean(0) for row in range(3)], axis=0, dtype=np.float64)
    content = pages.samples(scene.scene_id).picture(1, "reference")
    shown = np.asarray(Image.open(io.BytesIO(content)))
    assert np.array_equal(shown, pictures.display(mean.astype(np.float32), spec.exposure))
    assert pages.about(scene.scene_id, 1)["passes"] == 3


def test_points_and_photons_are_those_of_the_sample(server: PageServer, scene: SceneStore) -> None:
    sample, base = samples.reader_of(scene).read(2), f"/sample/{scene.scene_id}/2"
    points = np.frombuffer(asked(server, f"{base}/points")[2], POINT)
    position, present = rebuild(scene.base()[1], sample.modification)
    assert np.array_equal(points["position"], position[present])
    assert np.array_equal(points["seen"].astype(bool), sample.visibility.points[present])
    photons = samples.reader_of(scene).read_photons(2)
    found = np.frombuffer(asked(server, f"{base}/photons")[2], POINT)
    assert np.array_equal(found["position"], photons.position[photons.bounce >= 0])


def test_curves_and_predictions_are_those_of_the_run(server: PageServer, scene: SceneStore) -> None:
    (found,) = document(server, "/api/curves")
    assert [point[:3] for point in found["validations"]] == [[0, 0.0, 1.0], [50, 50.0, 1 / 51], [100, 100.0, 1 / 101]]
    assert [point[5] for point in found["validations"]] == [1, 2, 2]
    assert (found["steps"], found["rows"], found["scene_id"]) == ([50, 100], [0, 1], scene.scene_id)
    assert picture(server, "/run/0/50.png")[0, 0].tolist() == [50, 90, 20]


def test_a_sample_costs_its_share_of_its_job_also_where_that_is_not_full(store: Store) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=3), shard_rows=2).scene_id)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    pages = FarmPages(store.root, FarmWatch(store, "unix:///none"))
    costs = [pages.about(scene.scene_id, row)["core_s"] for row in range(3)]
    assert costs == [samples.FIGURES.core_s / 2, samples.FIGURES.core_s / 2, samples.FIGURES.core_s]


def test_a_sample_that_lands_is_seen_and_one_that_a_repair_takes_is_gone(store: Store) -> None:
    scene = made(store)
    wall = SceneSamples(store.root, scene.scene_id)
    assert wall.look() == [5, 4, 3, 2, 1, 0]
    samples.commit(scene, 3, samples.outputs(scene, 3))
    assert wall.look()[:2] == [7, 6]
    (scene.folder / "committed" / f"{0:012d}.json").unlink()
    assert not {0, 1} & set(wall.look())


# ----------------------------------------------------------------------------------------------------- what they refuse


@pytest.mark.parametrize(
    "path",
    [
        "/../pyproject.toml",
        "/server.py",
        "/%00",
        f"/sample/{'ab' * 16}/0/a.png",
        "/sample/SCENE/0/radiance.png",
        "/sample/SCENE/0/__class__.png",
        "/run/7/50.png",
        "/run/0/51.png",
        "/api/wall/xyz",
        f"/api/sample/{'0' * 32}/1",
        "/" + "a" * 5000,
        "/api/state/",
    ],
)
def test_there_is_nothing_besides_the_pages(server: PageServer, scene: SceneStore, path: str) -> None:
    status, headers, content = asked(server, path.replace("SCENE", scene.scene_id))
    assert status == 404
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "root:" not in content.decode()


@pytest.mark.parametrize("row", ["6", "99999999999", "-1"])
def test_a_row_that_is_not_complete_is_not_there(server: PageServer, scene: SceneStore, row: str) -> None:
    assert asked(server, f"/sample/{scene.scene_id}/{row}/thumbnail.jpg")[0] == 404
    assert asked(server, f"/api/sample/{scene.scene_id}/{row}")[0] == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "NONSENSE"])
def test_nothing_can_be_written(server: PageServer, method: str) -> None:
    status, headers, content = asked(server, "/api/state", method)
    assert (status, headers["Allow"], headers["Content-Type"]) == (405, "GET, HEAD", "application/json")
    assert method in json.loads(content)["error"]


def test_what_a_page_of_elsewhere_posts_is_no_further_request(server: PageServer) -> None:
    """A body is text of that page's choice, with any headers; browsers send it on a connection that is kept."""
    inside = b"GET /api/state HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.server_address[1])) as connection:
        head = f"POST /api/state HTTP/1.1\r\nHost: evil.example\r\nContent-Length: {len(inside)}\r\n\r\n"
        connection.sendall(head.encode() + inside)
        with connection.makefile("rb") as answers:
            answer = answers.read()
    assert answer.startswith(b"HTTP/1.1 405 ")
    assert answer.count(b"HTTP/1.1 ") == 1


def test_where_the_usual_port_is_taken_a_free_one_is_used_and_that_is_said() -> None:
    said: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as taken:
        usual = taken.getsockname()[1]
        with listen("127.0.0.1", None, (), usual=usual, warn=said.append) as other:
            assert other.server_address[1] != usual
    assert [str(usual) in sentence for sentence in said] == [True]


def test_a_name_of_elsewhere_is_refused(server: PageServer) -> None:
    port = server.server_address[1]
    for name in ("evil.example", f"evil.example:{port}", "", "localhost.evil.example", "127.0.0.1@evil.example"):
        assert asked(server, "/api/state", Host=name)[0] == 403, name
    for name in ("localhost", f"LOCALHOST:{port}", f"[::1]:{port}"):
        assert asked(server, "/api/state", Host=name)[0] == 200, name


def test_damaged_bytes_are_said_to_be_damaged(store: Store) -> None:
    scene = made(store)
    (shard,) = scene.folder.glob("plans/*/radiance/c.1.*")
    shard.write_bytes(b"\x00" * shard.stat().st_size)
    with served(store, []) as serving:
        status, _, content = asked(serving, f"/sample/{scene.scene_id}/2/thumbnail.jpg")
    assert status == 503
    assert "radiance" in json.loads(content)["error"]


def test_everything_comes_from_this_server() -> None:
    static = Path(images.__file__).parent / "static"
    for file in static.iterdir():
        text = file.read_text().replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"https?://|//cdn|innerHTML|outerHTML|insertAdjacentHTML|eval\(", text), file.name


def test_looks_take_at_most_their_share_of_a_core() -> None:
    now, worked, made = [0.0], [0.0], [0]

    def make() -> int:
        now[0] += 8.0  # it mostly waits
        worked[0] += 3.0
        made[0] += 1
        return made[0]

    kept = Cached(make, clock=lambda: now[0], work=lambda: worked[0])
    assert [kept.get(), kept.get()] == [1, 1]
    now[0] = 307.0
    assert kept.get() == 1
    now[0] = 308.0
    assert kept.get() == 2


# -------------------------------------------------------------------------------------------------------- in a browser


@needs_chromium
def test_a_browser_shows_the_farm_and_a_sample_without_errors_at_a_desks_and_a_phones_width(
    server: PageServer, scene: SceneStore, run: Path
) -> None:
    address = f"http://127.0.0.1:{server.server_address[1]}/"
    with chromium() as page:
        for width in (1280, 390):
            page.open(address, width)
            pictures_there = "[...document.images].every((image) => image.complete && image.naturalWidth > 0)"
            page.wait_for("document.querySelectorAll('.wall img').length === 6")
            page.wait_for(pictures_there)
            assert page.value("document.querySelectorAll('svg.plot circle').length") >= 12
            said = page.value("document.body.innerText")
            assert f"{run.name}: 0.00990 at step 100, on 2 held-out views" in said
            assert "one every 100 steps; hollow ones were measured on fewer held-out views" in " ".join(said.split())
            told = "[...document.querySelectorAll('circle.hollow')].map((point) => point.textContent)"
            assert page.value(told) == 2 * ["step 0: 1.00000 on 1 held-out view"], "by steps and by seconds"
            assert page.value("document.documentElement.scrollWidth") <= width
            page.call("Emulation.setFocusEmulationEnabled", enabled=True)
            page.call("Browser.grantPermissions", permissions=["clipboardReadWrite", "clipboardSanitizedWrite"])
            page.value("[...document.querySelectorAll('button')].find((b) => b.textContent === 'Copy').click()")
            page.wait_for("[...document.querySelectorAll('button')].some((b) => b.textContent === 'Copied')")
            copied = page.value("navigator.clipboard.readText()")
            assert shlex.split(copied)[2:] == ["--store", str(scene.folder.parent.parent), "--run", str(run)]
            page.open(f"{address}#/sample/{scene.scene_id}/3", width)
            page.wait_for("document.querySelectorAll('.pictures img').length >= 7")
            page.wait_for(pictures_there)
            drawn = ".getContext('2d').getImageData(0, 0, c.width, c.height).data.some((v) => v > 60 && v < 255)"
            page.wait_for(f"(c => c{drawn})(document.querySelector('canvas'))")
            assert page.value("document.documentElement.scrollWidth") <= width
        assert page.errors == []


@needs_chromium
def test_a_mouse_and_a_finger_turn_the_points(server: PageServer, scene: SceneStore) -> None:
    with chromium() as page:
        page.open(f"http://127.0.0.1:{server.server_address[1]}/#/sample/{scene.scene_id}/3", 800, 1600)
        page.wait_for("document.querySelector('canvas')?.width > 300")
        look = "document.querySelector('canvas').toDataURL().slice(-4000)"
        for pointer in ("mouse", "touch"):
            time.sleep(0.3)
            before = page.value(look)
            page.value(
                "(() => { const c = document.querySelector('canvas'); c.setPointerCapture = () => 0;"
                "const go = (kind, x) => c.dispatchEvent(new PointerEvent(kind, "
                f"{{pointerId: 1, pointerType: '{pointer}', clientX: x, clientY: 50, buttons: 1}}));"
                "go('pointerdown', 50); go('pointermove', 170); go('pointerup', 170); })()"
            )
            page.wait_for(f"{look} !== {json.dumps(before)}")
        assert page.errors == []


# ------------------------------------------------------------------------------------------------------------ the verb
