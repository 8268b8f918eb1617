"""The wheel, installed outside the checkout, holds all that it needs to run."""

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ("pyproject.toml", "README.md", "LICENSE", "shared", "services")
EDITABLE = ("photonfarm", "__editable__")


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with the wheels, and with the libraries of this one but for this checkout."""
    folder = tmp_path_factory.mktemp("wheels")
    copy = folder / "copy"  # as setuptools leaves files beside what it builds
    copy.mkdir()
    for part in (ROOT / name for name in PARTS):
        if part.is_dir():
            shutil.copytree(part, copy / part.name, ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
        else:
            shutil.copy(part, copy)
    wheel = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*wheel, "--wheel-dir", folder / "dist", copy], check=True)
    venv.create(folder / "environment", symlinks=True)
    made = folder / "environment/bin/python"
    own = folder / "environment/lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    libraries = folder / "libraries"
    libraries.mkdir()
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if not path.name.startswith(EDITABLE):
            (libraries / path.name).symlink_to(path)
    (own / "libraries.pth").write_text(f"{libraries}\n")
    (wheel_file,) = (folder / "dist").glob("*.whl")
    install = [sys.executable, "-m", "pip", "--python", made, "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*install, wheel_file], check=True)
    return made


def run(python: Path, folder: Path, *arguments: str) -> str:
    done = subprocess.run([python, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_installed_packages_are_those_of_the_wheel(python: Path, tmp_path: Path) -> None:
    code = "from photonfarm import data, renderer, trainer; print(data.__file__, renderer.__file__, trainer.__file__)"
    files = run(python, tmp_path, "-c", code).split()
    assert len(files) == 3
    assert not any(file.startswith(str(ROOT)) for file in files)


def test_every_verb_and_the_ready_specs_are_there(python: Path, tmp_path: Path) -> None:
    listed = run(python, tmp_path, "-m", "photonfarm.cli", "--help")
    for verb in ("submit", "up", "work", "preview", "render", "train", "evaluate", "report", "store", "export", "web"):
        assert f"\n  {verb} " in listed
        run(python, tmp_path, "-m", "photonfarm.cli", verb, "--help")
    assert "cornell" in run(python, tmp_path, "-m", "photonfarm.cli", "scene", "show", "cornell")
    assert (python.parent / "photonfarm").is_file()
    script = "from photonfarm.web.server import STATIC; print((STATIC / 'app.js').is_file())"
    assert run(python, tmp_path, "-c", script).split() == ["True"]


def test_an_installed_farm_plans_and_renders_a_sample(python: Path, tmp_path: Path) -> None:
    command = ("-m", "photonfarm.cli")
    run(python, tmp_path, *command, "submit", "cornell", "--modifications", "1", "--views", "1", "--no-queue")
    run(python, tmp_path, *command, "work", "--scene", "cornell", "--job", "0")
    code = "from photonfarm.data import open_scene; print(open_scene('store', 'cornell')[0].radiance.shape)"
    assert run(python, tmp_path, "-c", code) == "(2, 64, 64, 3)\n"
