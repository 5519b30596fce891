"""What `import rsgen` and `import rstrack` offer, what it costs, and the programs as modules."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import rsgen
import rstrack

ROOT = Path(__file__).parents[1]
HEAVY = ("mitsuba", "drjit", "numpy", "scipy", "pydantic")


def python(*words: str) -> str:
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def loaded(code: str) -> set[str]:
    """Which of HEAVY a fresh interpreter has loaded after these statements."""
    return set(python("-c", f"{code}; import sys; print(*({set(HEAVY)!r} & set(sys.modules)))").split())


@pytest.mark.parametrize("package", ["rsgen", "rstrack"])
def test_importing_a_package_costs_nothing(package: str) -> None:
    assert loaded(f"import {package}; dir({package})") == set()


def test_what_needs_no_engine_loads_none() -> None:
    light = "from rsgen import Camera, Shutter, Spline, read_sequence; from rstrack import Frame, Image, Options, Rig"
    assert not loaded(light) & {"mitsuba", "drjit"}


def test_the_tracker_loads_no_mitsuba_and_has_its_llvm_chosen() -> None:
    chosen = "os.environ.get('DRJIT_LIBLLVM_PATH') or has_cuda()"
    code = f"import os; from rstrack import Tracker; from rsgen.device.backend import has_cuda; assert {chosen}"
    assert "mitsuba" not in loaded(code)


def test_the_sensor_comes_with_an_active_variant() -> None:
    code = "from rsgen import RollingShutterSensor as S; import mitsuba; print(issubclass(S, mitsuba.Sensor))"
    assert python("-c", code) == "True"


@pytest.mark.parametrize("package", [rsgen, rstrack])
def test_every_name_is_there_and_no_other(package: object) -> None:
    for name in package.__all__:  # type: ignore[attr-defined]
        assert getattr(package, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'Trakcer'"):
        package.Trakcer  # type: ignore[attr-defined] # noqa: B018


@pytest.mark.parametrize("program", ["rsgen", "rstrack"])
def test_a_program_runs_as_a_module(program: str) -> None:
    assert python("-m", program, "--help").startswith(f"usage: {program} [-h]")
