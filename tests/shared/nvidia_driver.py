"""A library with the functions of NVIDIA's driver that list cards, for machines without a driver."""

import shutil
import subprocess
from pathlib import Path

import pytest

DRIVER = r"""
#include <stdlib.h>
#include <string.h>
static int number(const char *name, int otherwise) { return getenv(name) ? atoi(getenv(name)) : otherwise; }
int cuInit(unsigned flags) { return number("TEST_INIT", 0); }
int cuGetErrorString(int code, const char **said) { *said = code == 100 ? "no CUDA-capable device" : NULL; return 0; }
int cuDriverGetVersion(int *version) { *version = number("TEST_CUDA", 12080); return 0; }
int cuDeviceGetCount(int *count) { *count = number("TEST_CARDS", 2); return 0; }
int cuDeviceGet(int *device, int ordinal) { *device = 7 + ordinal; return 0; }
int cuDeviceGetName(char *name, int length, int device) {
    strcpy(name, "Test Card A"); name[10] += device - 7; return 0;
}
int cuDeviceTotalMem_v2(size_t *bytes, int device) { *bytes = (size_t) 8 << 30; return 0; }
int cuDeviceGetAttribute(int *value, int attribute, int device) { *value = attribute == 75 ? 8 : 9; return 0; }
"""


def made(folder: Path) -> Path:
    """The library, compiled in a folder; what it says, variables change. It skips without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler, of which a driver is made")
    (folder / "driver.c").write_text(DRIVER)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", folder / "driver.so", folder / "driver.c"], check=True)
    return folder / "driver.so"
