import os
import platform
import subprocess
import sys
from pathlib import Path

import nvidia_driver
import pytest

from photonfarm.core.errors import BackendError
from photonfarm.renderer.scene import backend, native

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


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the feature is one of x86-64")
def test_a_kernel_with_gather_instructions_has_the_same_bits() -> None:
    code = """
import os
import drjit as dr
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene import native

mi = backend.load(1)

def gather():
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        i = dr.arange(mi.UInt32, 1001)
        table = dr.sqrt(mi.Float(i))
        dr.eval(i, table)
        values = dr.gather(mi.Float, table, (i * 7919) % 1001, i % 3 > 0)
        dr.eval(values)
        return list(values), [kernel["ir"].getvalue() for kernel in dr.kernel_history() if "ir" in kernel][-1]

before, _ = gather()
os.environ[native.GATHERS_VARIABLE] = "1"
native.use_gathers_if_asked()
after, kernel = gather()
print(before == after, native.FEATURE in kernel, native.target()[1].count(native.FEATURE))
"""
    done = run(code)
    assert done.stdout.split() == ["True", "True", "1"], done.stderr


def test_a_dr_jit_without_the_functions_renders_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "_SET", "no_such_function")
    assert backend.load(1).variant() == backend.DEFAULT_VARIANT
    assert native.target() == ("", "")


def test_a_wish_for_gather_instructions_that_is_neither_0_nor_1_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(native.GATHERS_VARIABLE, "yes")
    with pytest.raises(BackendError, match=r"PHOTONFARM_GATHERS is 'yes'; 0 and 1 are allowed"):
        backend.load(1)


def test_a_libllvm_that_is_not_there_is_one_sentence_that_says_what_to_install() -> None:
    done = run(LOAD, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert "BackendError: DRJIT_LIBLLVM_PATH = '/nowhere/libLLVM.so'" in last
    assert "libllvm19" in last


def test_an_unknown_variant_is_refused_with_those_that_exist() -> None:
    done = run(LOAD, PHOTONFARM_VARIANT="llvm_rgb")
    assert "BackendError: PHOTONFARM_VARIANT = 'llvm_rgb'" in done.stderr
    assert "llvm_ad_rgb" in done.stderr


def test_a_variant_that_the_integrator_cannot_use_is_refused() -> None:
    done = run(LOAD, PHOTONFARM_VARIANT="scalar_rgb")
    assert "BackendError: photonfarm.renderer.bdpt" in done.stderr


def test_a_variant_of_another_device_than_the_one_named_is_refused() -> None:
    for device, variant in (("cpu", "cuda_ad_rgb"), ("cuda", "llvm_ad_rgb")):
        done = run(LOAD, PHOTONFARM_DEVICE=device, PHOTONFARM_VARIANT=variant)
        assert f"BackendError: PHOTONFARM_VARIANT = {variant!r}" in done.stderr


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
