import os
import subprocess
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result

from photonfarm.cli import main
from photonfarm.cli.main import umbrella
from photonfarm.core.processes import command


@click.command()
@click.option("--store", default="store")
@click.option("--run", default="run")
def report(store: str, run: str) -> None:
    """Report on a run."""
    click.echo(f"report {store} {run}")


@click.command()
@click.option("--out", default="out")
@click.option("--seconds", "budget_s", default=5.0)
def plan(out: str, budget_s: float) -> None:
    """Plan it."""
    click.echo(f"plan {out} {budget_s:g}")


@click.group()
def scene() -> None:
    """Scene specs."""


@scene.command()
def show() -> None:
    """Show it."""
    click.echo("shown")


Install = Any


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Install:
    def of(*names: str) -> None:
        commands = {"report": report, "store.check": plan, "scene": scene, "scene.plan": plan}
        found = {}
        for name in names:
            entry = EntryPoint(name, f"{__name__}:{name}", main.GROUP)
            monkeypatch.setattr(EntryPoint, "load", lambda self: commands[self.name])
            found[name] = entry
        monkeypatch.setattr(main, "_find_verbs", lambda: found)

    return of


def run(*arguments: str) -> Result:
    return CliRunner().invoke(umbrella, arguments, prog_name="photonfarm")


def test_a_group_shows_its_own_subcommands_and_those_of_others(install: Install) -> None:
    install("scene", "scene.plan")
    assert run("scene", "show").output == "shown\n"
    assert run("scene", "plan").output == "plan out 5\n"
    listed = run("scene", "--help").output
    assert listed.index("plan") < listed.index("show")


def test_subcommands_of_a_verb_that_has_no_entry_point_hang_below_a_bare_group(install: Install) -> None:
    install("store.check")
    assert run("store", "check").output == "plan out 5\n"
    assert run("store", "--out", "here").exit_code == 2
    assert "check" in run("store", "--help").output


def test_a_dotted_name_is_no_verb_and_the_umbrella_lists_its_verb_once(install: Install) -> None:
    install("report", "scene", "scene.plan")
    assert run("scene.plan").exit_code == 2
    listed = run("--help").output.partition("Commands:")[2].split("\n")
    assert [line.split()[0] for line in listed if line.strip()] == ["report", "scene"]


def test_the_configuration_file_has_tables_for_subcommands(install: Install, tmp_path: Path) -> None:
    install("report", "scene", "scene.plan")
    file = tmp_path / "photonfarm.toml"
    file.write_text('out = "all"\n[report]\nstore = "mine"\n[scene.plan]\nseconds = 9.0\n')
    assert run("--config", str(file), "report").output == "report mine run\n"
    assert run("--config", str(file), "scene", "plan").output == "plan all 9\n"


@click.command()
@click.option("--out", default="out")
def starting(out: str) -> None:
    """Start another verb."""
    done = subprocess.run(command("scene", "show", out), capture_output=True, text=True, check=False)
    click.echo(f"{done.returncode}: {done.stdout}{done.stderr}")


def test_verbs_that_a_verb_starts_read_the_configuration_file_that_it_was_given(
    install: Install, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    install("report")
    monkeypatch.setattr(EntryPoint, "load", lambda _: starting)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text("[report]\nout = 'room'\n[scene.show]\njson = true\n")
    monkeypatch.setattr("photonfarm.cli.main.file_defaults", lambda *_: {"report": {"out": "room"}})
    result = run("--config", "mine.toml", "report")
    assert result.output.startswith('0: {\n  "scene_id"'), result.output
    assert "PHOTONFARM_CONFIG" not in os.environ
