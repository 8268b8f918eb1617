"""The contact sheet: its plans, its picture of photons, and the page."""

import re
from pathlib import Path

import numpy as np
import pytest
import store_samples as samples
from chromium import chromium, needs_chromium

from photonfarm.core.records import Geometry, Photons, ViewBuffers, Visibility
from photonfarm.plan.request import Request
from photonfarm.renderer.tools.plan_view import PlanView, axes_of
from photonfarm.renderer.tools.preview import photon_picture, write_contact_sheet
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.view import Camera, View, sample_view
from photonfarm.store import Sample, Store


def test_a_dot_is_where_a_photon_is_seen_and_nowhere_else() -> None:
    spec = samples.small_spec()
    view = sample_view(spec, b"", 0, 0)
    camera = Camera.of(view, spec)
    pixels = np.argwhere(np.ones((camera.height, camera.width)))
    position = (camera.origin + 2 * camera.rays().reshape(-1, 3)).astype(np.float32)
    seen = np.arange(len(pixels)) % 3 == 0
    flat = np.zeros((camera.height, camera.width, 3), np.float32)
    seen_by_view = ViewBuffers(flat[..., 0], flat, flat), Visibility(np.zeros(0, np.bool_), seen)
    sample = Sample(0, b"", rest(spec), view, 0, np.stack([flat, flat]), *seen_by_view)
    bounce = np.zeros(len(seen), np.int8)
    picture = photon_picture(sample, Photons(position, position, position, np.ones_like(position), bounce), spec)
    assert (picture.max(axis=-1).ravel() > 0).tolist() == seen.tolist()


def furnished() -> Geometry:
    """A floor of 4 × 2, and a block of 1 × 1 on it that the spec moves."""
    floor = [[-2, 0, -1], [2, 0, -1], [2, 0, 1]]
    block = [[0, 0, 0], [1, 0, 1], [1, 1, 0]]
    return Geometry(
        np.array([*floor, *block], np.float32),
        np.array([[0, 1, 2], [3, 4, 5]], np.uint32),
        np.array([0, 1], np.int32),
        np.array([-1, 0], np.int16),
    )


def rectangles(svg: str, kind: str) -> list[list[float]]:
    """Left, top, width and height of the rectangles of a kind."""
    found = re.findall(rf'<rect class="{kind}[^"]*" x="(.*?)" y="(.*?)" width="(.*?)" height="(.*?)"', svg)
    return [[float(value) for value in each] for each in found]


def test_a_plan_shows_what_stands_where_it_was_put_and_nothing_that_is_gone() -> None:
    spec = samples.small_spec(
        view={"origin": {"min": [-2, 0, -1], "max": [2, 1, 1]}, "look_at": {"min": [0, 0, 0], "max": [1, 1, 1]}}
    )
    plan = PlanView.of(spec, furnished())
    scale = 100 / (1.06 * 4)  # of 4 units and a margin of 3 % of them at each side
    view = View(np.array([-1.0, 1.0, 0.0], np.float32), np.array([1.0, 1.0, 0.0], np.float32))
    moved = Modification(np.array([[-1.0, 0.0, -0.5]], np.float32), np.ones(1, np.bool_))
    (found,) = rectangles(plan.configuration(moved, [view]), "thing")
    left, top = scale * (-1 + 2 + 0.12), scale * (-0.5 + 1 + 0.12)  # z goes down, as seen from above
    assert found == pytest.approx([left, top, scale, scale], abs=0.01)
    gone = Modification(np.zeros((1, 3), np.float32), np.zeros(1, np.bool_))
    assert rectangles(plan.configuration(gone, [view]), "thing") == []
    eye, *corners = re.findall(r"[-\d.]+,[-\d.]+", plan.configuration(gone, [view]).partition("points=")[2])[:3]
    x, y = map(float, eye.split(","))
    assert (x, y) == pytest.approx((scale * (-1 + 2.12), scale * 1.12), abs=0.01)
    half = np.tan(np.radians(spec.view.fov_deg / 2))
    for side, corner in zip((-1, 1), corners, strict=True):
        assert tuple(map(float, corner.split(","))) == pytest.approx(
            (x + 2 * scale, y + side * 2 * half * scale), abs=0.02
        )
    assert len(rectangles(plan.places(""), "may")) == len(rectangles(plan.places(""), "origins")) == 1


@pytest.mark.parametrize("up", [sign * np.eye(3)[axis] for axis in range(3) for sign in (-1, 1)], ids=str)
def test_plans_are_seen_from_above_whatever_axis_is_up(up) -> None:
    unit = {"min": [0, 0, 0], "max": [1, 1, 1]}
    spec = samples.small_spec(view={"origin": unit, "look_at": unit, "up": up.tolist()})
    right, upward = axes_of(spec)
    np.testing.assert_array_equal(np.cross(right, upward), up)


def test_a_scene_without_a_single_job_has_a_sheet_too(tmp_path: Path) -> None:
    store = Store(tmp_path / "store", create=True)
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=6)).scene_id)
    write_contact_sheet(samples.reader_of(scene), 24, tmp_path / "preview.html")
    text = (tmp_path / "preview.html").read_text()
    assert "0 complete samples" in text
    assert len(rectangles(text, "may")) == 1


@needs_chromium
def test_the_sheet_says_what_stands_where_and_fits_a_phone(tmp_path: Path) -> None:
    store = Store(tmp_path / "store", create=True)
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=6), shard_rows=4).scene_id)
    _, cloud = samples.base()
    scene.write_base(furnished(), cloud)
    samples.commit_all(scene)
    reader = samples.reader_of(scene)
    there = [bool(reader.read(int(row)).modification.present[0]) for row in reader.rows]
    assert set(there) == {True, False}, "or this test asks nothing"
    write_contact_sheet(reader, 24, tmp_path / "preview.html")
    text = (tmp_path / "preview.html").read_text()
    assert text.count('<section class="sample">') == text.count('alt="photons"') == len(there)
    assert [bool(rectangles(each, "thing")) for each in text.split('<section class="sample">')[1:]] == there
    assert text.count('class="gone"') == there.count(False)
    assert not re.search(r'(src|href)="(?!data:|#)', text)
    with chromium() as page:
        for width in (1280, 390):
            page.open(tmp_path / "preview.html", width)
            assert page.value("document.documentElement.scrollWidth <= innerWidth")
            assert page.value("document.querySelector('.plan').getBoundingClientRect().width") > 200
        assert page.errors == []
