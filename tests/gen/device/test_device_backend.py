"""The choice of a libLLVM: by the library's own word, best first, never one that would take the process down."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rsgen.device import backend
from rsgen.errors import UserError

ROOT = Path(__file__).parents[3]


def library(folder: Path, version: int) -> Path:
    """A shared library whose LLVMGetVersion says `version`."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler to make a stand-in libLLVM with")
    source = folder / f"llvm{version}.c"
    source.write_text(
        f"void LLVMGetVersion(unsigned *a, unsigned *b, unsigned *c) {{ *a = {version}; *b = *c = 0; }}\n"
    )
    target = folder / f"libLLVM-{version}.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", target, source], check=True)
    return target


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Pretend that exactly these libraries are installed, given as {file name: what it says its version is}."""

    def install(versions: dict[str, int | None]) -> Path:
        known = {}
        for name, version in versions.items():
            (tmp_path / name).touch()
            known[str(tmp_path / name)] = version
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "")  # so that it is put back, however `select` leaves it
        monkeypatch.delenv("DRJIT_LIBLLVM_PATH")
        monkeypatch.setattr(backend, "_SEARCH", (str(tmp_path / "libLLVM*"), "/nowhere/at/all/*"))
        monkeypatch.setattr(backend, "llvm_version", lambda path: known[path])
        return tmp_path

    return install


# --- probing ---------------------------------------------------------------------------------------------------------


def test_a_library_is_asked_for_its_version(tmp_path: Path) -> None:
    assert backend.llvm_version(str(library(tmp_path, 17))) == 17


def test_what_is_no_libllvm_has_no_version(tmp_path: Path) -> None:
    text = tmp_path / "libLLVM-19.so"
    text.write_text("not a library")
    assert backend.llvm_version(str(text)) is None
    assert backend.llvm_version(str(tmp_path / "nowhere.so")) is None
    assert backend.llvm_version("libc.so.6") is None  # loads, but without LLVMGetVersion


def test_a_library_that_kills_its_process_kills_only_the_child(tmp_path: Path) -> None:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler to make a stand-in libLLVM with")
    (tmp_path / "bad.c").write_text("#include <stdlib.h>\n__attribute__((constructor)) static void f() { abort(); }\n")
    subprocess.run([compiler, "-shared", "-fPIC", "-o", tmp_path / "bad.so", tmp_path / "bad.c"], check=True)
    assert backend.llvm_version(str(tmp_path / "bad.so")) is None


def test_a_library_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(*_: object, timeout: float, **__: object) -> None:
        raise subprocess.TimeoutExpired("probe", timeout)

    monkeypatch.setattr(subprocess, "run", hang)
    assert backend.llvm_version("libLLVM.so") is None


# --- choosing --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("versions", "chosen"),
    [
        ({"libLLVM.so": 19}, "libLLVM.so"),
        ({"libLLVM-22.so": 22, "libLLVM-19.so": 19, "libLLVM-17.so": 17}, "libLLVM-19.so"),  # the fastest
        ({"libLLVM-16.so": 16, "libLLVM-18.so": 18, "libLLVM-17.so": 17}, "libLLVM-18.so"),  # else the newest
        ({"libLLVM-16.so": 16, "libLLVM-14.so": 14, "libLLVM-17.so": 17}, "libLLVM-17.so"),
        ({"libLLVM-19.so": 15, "libLLVM-9.so": 20}, "libLLVM-9.so"),  # names may lie
        ({"libLLVM-19.so": None, "libLLVM-20.so": 20}, "libLLVM-20.so"),  # broken ones are passed over
    ],
)
def test_the_best_installed_one_is_chosen(installed, versions: dict[str, int | None], chosen: str) -> None:
    folder = installed(versions)
    assert backend.find_libllvm() == str(folder / chosen)


def test_links_to_one_library_are_asked_once(installed, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = installed({"libLLVM-19.so.1": 19})
    (folder / "libLLVM.so").symlink_to("libLLVM-19.so.1")
    (folder / "libLLVM-19.so").symlink_to("libLLVM-19.so.1")
    asked: list[str] = []
    monkeypatch.setattr(backend, "llvm_version", lambda path: asked.append(path) or 19)
    assert backend.find_libllvm() == str(folder / "libLLVM-19.so.1") and len(asked) == 1


@pytest.mark.parametrize("versions", [{}, {"libLLVM-16.so": 16}, {"libLLVM-14.so": 14, "libLLVM.so": None}])
def test_without_a_usable_one_a_sentence_says_what_to_do(installed, versions: dict[str, int | None]) -> None:
    installed(versions)
    with pytest.raises(UserError) as error:
        backend.select("llvm")
    text = str(error.value)
    assert "\n" not in text and "17 or newer" in text and "apt-get install libllvm19" in text
    assert "DRJIT_LIBLLVM_PATH" in text and "DRJIT_LIBLLVM_PATH" not in os.environ


@pytest.mark.parametrize("version", [16, 14, None])
def test_an_unusable_one_is_refused_even_if_named(
    installed, monkeypatch: pytest.MonkeyPatch, version: int | None
) -> None:
    folder = installed({"libLLVM-19.so": 19, "mine.so": version})
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(folder / "mine.so"))
    with pytest.raises(UserError, match=r"DRJIT_LIBLLVM_PATH=.*mine\.so is .*17 or newer") as error:
        backend.select("llvm")
    assert (f"LLVM {version}" if version else "no usable libLLVM") in str(error.value)


def test_a_usable_one_that_is_named_is_taken(installed, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = installed({"libLLVM-19.so": 19, "mine.so": 17})
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(folder / "mine.so"))
    assert backend.select("llvm") == "llvm_ad_rgb"
    assert os.environ["DRJIT_LIBLLVM_PATH"] == str(folder / "mine.so")


def test_auto_takes_cuda_where_a_device_answers_and_llvm_elsewhere(installed, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = installed({"libLLVM-19.so": 19})
    monkeypatch.setattr(backend, "has_cuda", lambda: True)
    assert backend.select("auto") == backend.select("cuda") == "cuda_ad_rgb"
    assert "DRJIT_LIBLLVM_PATH" not in os.environ
    monkeypatch.setattr(backend, "has_cuda", lambda: False)
    assert backend.select("auto") == "llvm_ad_rgb"
    assert os.environ["DRJIT_LIBLLVM_PATH"] == str(folder / "libLLVM-19.so")


def test_cuda_without_a_driver_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(backend.ctypes, "CDLL", absent)
    assert not backend.has_cuda()
    with pytest.raises(UserError, match="no NVIDIA driver"):
        backend.select("cuda")


@pytest.mark.parametrize(("results", "expected"), [((0, 0, 1), True), ((0, 0, 0), False), ((3, 0, 1), False)])
def test_a_driver_counts_only_with_a_device(
    monkeypatch: pytest.MonkeyPatch, results: tuple[int, int, int], expected: bool
) -> None:
    init, counted, devices = results

    class Driver:
        def cuInit(self, _: int) -> int:
            return init

        def cuDeviceGetCount(self, pointer: object) -> int:
            pointer._obj.value = devices  # type: ignore[attr-defined]
            return counted

    monkeypatch.setattr(backend.ctypes, "CDLL", lambda _: Driver())
    assert backend.has_cuda() is expected


def test_an_unknown_backend_is_refused() -> None:
    with pytest.raises(UserError, match="'metal': choose auto, llvm or cuda"):
        backend.select("metal")  # type: ignore[arg-type]


# --- in a process of its own -----------------------------------------------------------------------------------------


def child(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, env=os.environ | environment
    )


def test_drjit_is_not_loaded_before_the_environment_is_set() -> None:
    code = """
import os, sys
from rsgen.device import backend
os.environ.pop("DRJIT_LIBLLVM_PATH", None)
backend.has_cuda = lambda: False
assert backend.select("auto") == "llvm_ad_rgb"
assert not {"drjit", "mitsuba"} & set(sys.modules), "loaded by selecting"
path = os.environ["DRJIT_LIBLLVM_PATH"]
seen = {}
class Watch:
    def find_spec(self, name, *_):
        if name in ("drjit", "mitsuba"):
            seen.setdefault(name, os.environ.get("DRJIT_LIBLLVM_PATH"))
sys.meta_path.insert(0, Watch())
del os.environ["DRJIT_LIBLLVM_PATH"]
mi = backend.mitsuba("llvm")
assert seen == {"drjit": path, "mitsuba": path}, seen
assert mi.variant() == "llvm_ad_rgb" and backend.mitsuba("auto") is mi
import drjit as dr
assert dr.sum(dr.arange(mi.Float, 5))[0] == 10  # it compiles and runs
try:
    backend.mitsuba("cuda")
except backend.UserError as error:
    print(error)
"""
    done = child(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "backend 'cuda' was asked for but this process already runs llvm_ad_rgb\n"


def test_the_module_tells_run_sh_what_works(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "rsgen.device.backend"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() in backend.VARIANTS.values()
    bad = os.environ | {"DRJIT_LIBLLVM_PATH": str(library(tmp_path, 15)), "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env=bad)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("rsgen: ") and "is LLVM 15" in done.stderr
