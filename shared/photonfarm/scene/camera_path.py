"""Camera paths: a smooth curve through views that a user gives, or a walk around the scene.

Views that are not in a store, such as those of a path, go from the renderer to the trainer as one file: buffers, and
which points they see.

Shape letters: K key views or photon slots, F frames, G movable groups, H W image, P points.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from photonfarm.core.archives import read_arrays, write_arrays
from photonfarm.core.errors import SpecError
from photonfarm.core.models import Frozen, sentences
from photonfarm.core.records import F32, Guides, Photons, ViewBuffers, Visibility, arrays_of
from photonfarm.scene.arrangement import Arrangement, Point, find_obstacles
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.shot_files import read_cameras
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View

MOST_FRAMES = 10_000
ORBIT = 0.9
"""Size of the ellipse of an orbit over that of the box of origins."""

SMALLER, HEIGHTS = (ORBIT, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1), (0.5, 0.75, 0.95, 0.25, 0.05)
"""Ellipses to try among solids, in this order: their sizes, and their heights in the box of origins."""

FORM = '{"frames": 48, "views": [{"origin": [x, y, z], "look_at": [x, y, z]}, …], "closed": false}'
"""What a path's file looks like."""


class KeyView(Frozen):
    """A view that the path passes through."""

    origin: Point
    look_at: Point


class CameraPath(Arrangement):
    """A path's file, like `FORM`; `place`, `move` and `without` may say what stands where, too."""

    frames: Annotated[int, Field(ge=1, le=MOST_FRAMES)]
    views: Annotated[tuple[KeyView, ...], Field(min_length=1)]
    closed: bool = False  # from the last view back to the first; a film of it repeats without a jump

    @classmethod
    def load(cls, file: Path) -> CameraPath | Cameras:
        """The path in a JSON file, or the cameras of a `transforms.json`; raises SpecError for an invalid file."""
        try:
            document = json.loads(file.read_text())
            if isinstance(document, dict) and isinstance(document.get("frames"), list):
                return Cameras(file=file)
            return cls.model_validate(document)
        except ValidationError as error:
            raise SpecError(f"{file}: {'; '.join(sentences(error))}; a camera path looks like {FORM}") from error
        except OSError as error:
            raise SpecError(f"{file}: cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise SpecError(f"{file}: is not valid JSON: {error}; a camera path looks like {FORM}") from error

    def sample(self) -> list[View]:
        """The views of all frames, at equal steps of the curve's parameter, which is 1 between two key views.

        Origin and look-at point each follow a Catmull–Rom spline [Catmull and Rom, 1974], which goes through all of
        them; the ends of an open path are repeated. Raises SpecError where a camera would look at itself.
        """
        keys = np.array([[*view.origin, *view.look_at] for view in self.views])
        spans = len(keys) if self.closed else len(keys) - 1
        at = np.linspace(0, spans, self.frames, endpoint=not self.closed)
        views = [View.from_vector(vector) for vector in _spline(keys, at, closed=self.closed).astype(np.float32)]
        for i, view in enumerate(views):
            if np.array_equal(view.origin, view.target):
                raise SpecError(f"camera path: in frame {i} the camera stands where it looks at; move a view")
        return views


class Cameras(Arrangement):
    """The cameras of a `transforms.json`, each a frame; it says nothing of what stands where."""

    file: Path

    def sample(self, spec: SceneSpec) -> list[View]:
        """The views of all frames; raises SpecError as `read_cameras` does."""
        return read_cameras(self.file, spec)


def orbit(spec: SceneSpec, frames: int, modification: Modification | None = None) -> list[View]:
    """Once around: on an ellipse in the middle of the spec's box of origins, looking at the middle of the other box.

    The ellipse is perpendicular to the axis nearest to up. In a spec with free space it is the largest one, at any of a
    few heights, on which no camera stands in what is there in this configuration, by default the scene at rest; raises
    SpecError where there is none. Otherwise it may pass through objects.
    """
    standing = rest(spec) if modification is None else modification
    for size, height in product(SMALLER, HEIGHTS) if spec.view.free_space else [(ORBIT, HEIGHTS[0])]:
        views = _ellipse(spec, frames, size, height)
        if next(find_obstacles(spec, views, standing), None) is None:
            return views
    raise SpecError(
        f"{spec.name}: no orbit keeps clear of what stands there, by view.free_space; give a camera path of your own, "
        "or another configuration"
    )


def check_clear(spec: SceneSpec, views: list[View], modification: Modification) -> list[View]:
    """The views of a path, if all its cameras are in free space; raises SpecError for the first that is not.

    Free space is known in the box of origins alone; beyond it, only the movable groups are looked at.
    """
    for frame, what in find_obstacles(spec, views, modification):
        x, y, z = views[frame].origin.tolist()
        raise SpecError(
            f"camera path: in frame {frame} the camera at ({x:.3g}, {y:.3g}, {z:.3g}) stands {what}; lead the path "
            "around it"
        )
    return views


def _ellipse(spec: SceneSpec, frames: int, size: float, height: float) -> list[View]:
    """Views on an ellipse of this size, at this height, both as shares of the box of origins."""
    low, high = np.array(spec.view.origin.low), np.array(spec.view.origin.high)
    target = 0.5 * (np.array(spec.view.look_at.low) + np.array(spec.view.look_at.high))
    up = int(np.abs(spec.view.up).argmax())
    first, second = (axis for axis in range(3) if axis != up)
    angle = 2 * np.pi * np.arange(frames) / frames
    origins = np.repeat(0.5 * (low + high)[None], frames, axis=0)
    origins[:, up] += (height - 0.5) * (high - low)[up]
    origins[:, first] += size * 0.5 * (high - low)[first] * np.cos(angle)
    origins[:, second] += size * 0.5 * (high - low)[second] * np.sin(angle)
    return [View(origin.astype(np.float32), target.astype(np.float32)) for origin in origins]


def _spline(keys: NDArray[np.float64], at: NDArray[np.float64], *, closed: bool) -> NDArray[np.float64]:
    """The uniform Catmull–Rom spline through keys (K, 6) at parameters (F,) → (F, 6)."""
    count = len(keys)
    span = np.minimum(np.floor(at), max(count - (1 if closed else 2), 0)).astype(np.int64)
    t = (at - span)[:, None]
    places = [span + step for step in (-1, 0, 1, 2)]
    before, start, end, after = (keys[place % count if closed else place.clip(0, count - 1)] for place in places)
    bend = t * (end - before) + t**2 * (2 * before - 5 * start + 4 * end - after)
    return start + 0.5 * (bend + t**3 * (3 * start - before - 3 * end + after))


_OF_VIEWS = ("depth", "albedo", "normal", "point_seen", "photon_seen")


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Views of one configuration of a scene, without radiance."""

    scene_id: str
    modification: Modification
    views: tuple[View, ...]
    depth: F32  # (F, H, W) and so on, as in `ViewBuffers`
    albedo: F32  # (F, H, W, 3)
    normal: F32  # (F, H, W, 3)
    point_seen: NDArray[np.bool_]  # (F, P) and (F, K), as in `Visibility`
    photon_seen: NDArray[np.bool_]  # (F, K)
    photons: Photons | None  # of the configuration; None for a scene without
    guides: Guides  # (F, …) of all views
    group: NDArray[np.int16] | None = None  # (F, H, W) what pixels' centres show, by its place in `names`; −1: nothing
    names: tuple[str, ...] = ()  # of what never moves, "", and of the groups; both are missing in older files

    def __len__(self) -> int:
        """How many frames there are."""
        return len(self.views)

    def buffers(self, frame: int) -> ViewBuffers:
        """The buffers of one frame."""
        return ViewBuffers(self.depth[frame], self.albedo[frame], self.normal[frame])

    def visibility(self, frame: int) -> Visibility:
        """Which points and photons one frame sees."""
        return Visibility(self.point_seen[frame], self.photon_seen[frame])

    def guides_of(self, frame: int) -> Guides:
        """The guides of one frame."""
        return Guides(**{name: values[frame] for name, values in arrays_of(self.guides).items()})

    def write(self, file: Path) -> None:
        """Store them as a NumPy archive, whole or not at all; raises StoreError if the disk refuses."""
        longest = max(len(view.vector) for view in self.views)  # a field of view of 0 is the spec's
        arrays: dict[str, NDArray[Any]] = {
            "scene_id": np.array(self.scene_id),
            "modification": self.modification.vector,
            "view": np.stack([np.pad(view.vector, (0, longest - len(view.vector))) for view in self.views]),
            **{name: getattr(self, name) for name in _OF_VIEWS},
            **{f"guide_{name}": array for name, array in arrays_of(self.guides).items()},
        }
        if self.group is not None:
            arrays |= {"group": self.group, "group_names": np.array(self.names)}
        if self.photons is not None:
            arrays |= {f"photon_{name}": array for name, array in arrays_of(self.photons).items()}
        write_arrays(file, arrays, "buffers")

    @classmethod
    def read(cls, file: Path) -> Self:
        """Read what `write` stored; raises StoreError for anything else."""
        with read_arrays(file, "buffers", "buffers") as stored:
            views = tuple(View.from_vector(vector) for vector in stored["view"])
            photons = None
            if "photon_bounce" in stored:
                photons = Photons(*(stored[f"photon_{field.name}"] for field in fields(Photons)))
            guides = Guides(*(stored[f"guide_{field.name}"] for field in fields(Guides)))
            modification = Modification.from_vector(stored["modification"])
            of_views: dict[str, Any] = {name: stored[name] for name in _OF_VIEWS}
            if "group" in stored:
                of_views |= {"group": stored["group"], "names": tuple(stored["group_names"].tolist())}
            return cls(str(stored["scene_id"]), modification, views, photons=photons, guides=guides, **of_views)
