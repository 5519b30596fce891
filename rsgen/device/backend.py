"""Choose Dr.Jit's backend once, before anything imports Dr.Jit or Mitsuba.

Dr.Jit loads libLLVM at run time from wherever it finds one first. LLVM 14 and older it refuses, and LLVM 15 and 16
abort the whole process on AVX-512 machines ("Cannot select: fminimum"), so a version of at least 17 is picked here by
its own word (`LLVMGetVersion`) and handed over in `DRJIT_LIBLLVM_PATH`. LLVM 19 comes first: it was the fastest
measured.
"""

from __future__ import annotations

import ctypes
import glob
import os
import subprocess
import sys
from typing import Literal

from rsgen.errors import UserError

Backend = Literal["auto", "llvm", "cuda"]
VARIANTS = {"llvm": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}

MINIMUM_LLVM = 17
PREFERRED_LLVM = 19
_SEARCH = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)
_NO_LLVM = (
    "no libLLVM of version 17 or newer was found: install one (Debian/Ubuntu: 'sudo apt-get install libllvm19', "
    "Fedora: 'sudo dnf install llvm-libs', macOS: 'brew install llvm'), or name it in DRJIT_LIBLLVM_PATH"
)

# Printed by a child process, so that a bad library can only kill the child.
_PROBE = """
import ctypes, sys
a = [ctypes.c_uint() for _ in range(3)]
ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, a))
print(a[0].value)
"""


def llvm_version(path: str) -> int | None:
    """Major version of the libLLVM at `path`, asked of the library itself in a child process; None if it has none."""
    try:
        child = subprocess.run([sys.executable, "-c", _PROBE, path], capture_output=True, text=True, timeout=60)
        return int(child.stdout) if child.returncode == 0 else None
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None


def find_libllvm() -> str:
    """Path of a libLLVM that Dr.Jit can use: the user's DRJIT_LIBLLVM_PATH if set, else the best one installed.

    Raises UserError if the named one is unusable or none is installed.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        version = llvm_version(named)
        if version is None or version < MINIMUM_LLVM:
            what = "no usable libLLVM" if version is None else f"LLVM {version}"
            raise UserError(
                f"DRJIT_LIBLLVM_PATH={named} is {what}, version {MINIMUM_LLVM} or newer is needed: "
                "unset it or name another library"
            )
        return named
    paths = {os.path.realpath(path) for pattern in _SEARCH for path in glob.glob(pattern)}  # noqa: PTH207
    versions = {path: llvm_version(path) for path in sorted(paths)}
    usable = {path: v for path, v in versions.items() if v is not None and v >= MINIMUM_LLVM}
    if not usable:
        raise UserError(_NO_LLVM)
    return min(usable, key=lambda path: (usable[path] != PREFERRED_LLVM, -usable[path]))


def has_cuda() -> bool:
    """Whether the NVIDIA driver loads and counts at least one device (no Dr.Jit involved)."""
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return cuda.cuInit(0) == 0 and cuda.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


def select(backend: Backend = "auto") -> str:
    """Prepare the environment for `backend` and return Mitsuba's variant name. Call before importing Dr.Jit/Mitsuba.

    `auto` takes CUDA where a device answers, else LLVM. Raises UserError in one sentence if the choice cannot work.
    """
    if backend not in ("auto", *VARIANTS):
        raise UserError(f"unknown backend '{backend}': choose auto, llvm or cuda")
    if backend == "cuda" and not has_cuda():
        raise UserError("backend 'cuda' was asked for but no NVIDIA driver with a device answers: use llvm or auto")
    if backend == "cuda" or (backend == "auto" and has_cuda()):
        return VARIANTS["cuda"]
    os.environ["DRJIT_LIBLLVM_PATH"] = find_libllvm()
    return VARIANTS["llvm"]


def mitsuba(backend: Backend = "auto"):
    """Import Mitsuba with `backend` selected and return the module; later calls must name the same backend or auto."""
    loaded = sys.modules.get("mitsuba")
    if loaded is not None and loaded.variant() is not None:
        wanted = VARIANTS.get(backend)
        if wanted is not None and loaded.variant() != wanted:
            raise UserError(f"backend '{backend}' was asked for but this process already runs {loaded.variant()}")
        return loaded
    variant = select(backend)
    import mitsuba as mi

    mi.set_variant(variant)
    return mi


if __name__ == "__main__":  # run.sh asks: is there a backend that works?
    try:
        print(select())
    except UserError as error:
        sys.exit(f"rsgen: {error}")
