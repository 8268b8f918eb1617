"""What `photonfarm live` serves: the network's picture of any configuration, and the truth as it becomes better.

Each request says the whole configuration and camera, so that any number of viewers can look, each at their own. The
server keeps the last few truths, which go on from one request to the next; what nobody asks for is not rendered.
"""

from __future__ import annotations

import base64
import json
import re
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from photonfarm.core import pictures
from photonfarm.core.errors import SpecError
from photonfarm.core.page import STYLES
from photonfarm.core.records import F32
from photonfarm.predict.opened_run import Frame, OpenRun
from photonfarm.renderer.jobs.truth import SMALL_HALF, RefinedTruth
from photonfarm.scene.arrangement import Shot, describe_shot
from photonfarm.scene.groups import Light, Movable
from photonfarm.scene.spec import Film
from photonfarm.web.images import encode
from photonfarm.web.server import JSON, KINDS, PNG, Answer, NotAllowedError, NotThereError, Routes, WrongRequestError
from photonfarm.web.server import STATIC as FARM_PAGES

PAGES = Path(__file__).parent / "static"
SLICE_S = 0.15
"""How long a truth is refined in one request: a viewer who begins to drag waits no longer."""

FLUENT_S = 0.15
"""The seconds of a frame in motion above which the image is made smaller."""

TRUTHS = 4
"""How many truths go on where they were left."""


@dataclass
class Speed:
    """How large images in motion are: halved while a frame takes too long, and doubled again where there is time."""

    most: Film
    halvings: int = 0

    def film(self) -> Film:
        """The size of the next image in motion; width and height are multiples of 8."""
        width, height = (max(8, round(side / 2**self.halvings / 8) * 8) for side in (self.most.width, self.most.height))
        return Film(width=width, height=height)

    def learn(self, seconds: float) -> None:
        """Take note of how long such an image took."""
        if seconds > FLUENT_S and min(self.film().width, self.film().height) >= 64:
            self.halvings += 1
        elif self.halvings and 4 * seconds < 0.7 * FLUENT_S:
            self.halvings -= 1


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A network's image, and the truth that it is judged by, so far."""

    frame: Frame
    refined: RefinedTruth


@dataclass(eq=False)
class Live:
    """An opened run that viewers ask for pictures. Its methods run on one thread, in the order of the requests."""

    open: Callable[[], OpenRun]
    most_spp: int
    begins: str = "photonfarm infer"  # the command that makes one of these pictures
    may_submit: bool = False  # whether what is shown can be planned as a sample
    _thread: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, "live"))
    _judged: OrderedDict[str, Judged] = field(default_factory=OrderedDict)

    def __post_init__(self) -> None:
        """Load the run, on the thread that will use it, as Mitsuba's variant is a thread's. Raises what that raises."""
        self.run = self._thread.submit(self.open).result()
        self.plan = self._thread.submit(self.run.draw_plan).result()
        self.speed = Speed(self.run.spec.film)

    def routes(self) -> Routes:
        """What is read: the page, and pictures of what a path says, in base64."""
        files = [STYLES, *FARM_PAGES.iterdir(), *PAGES.iterdir()]
        table: list[tuple[str, Callable[..., Answer]]] = [
            ("/", lambda: (KINDS[".html"], (PAGES / "live.html").read_bytes())),
            *((f"/{path.name}", _serve_file(path)) for path in files if path.suffix in KINDS),
            ("/room", self._answer(self.describe)),
            ("/plan/(still|[0-9]{1,4}).png", self.draw_plan),
            ("/frame/([A-Za-z0-9_-]{1,8000})", self._answer(lambda asked: self.frame(asked, full=False))),
            ("/full/([A-Za-z0-9_-]{1,8000})", self._answer(lambda asked: self.frame(asked, full=True))),
            ("/truth/([A-Za-z0-9_-]{1,8000})", self._answer(self.truth)),
            ("/command/([A-Za-z0-9_-]{1,8000})", self._answer(self.command)),
        ]
        return [(re.compile(pattern.replace(".", r"\.")), False, make) for pattern, make in table]

    def writes(self) -> Routes:
        """What is written: a sample is planned, where that is allowed."""
        return [(re.compile("/submit/([A-Za-z0-9_-]{1,8000})"), False, self._answer(self.submit_shown))]

    def _answer(self, make: Callable[..., dict[str, Any]]) -> Callable[..., Answer]:
        def answer(*asked: str) -> Answer:
            try:
                told = self._thread.submit(make, *asked).result()
            except SpecError as error:
                raise WrongRequestError(str(error)) from error
            return JSON, json.dumps(told, allow_nan=False).encode()

        return answer

    # ------------------------------------------------------------------------------------------------------ the room

    def describe(self) -> dict[str, Any]:
        """The room as the page needs it: what can be dragged, and within what."""
        spec, plan = self.run.spec, self.plan
        view = Shot().view(spec)
        return {
            "name": spec.name,
            "network": self.run.architecture,
            "film": [spec.film.width, spec.film.height],
            "fov": spec.view.fov_deg,
            "fov_range": spec.view.fov and spec.view.fov.model_dump(),
            "up": spec.view.up,
            "across": plan.across,
            "down": plan.down,
            "low": plan.low.tolist(),
            "high": plan.high.tolist(),
            "camera": view.origin.tolist(),
            "look_at": view.target.tolist(),
            "camera_box": spec.view.origin.model_dump(),
            "look_at_box": spec.view.look_at.model_dump(),
            "groups": [_describe_group(group) for group in spec.groups],
            "may_submit": self.may_submit,
        }

    def draw_plan(self, name: str) -> Answer:
        """A picture of the plan: `still`, or the number of a group. Raises NotThereError for another one."""
        if name != "still" and int(name) >= len(self.plan.groups):
            raise NotThereError(f"there is no group {name}")
        return PNG, encode(self.plan.still if name == "still" else self.plan.groups[int(name)])

    # -------------------------------------------------------------------------------------------------- the pictures

    def frame(self, asked: str, *, full: bool) -> dict[str, Any]:
        """The network's picture: in motion as large as is fluent, else of the spec's size, and looked at closely."""
        began, film = time.perf_counter(), self.run.spec.film if full else self.speed.film()
        frame = self._predict(asked, film)
        radiance = frame.radiance.numpy(force=True)  # waits for a card
        seconds = time.perf_counter() - began
        if not full:
            self.speed.learn(seconds)
        return {
            "picture": self._draw(radiance),
            "ms": 1e3 * seconds,
            "warnings": frame.doubts if full else frame.beyond,
        }

    @torch.no_grad()
    def _predict(self, asked: str, film: Film | None = None) -> Frame:
        configuration, view = self.run.stage(**_read(asked))
        run = self.run if film in (None, self.run.spec.film) else self.run.with_film(film)
        return run.predict(configuration, view)

    def truth(self, asked: str) -> dict[str, Any]:
        """The truth, after a little more work on it, and the network's error against it."""
        if asked not in self._judged:
            self._judged[asked] = Judged(self._predict(asked), RefinedTruth(self.run.spec, SMALL_HALF))
        self._judged.move_to_end(asked)
        while len(self._judged) > TRUTHS:
            self._judged.popitem(last=False)
        judged, until = self._judged[asked], time.perf_counter() + SLICE_S
        while not judged.refined.is_enough or (judged.refined.spp < self.most_spp and time.perf_counter() < until):
            self.run.refine(judged.refined, judged.frame)
        truth = judged.refined.result()
        image = judged.frame.radiance.cpu().numpy()
        return {
            "picture": self._draw(truth.radiance),
            "spp": truth.spp,
            "seconds": truth.seconds,
            "done": truth.spp >= self.most_spp,
            "error": truth.describe_estimate(truth.error(image), image),
        }

    def _draw(self, radiance: F32) -> str:
        picture = pictures.display(radiance, self.run.spec.exposure)
        return base64.b64encode(encode(picture)).decode()

    # --------------------------------------------------------------------------------------------- what follows of it

    def command(self, asked: str) -> dict[str, Any]:
        """The command that makes these pictures."""
        configuration, view = self.run.stage(**_read(asked))
        return {"command": f"{self.begins} --truth {self.most_spp} {describe_shot(self.run.spec, configuration, view)}"}

    def submit_shown(self, asked: str) -> dict[str, Any]:
        """Plan the configuration and the view as a sample. Raises NotAllowedError where viewers may not."""
        if not self.may_submit:
            raise NotAllowedError("nothing is planned here; `photonfarm live --may-submit` lets viewers do that")
        return {"said": str(self.run.plan_sample(*self.run.stage(**_read(asked))))}


def _serve_file(path: Path) -> Callable[[], Answer]:
    return lambda: (KINDS[path.suffix], path.read_bytes())


def _read(asked: str) -> dict[str, Any]:
    """What a path asks for. Raises SpecError for what is no state of the page."""
    try:
        document = dict(json.loads(base64.urlsafe_b64decode(asked + "=" * (-len(asked) % 4))))
        return Shot.of(**document).model_dump()
    except (ValueError, TypeError, RecursionError) as error:
        raise SpecError(f"the path says no configuration and camera: {error}") from error


def _describe_group(group: Movable) -> dict[str, Any]:
    power = group.power if isinstance(group, Light) else None
    return {
        "name": group.name,
        "at": group.at,
        "box": group.box.model_dump(),
        "removable": group.removal_probability > 0,
        "light": isinstance(group, Light),
        "turn": group.turn and group.turn.model_dump(),
        "power": power and power.model_dump(),
    }
