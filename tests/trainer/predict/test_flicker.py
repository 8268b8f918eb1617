"""How much a film flickers, on a wall whose colour follows from the place alone."""

import numpy as np
import pytest
import store_samples as samples

from photonfarm.core.records import F32
from photonfarm.predict.flicker import Flicker, register
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View


def look(spec: SceneSpec, x: float) -> tuple[View, F32, F32]:
    """A view of the wall z = 0 from 2 units away, its depth, and an image that is smooth over the wall."""
    view = View(np.float32([x, 0.1, 2]), np.float32([x + 0.05, 0, 0]))
    camera = Camera.of(view, spec)
    ray = camera.rays().astype(np.float64)
    along = camera.origin[2] / -ray[..., 2]
    place = camera.origin + ray * along[..., None]
    image = np.stack([np.sin(place[..., 0]), np.cos(place[..., 1]), place[..., 0] * place[..., 1]], axis=-1)
    return view, (along * (ray @ camera.forward)).astype(np.float32), image.astype(np.float32)


def test_a_still_wall_does_not_flicker_and_noise_does() -> None:
    spec = samples.small_spec(film={"width": 64, "height": 48})
    rng, noise = np.random.default_rng(0), 0.1
    films = Flicker(spec)
    for step in range(3):
        view, depth, still = look(spec, 0.07 * step)
        a, b = (still + rng.normal(0, noise, still.shape).astype(np.float32) for _ in "AB")
        lit = still + np.float32(noise * (step > 0))
        films.add(
            view,
            depth,
            {"still": [still], "noisy": [a], "halves": [a, b], "lit": [lit], "opposed": [lit, 2 * still - lit]},
        )
    told = films.result()
    assert told["still"] == pytest.approx(0, abs=1e-3)
    assert told["lit"] == pytest.approx(noise / 2**0.5, rel=0.02), "from one of two frames to the next"
    assert noise < told["noisy"] < 2**0.5 * noise, "that of a pixel, and that of the mean of four before"
    assert (told["halves"] or 0) < 0.2 * noise, "noise that is independent cancels"
    assert told["opposed"] is None, "a negative mean square"


def test_what_was_hidden_or_out_of_the_image_does_not_count() -> None:
    spec = samples.small_spec(film={"width": 64, "height": 48})
    view, depth, image = look(spec, 0)
    moved = look(spec, 0.07)
    assert len(register(spec, (view, moved[0]), (depth, moved[1])).pixels) > 0.9 * 64 * 48
    nearer = depth.copy()
    nearer[:, :32] *= 0.5
    pixels = register(spec, (view, view), (nearer, depth)).pixels
    assert len(pixels)
    assert (pixels % 64 >= 32).all()
    films = Flicker(spec)
    for seen in (View(view.origin, np.float32([0, 0, 9])), view):
        films.add(seen, depth, {"image": [image]})
    assert films.result() == {}
