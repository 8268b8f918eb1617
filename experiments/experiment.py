"""An experiment as its file describes it: a scene with changes, and for each size what is rendered and trained."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, ValidationError

from photonfarm.core.errors import SpecError
from photonfarm.core.files import write_whole
from photonfarm.core.models import Frozen, Name, sentences
from photonfarm.scene.free_space import FreeSpace
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import parse_spec

HERE = Path(__file__).parent
SIZES = "sizes.toml"
FREE_SPACE = "free_space.json"  # of each experiment, as experiments/free_space.py measured it

SizeName = Literal["small", "card", "paper"]
Part = Literal["fixed", "movable", "daylight", "vanishing", "static", "ablation"]
"""Where an experiment stands in the tables."""


class References(Frozen):
    """Converged images of some of what is held out."""

    views: int
    spp: int


class Run(Frozen):
    """One network, trained with some settings on top of the size's."""

    name: Name
    train: Mapping[str, Any]
    further: tuple[int, ...] = ()  # seeds from which it is trained again

    @property
    def is_given_halves(self) -> bool:
        """Whether its network can be given the mean of several halves of a view."""
        return bool(self.train["architecture"] == "guided_denoise")


class Long(Frozen):
    """Some of the networks once more, trained for longer, and from how many seeds."""

    steps: int
    names: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)


class Size(Frozen):
    """How large an experiment is."""

    about: str
    changes: Mapping[str, Any] = Field(default_factory=dict)  # of the scene's spec
    modifications: int
    views: int
    seed: int  # of the plan
    seeds: tuple[int, ...] = (0,)  # of networks; denoisers are trained from the first alone
    hold_out: float
    references: References
    architectures: tuple[str, ...]
    untrained: tuple[str, ...]
    kept: tuple[int, ...]
    halves: tuple[int, ...]
    runs: tuple[Run, ...] = ()  # beside one of each architecture
    long: Long | None = None
    inception: bool = True  # whether reports of rooms of the paper's tables have FID, KID and Feature L1
    train: Mapping[str, Any]


class Experiment(Frozen):
    """One experiment of one size."""

    name: Name
    title: str
    part: Part
    about: str  # what was made movable, and why
    scene: str  # the spec, beside the file
    changes: Mapping[str, Any] = Field(default_factory=dict)  # of the spec, for every size
    runs: tuple[Run, ...] = ()  # beside those of the size
    size: Size

    @classmethod
    def load(cls, name: str, size: SizeName) -> Self:
        """The experiment in NAME.toml; raises SpecError with a sentence for each fault."""
        file = HERE / f"{name}.toml"
        if not file.is_file():
            raise SpecError(f"{name}: no such experiment; there are {', '.join(list_names())}")
        described, sizes = _read_toml(file), _read_toml(HERE / SIZES)
        own = {key: described.pop(key, {}) for key in sizes}
        try:
            return cls.model_validate({**described, "name": name, "size": merge(sizes[size], own[size])})
        except ValidationError as error:
            raise SpecError(f"{file}: {'; '.join(sentences(error))}") from error

    def spec(self) -> SceneSpec:
        """The scene's spec with the changes of the experiment and of the size, and free space; raises SpecError."""
        spec, space = self.spec_without_free_space(), _read_free_spaces().get(self.name)
        if space is None or space["of"] != spec.free_space_digest:
            raise SpecError(
                f"{self.name}: {FREE_SPACE} has no free space of its geometry, groups and boxes of views; "
                f"`python experiments/free_space.py {self.name}` measures it"
            )
        view = spec.view.model_copy(update={"free_space": FreeSpace.model_validate(space)})
        return spec.model_copy(update={"view": view})

    def spec_without_free_space(self) -> SceneSpec:
        """The spec with its changes, before free space is measured; raises SpecError."""
        file = HERE / self.scene
        described = merge(merge(_read_toml(file), self.changes), self.size.changes)
        described["name"] = self.name
        return parse_spec(described, where=str(HERE / f"{self.name}.toml"), beside=file.parent)

    def only(self, names: Sequence[str]) -> Self:
        """The same with these networks alone, from the first seed. Raises SpecError for one that it does not have."""
        size, chosen = self.size, [run for run in self.trained() if run.name in names]
        if unknown := {*names} - {run.name for run in chosen}:
            raise SpecError(f"{self.name}: no network of it is named {', '.join(sorted(unknown))}")
        less = {"architectures": (), "runs": (), "long": None, "seeds": size.seeds[:1], "inception": False}
        return self.model_copy(update={"size": size.model_copy(update=less), "runs": tuple(chosen)})

    @property
    def has_features(self) -> bool:
        """Whether its reports have FID, KID and Feature L1, which take most of the time: where the paper has them."""
        return self.size.inception and self.part in ("fixed", "movable")

    def trained(self) -> list[Run]:
        """Every network from the first seed: long runs, one of each architecture, the size's and the experiment's own.

        Denoisers have no further seeds.
        """
        size, long = self.size, self.size.long
        alike = [Run(name=name, train={"architecture": name}) for name in size.architectures]
        short = {run.name: self._settings(run) for run in (*alike, *size.runs, *self.runs)}
        made = [(name, settings, size.seeds) for name, settings in short.items()]
        if long:
            steps = {"max_steps": long.steps}
            made = [(name_long(name, long.steps), {**short[name], **steps}, long.seeds) for name in long.names] + made
        return [
            Run(name=name, train=settings, further=() if _is_denoiser(settings) else seeds[1:])
            for name, settings, seeds in made
        ]

    def again(self) -> list[Run]:
        """The same networks from each further seed."""
        return [
            Run(name=name_seeded(run.name, seed), train={**run.train, "seed": seed})
            for run in self.trained()
            for seed in run.further
        ]

    def _settings(self, run: Run) -> dict[str, Any]:
        return {"seed": self.size.seeds[0], **self.size.train, **run.train}


def name_seeded(name: str, seed: int) -> str:
    """The name of a network's run from a further seed."""
    return f"{name}-seed-{seed}"


def name_long(name: str, steps: int) -> str:
    """The name of a network's run of more steps than others."""
    return f"{name}-{steps}"


def name_halves(name: str, halves: int) -> str:
    """The name of a run's row by so many halves of a view; by one it is that of the run."""
    return name if halves == 1 else f"{name} {halves}/1"


def _is_denoiser(train: Mapping[str, Any]) -> bool:
    return str(train["architecture"]).startswith("denoise")


def list_names() -> list[str]:
    """All experiments, in the order of their files' names."""
    return sorted(file.stem for file in HERE.glob("*.toml") if file.name != SIZES)


def merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Tables merged key by key, as deep as they go; of anything else, what is above."""
    whole = dict(below)
    for key, value in above.items():
        old = whole.get(key)
        whole[key] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return whole


def keep_free_space(name: str, space: FreeSpace) -> None:
    """Write down an experiment's free space beside those of others, a line each."""
    spaces = {**_read_free_spaces(), name: space.model_dump(mode="json")}
    lines = [f"{json.dumps(name)}: {json.dumps(spaces[name])}" for name in sorted(spaces)]
    write_whole(HERE / FREE_SPACE, "{\n" + ",\n".join(lines) + "\n}\n")


def _read_free_spaces() -> dict[str, Any]:
    file = HERE / FREE_SPACE
    spaces: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    return spaces


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SpecError(f"{file}: cannot be read: {error}") from error
