"""The pages and the code name the same verbs, keys, variables and exit codes; links lead somewhere."""

import functools
import os
import re
import runpy
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import click
import pytest
import yaml
from pydantic import BaseModel

from photonfarm.cli.main import file_defaults, options_by_command, umbrella
from photonfarm.core import errors
from photonfarm.scene import spec as scene_spec
from photonfarm.scene.free_space import FreeSpace
from photonfarm.store.model.findings import Cause
from photonfarm.trainer.runs.settings import KEYS, PRESETS, Architecture, Loss, Occlusion, TrainSettings, make_preset

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
CLI_PAGE = DOCS / "cli.md"
"""The page that `make docs` writes, and nobody commits."""

PAGES = [
    *(ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted({*DOCS.rglob("*.md")} - {CLI_PAGE}),
]


@functools.cache
def read_page(page: Path) -> str:
    """What a page says; the page of the command line is made, not read."""
    if page != CLI_PAGE:
        return page.read_text()
    text: str = runpy.run_path(str(ROOT / "scripts/cli_page.py"))["build_page"]()
    return text


def test_the_page_of_the_command_line_has_a_section_for_every_verb() -> None:
    sections = re.findall(r"^## photonfarm (.+)$", read_page(CLI_PAGE), re.MULTILINE)
    assert {"submit", "train", "store check", "scene import"} < set(sections)
    assert {section.partition(" ")[0] for section in sections} == set(umbrella.list_commands(click.Context(umbrella)))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_within_the_repository_lead_to_a_file_and_from_the_site_to_the_site(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`\n]*`", "", read_page(page), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        name, _, anchor = target.partition("#")
        if "://" in target:
            continue
        file = (page.parent / name).resolve() if name else page
        assert file.exists() or file == CLI_PAGE, target
        assert page.is_relative_to(DOCS) <= file.is_relative_to(DOCS), f"{target} is outside of the site"
        assert not anchor or anchor in list_anchors(file), target


def list_anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ (.+)$", read_page(page), re.MULTILINE)
    kept = [re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings]
    return {re.sub(r"[\s]+", "-", heading) for heading in kept}


def test_every_page_but_those_of_measurements_is_in_the_navigation_once() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2]
    listed = re.findall(r": (\S+\.md)$", navigation, re.MULTILINE)
    assert sorted(listed) == sorted([*{CLI_PAGE.name, *(page.name for page in DOCS.glob("*.md"))}, "results/README.md"])


SECTIONS: dict[str, type[BaseModel]] = {
    "Top level": scene_spec.SceneSpec,
    "scene": scene_spec.Source,
    "objects": scene_spec.Movable,
    "lights": scene_spec.Light,
    "emitters": scene_spec.Emitters,
    "view": scene_spec.ViewSpec,
    "free space": FreeSpace,
    "film": scene_spec.Film,
    "transport": scene_spec.Transport,
    "photons": scene_spec.PhotonSpec,
    "guides": scene_spec.GuideSpec,
    "credits": scene_spec.Credits,
}
"""The sections of docs/scene-spec.md, and the models whose keys they list."""


@pytest.mark.parametrize("section", SECTIONS)
def test_the_page_of_the_scene_spec_lists_every_key_and_its_default(section: str) -> None:
    text = (DOCS / "scene-spec.md").read_text().partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    listed: dict[str, str] = {}
    for cells in (line.split(" | ") for line in text.splitlines() if line.startswith("| `")):
        names, defaults = re.findall(r"`([\w.]+)`", cells[0]), cells[1].split(", ")
        listed |= dict(zip(names, defaults if len(defaults) == len(names) else [cells[1]] * len(names), strict=True))
    fields = SECTIONS[section].model_fields
    assert {name for name in listed if "." not in name} == set(fields)
    for name, field in fields.items():
        if field.is_required():
            assert listed[name] == "required", name
        elif isinstance(field.default, bool):
            assert listed[name] == str(field.default).lower(), name
        elif isinstance(field.default, int | float):
            assert float(listed[name]) == field.default, name


def read_rows(page: str, columns: int) -> Iterator[list[str]]:
    """The cells of the rows that begin with a key, in tables of so many columns."""
    for line in (DOCS / page).read_text().splitlines():
        cells = line.strip("| ").split(" | ")
        if line.startswith("| `") and len(cells) == columns:
            yield cells


def get_setting(settings: TrainSettings, key: str) -> object:
    """A setting, or one of the network."""
    return getattr(settings if key in TrainSettings.model_fields else settings.network, key)


def format_setting(value: object) -> str:
    """A setting's value as the page has it."""
    if value in (None, ()):
        return "–"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(value)
    if value in (1 / 8, 1 / 16):
        return f"1/{1 / value:.0f}"  # type: ignore[operator]
    return f"{value:g}" if isinstance(value, float) else str(value)


def test_the_page_of_the_settings_of_training_lists_every_key_with_its_values_in_two_presets() -> None:
    listed = {cells[0].strip("`"): cells[1:3] for cells in read_rows("training-settings.md", 4)}
    assert set(listed) == set(KEYS)
    presets = [make_preset("small"), make_preset("paper-dynamic")]
    for key in KEYS:
        assert listed[key] == [format_setting(get_setting(preset, key)) for preset in presets], key


def test_the_page_of_the_settings_of_training_says_in_what_the_other_presets_differ() -> None:
    listed = {cells[0].strip("`"): cells[1] for cells in read_rows("training-settings.md", 3)}
    for name in PRESETS.keys() - {"small", "paper-dynamic"}:
        pairs = {key: format_setting(get_setting(make_preset(name), key)) for key in KEYS}
        base = make_preset("small" if name == "card" else "paper-dynamic")
        differing = {key for key in KEYS if pairs[key] != format_setting(get_setting(base, key))}
        assert {*listed[name].split(", ")} == {f"`{key} = {pairs[key]}`" for key in differing}


@pytest.mark.parametrize("kind", [Architecture, Loss, Occlusion])
def test_the_page_of_the_settings_of_training_names_every_network_loss_and_rule(kind: Any) -> None:
    page = (DOCS / "training-settings.md").read_text()
    firsts = " ".join(line.partition(" | ")[0] for line in page.splitlines() if line.startswith("| `"))
    for name in get_args(kind):
        assert f"`{name}`" in firsts or f"`_{name.rpartition('_')[2]}`" in firsts, name


def test_the_page_of_the_configuration_lists_every_variable_and_exit_code() -> None:
    page = (DOCS / "configuration.md").read_text()
    sources = [file for folder in ("shared", "services") for file in (ROOT / folder).rglob("*.py")]
    sources += [ROOT / "docker-compose.yml", ROOT / "docker/redis.sh"]
    named = {name for file in sources for name in re.findall(r"\bPHOTONFARM_[A-Z_]*[A-Z]\b", file.read_text())}
    assert {name for name in named if f"`{name}`" not in page} == set()
    codes = {kind.exit_code for kind in vars(errors).values() if isinstance(kind, type) and hasattr(kind, "exit_code")}
    assert codes <= {int(code) for code in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)}


def test_the_page_of_the_configuration_lists_every_extra() -> None:
    section = (DOCS / "configuration.md").read_text().partition("\n## Extras\n")[2].partition("\n## ")[0]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == set(extras)


def test_the_example_of_a_configuration_file_is_one(tmp_path: Path) -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", (DOCS / "configuration.md").read_text(), re.DOTALL)
    (tmp_path / "photonfarm.toml").write_text(example)
    defaults = file_defaults(tmp_path / "photonfarm.toml", options_by_command(umbrella))
    assert defaults["train"]["max_steps"] == 20000
    assert defaults["scene"]["plan"]["seconds"] == 120


def test_the_example_of_a_spec_is_one() -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", (DOCS / "own-scene.md").read_text(), re.DOTALL)
    described = scene_spec.SceneSpec.model_validate(tomllib.loads(example))
    assert [group.name for group in described.groups] == ["sofa", "ceiling-light"]


def test_the_page_of_the_check_lists_every_cause_with_its_sentence_and_what_helps() -> None:
    listed = re.findall(r"^\| `([a-z-]+)` \| (.+) \| (.+) \|$", (DOCS / "store-check.md").read_text(), re.MULTILINE)
    assert listed == [(cause.label, cause.sentence, cause.remedy.value) for cause in Cause]


def test_the_hosted_ci_runs_the_same_command_on_every_supported_python() -> None:
    workflow: dict[Any, Any] = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    (job,) = workflow["jobs"].values()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = [re.search(r":: (3\.\d+)$", classifier) for classifier in project["classifiers"]]
    supported = [match[1] for match in named if match]
    assert job["strategy"]["matrix"]["python"] == supported
    assert project["requires-python"] == f">={supported[0]}"
    assert "${{ matrix.python }}" in job["container"]
    assert [step["run"] for step in job["steps"] if "run" in step] == [".ci/run"]
    assert os.access(ROOT / ".ci/run", os.X_OK)
    assert workflow[True].keys() == {"push", "pull_request"}  # YAML 1.1 takes `on` for true
