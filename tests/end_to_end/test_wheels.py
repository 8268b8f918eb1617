"""Wheels of the three distributions, installed outside the checkout, hold all that they need to run."""

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECTS = ("shared", "services/renderer", "services/trainer")
EDITABLE = ("photonfarm", "__editable__")


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with the wheels, and with the libraries of this one but for this checkout."""
    folder = tmp_path_factory.mktemp("wheels")
    for project in PROJECTS:  # built from a copy, as setuptools leaves files beside what it builds
        shutil.copytree(ROOT / project, folder / project, ignore=shutil.ignore_patterns("*.egg-info", "build"))
    wheel = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*wheel, "--wheel-dir", folder / "dist", *(folder / project for project in PROJECTS)], check=True)
    venv.create(folder / "environment", symlinks=True)
    made = folder / "environment/bin/python"
    own = folder / "environment/lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    libraries = folder / "libraries"
    libraries.mkdir()
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if not path.name.startswith(EDITABLE):
            (libraries / path.name).symlink_to(path)
    (own / "libraries.pth").write_text(f"{libraries}\n")
    wheels = sorted((folder / "dist").glob("*.whl"))
    assert len(wheels) == len(PROJECTS)
    install = [sys.executable, "-m", "pip", "--python", made, "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*install, *wheels], check=True)
    return made


def run(python: Path, folder: Path, *arguments: str) -> str:
    done = subprocess.run([python, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_installed_packages_are_those_of_the_wheels(python: Path, tmp_path: Path) -> None:
    code = "from photonfarm import data, renderer, trainer; print(data.__file__, renderer.__file__, trainer.__file__)"
    files = run(python, tmp_path, "-c", code).split()
    assert len(files) == 3
    assert not any(file.startswith(str(ROOT)) for file in files)


def test_every_verb_and_the_ready_specs_are_there(python: Path, tmp_path: Path) -> None:
    listed = run(python, tmp_path, "-m", "photonfarm.shared.cli", "--help")
    for verb in ("submit", "up", "work", "preview", "render", "train", "evaluate", "report", "store", "export", "web"):
        assert f"\n  {verb} " in listed
        run(python, tmp_path, "-m", "photonfarm.shared.cli", verb, "--help")
    assert "cornell" in run(python, tmp_path, "-m", "photonfarm.shared.cli", "scene", "show", "cornell")
    assert (python.parent / "photonfarm").is_file()
    script = "from photonfarm.web.server import STATIC; print((STATIC / 'app.js').is_file())"
    assert run(python, tmp_path, "-c", script).split() == ["True"]


def test_an_installed_farm_plans_and_renders_a_sample(python: Path, tmp_path: Path) -> None:
    command = ("-m", "photonfarm.shared.cli")
    run(python, tmp_path, *command, "submit", "cornell", "--modifications", "1", "--views", "1", "--no-queue")
    run(python, tmp_path, *command, "work", "--scene", "cornell", "--job", "0")
    code = "from photonfarm.data import open_scene; print(open_scene('store', 'cornell')[0].radiance.shape)"
    assert run(python, tmp_path, "-c", code) == "(2, 64, 64, 3)\n"
