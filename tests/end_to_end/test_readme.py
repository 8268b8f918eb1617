"""What README.md and the pages show: Python that runs, and commands that there are.

The Python runs as it is written, on a small store and without rendering. Of commands verbs and options are parsed, and
those of the tutorial are run, too.
"""

import contextlib
import re
import shlex
import subprocess
import sys
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
import store_samples as samples
import torch

from photonfarm.plan.request import Request
from photonfarm.store import Store
from photonfarm.trainer.training.losses import judge

ROOT = Path(__file__).parents[2]


def blocks(page: str) -> list[str]:
    """The Python blocks of a page."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store that the pages read: 40 committed samples of a scene named room."""
    place = tmp_path_factory.mktemp("pages") / "store"
    opened = Store(place, create=True)
    scene = opened.scene(opened.plan(samples.small_spec(name="room"), Request(modifications=40)).scene_id)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    return place


@pytest.fixture(autouse=True)
def folder(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with that store in it, and in that of the demo."""
    (tmp_path / "demo").mkdir()
    for place in ("store", "demo/store"):
        (tmp_path / place).symlink_to(store)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def ran(code: str) -> dict[str, Any]:
    """What code leaves under which names."""
    left: dict[str, Any] = {}
    exec(code, left)
    return left


def test_the_five_lines_of_the_readme_open_a_scene_and_make_a_loader(capsys: pytest.CaptureFixture[str]) -> None:
    (five_lines,) = blocks("README.md")
    assert len([line for line in five_lines.splitlines() if line]) == 5
    loader = ran(five_lines)["loader"]
    assert capsys.readouterr().out.startswith("40 (2, 8, 8, 3) (8, 8, 3) Modification(")
    assert (loader.batch_size, loader.num_workers) == (8, 2)
    batch = next(iter(torch.utils.data.DataLoader(loader.dataset, batch_size=8)))  # in this process
    assert batch["radiance"].shape == (8, 2, 8, 8, 3)


@pytest.mark.parametrize(("page", "count"), [("docs/tutorial.md", 4), ("docs/python.md", 3)])
def test_the_blocks_of_a_page_run_one_after_the_other(page: str, count: int) -> None:
    found = blocks(page)
    assert len(found) == count
    left = ran("\n".join(found).replace('"my-room"', '"room"'))
    assert len(left["scene"]) == 40
    assert left["half_a"].shape == (8, 8, 3)


def test_the_training_loop_of_the_python_page_learns(capsys: pytest.CaptureFixture[str]) -> None:
    torch.manual_seed(0)
    first, loop, _ = blocks("docs/python.md")
    ran(first + loop.replace("range(3)", "range(12)"))
    errors = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines() if line.startswith("epoch")]
    assert errors[-1] < 0.9 * errors[0]


def test_the_network_and_the_loss_of_the_training_page_do_what_it_says() -> None:
    (module,) = [block for block in blocks("docs/training.md") if "nn.Module" in block]
    mine = ran(module)
    network = mine["PerPixel"](SimpleNamespace(width=4), SimpleNamespace(scale=2.0))
    image = torch.ones(2, 8, 8, 3)
    guides = SimpleNamespace(emission=image, direct=image, gloss=image, specular=image)
    inputs = SimpleNamespace(albedo=image, normal=image, depth=torch.ones(2, 8, 8), guides=guides)
    assert network(inputs).shape == image.shape
    assert network.needs.guides
    assert not network.needs.points
    assert judge(mine["weighted"]).is_unbiased


# ------------------------------------------------------------------------------------------------------------- commands

PAGES = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md") if path.name != "cli.md")]
"""All pages but the one that is made from the commands themselves, and those of measurements."""

BETWEEN = {"&&", "||", "|", "&", ";"}


def shell(text: str) -> list[str]:
    """The lines of a page's indented blocks without their prompts; lines that end in a backslash go on."""
    unfenced = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    return re.findall(r"^ {4}(?:\$ )?(\S.*)$", re.sub(r"\\\n\s*", " ", unfenced), re.MULTILINE)


def commands(line: str) -> list[list[str]]:
    """The arguments of each `photonfarm` in a line of shell."""
    if "photonfarm " not in line:  # output, perhaps
        return []
    words = shlex.shlex(line, posix=True, punctuation_chars="&|;")
    words.whitespace_split = True
    parts = [list(part) for between, part in groupby(words, BETWEEN.__contains__) if not between]
    return [part[part.index("photonfarm") + 1 :] for part in parts if "photonfarm" in part]


def in_passing(text: str) -> list[list[str]]:
    """The arguments of each `photonfarm` with a verb between backticks."""
    return [arguments.split() for arguments in re.findall(r"`photonfarm ([a-z][^`]*)`", text)]


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_have_verbs_and_options_that_there_are(parse, page: str) -> None:
    text = (ROOT / page).read_text()
    for arguments in (arguments for line in shell(text) for arguments in commands(line)):
        parse(arguments)
    for arguments in in_passing(text):
        with contextlib.suppress(click.MissingParameter):
            parse(arguments)


SMALLER = {
    "make setup": ":",  # the tests' own environment is set up
    ". .venv/bin/activate": ":",
    "--modifications 96": "--modifications 24",
    "--train-steps 600": "--train-steps 20",
    "--reference-views 4": "--reference-views 1",
    "--orbit 24": "--orbit 2",
}
"""What the tutorial says, and what its commands are run with instead, as its own numbers take minutes."""


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_tutorial_leads_from_an_empty_folder_to_pictures_of_a_room_and_to_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "docs/tutorial.md").read_text()
    lines = "\n".join(shell(text))
    for said, instead in SMALLER.items():
        assert said in lines
        lines = lines.replace(said, instead)
    (tmp_path / "checkout").mkdir()
    (tmp_path / "checkout/docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path / "checkout")
    monkeypatch.setenv("PHOTONFARM_REDIS_URL", "redis://127.0.0.1:1/0")
    ours = f'python() {{ {sys.executable} "$@"; }}\nphotonfarm() {{ python -m photonfarm.cli "$@"; }}'
    done = subprocess.run(["bash", "-ec", f"{ours}\n{lines}"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

    monkeypatch.chdir("build/tutorial")
    for left in re.findall(r"^\| `(\S+)` \|", text, re.MULTILINE):
        assert Path(left).exists(), left
    assert len(list(Path("out/references").iterdir())) == 1
    assert len(list(Path("orbit").glob("frame-*.png"))) == 2
    assert Path("orbit/path.gif").exists()
    found = ran("\n".join(blocks("docs/tutorial.md")))
    assert len(found["scene"]) > 24, "each further pass of a reference is one, too"
    assert len(found["errors"]) > 0
    assert "error of a black image on" in capsys.readouterr().out
