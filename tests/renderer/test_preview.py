"""The contact sheet's picture of photons."""

import numpy as np
import store_samples as samples

from photonfarm.renderer.tools.preview import photon_picture
from photonfarm.shared.core.records import Photons, ViewBuffers, Visibility
from photonfarm.shared.scene.modification import rest
from photonfarm.shared.scene.view import Camera, sample_view
from photonfarm.shared.store import StoredSample


def test_a_dot_is_where_a_photon_is_seen_and_nowhere_else() -> None:
    spec = samples.small_spec()
    view = sample_view(spec, b"", 0, 0)
    camera = Camera.of(view, spec)
    pixels = np.argwhere(np.ones((camera.height, camera.width)))
    position = (camera.origin + 2 * camera.rays().reshape(-1, 3)).astype(np.float32)
    seen = np.arange(len(pixels)) % 3 == 0
    flat = np.zeros((camera.height, camera.width, 3), np.float32)
    sample = StoredSample(
        0, rest(spec), view, np.stack([flat, flat]), ViewBuffers(flat[..., 0], flat, flat),
        Visibility(np.zeros(0, np.bool_), seen), 0,
    )  # fmt: skip
    bounce = np.zeros(len(seen), np.int8)
    picture = photon_picture(sample, Photons(position, position, position, np.ones_like(position), bounce), spec)
    assert (picture.max(axis=-1).ravel() > 0).tolist() == seen.tolist()
