import os
import re
import subprocess
import sys
from pathlib import Path

import nvidia_driver
import pytest

from photonfarm.core.errors import BackendError
from photonfarm.renderer.scene import backend

LOAD = "from photonfarm.renderer.scene import backend; print(backend.load(1).variant())"


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, **environment}
    )


def library(root: Path, name: str) -> Path:
    path = root / "lib" / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"no library")
    return path


def test_mitsuba_is_loaded_with_the_plugin_registered() -> None:
    mi = backend.load(1)
    assert mi.variant() == backend.DEFAULT_VARIANT
    assert mi.load_dict({"type": "bdpt"}).class_name()
    assert backend.load() is mi


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        (
            {"DRJIT_LIBLLVM_PATH": "/nowhere/libLLVM.so"},
            "BackendError: DRJIT_LIBLLVM_PATH = '/nowhere/libLLVM.so' .* 19",
        ),
        ({"PHOTONFARM_VARIANT": "llvm_rgb"}, "BackendError: PHOTONFARM_VARIANT = 'llvm_rgb' .* known: .*llvm_ad_rgb"),
        ({"PHOTONFARM_VARIANT": "scalar_rgb"}, r"BackendError: photonfarm\.renderer\.bdpt"),
        (
            {"PHOTONFARM_DEVICE": "cpu", "PHOTONFARM_VARIANT": "cuda_ad_rgb"},
            "BackendError: PHOTONFARM_VARIANT = 'cuda_ad_rgb'",
        ),
        (
            {"PHOTONFARM_DEVICE": "cuda", "PHOTONFARM_VARIANT": "llvm_ad_rgb"},
            "BackendError: PHOTONFARM_VARIANT = 'llvm_ad_rgb'",
        ),
    ],
)
def test_what_cannot_render_is_refused_in_one_sentence(environment: dict[str, str], said: str) -> None:
    """A libLLVM that is not there, variants that do not exist or that the integrator or the device cannot use."""
    done = run(LOAD, **environment)
    assert done.returncode == 1
    assert re.search(said, done.stderr.strip().splitlines()[-1])


def test_one_card_is_shown_to_mitsuba_and_llvm_is_not_looked_for(tmp_path: Path) -> None:
    """With a driver that lists cards and can do nothing else, so that Mitsuba refuses it in the end."""
    code = """
import os
from photonfarm.renderer.scene import backend
from photonfarm.core.errors import BackendError
found = backend.device()
print(found.variant, found.name, found.card.number, backend.paths_at_once())
try:
    backend.load(1)
except BackendError as error:
    print(error)
print(os.environ["CUDA_VISIBLE_DEVICES"], os.environ["CUDA_DEVICE_ORDER"])
"""
    driver = str(nvidia_driver.made(tmp_path))
    libraries = {"DRJIT_LIBCUDA_PATH": driver, "DRJIT_LIBOPTIX_PATH": driver, "DRJIT_LIBLLVM_PATH": "/nowhere"}
    done = run(code, PHOTONFARM_DEVICE="cuda:1", CUDA_VISIBLE_DEVICES="4,6", **libraries)
    chosen, refused, shown = done.stdout.splitlines()
    assert (chosen, shown) == ("cuda_ad_rgb Test Card B 1 11184810", "6 PCI_BUS_ID")
    assert "'cuda_ad_rgb' cannot be used here" in refused


def test_versions_that_crash_are_not_chosen_unasked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(backend.LLVM_VARIABLE, raising=False)
    for name in ("libLLVM-15.so", "libLLVM-16.so", "libLLVM.so.16.0", "libLLVM.so.190"):
        library(tmp_path, name)
    with pytest.raises(BackendError, match="libllvm19"):
        backend.find_llvm([tmp_path])


@pytest.mark.parametrize(
    "name", ["libLLVM-19.so", "libLLVM.so.19.1", "libLLVM-19.so.1", "libLLVM-22.so", "libLLVM.so.22.1"]
)
def test_versions_that_work_are_found_by_each_of_their_names(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(backend.LLVM_VARIABLE, raising=False)
    found = library(tmp_path, name)
    with pytest.raises(BackendError, match=str(found)):  # as it is no library, but it was looked at
        backend.find_llvm([tmp_path])


def test_dr_jit_without_libatomic_is_explained(tmp_path: Path) -> None:
    (tmp_path / "drjit").mkdir()
    (tmp_path / "drjit/__init__.py").write_text("detail.missing\n")  # what `import drjit` comes to without libatomic
    done = run(f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {LOAD}")
    assert "BackendError" in done.stderr
    assert "libatomic1" in done.stderr
