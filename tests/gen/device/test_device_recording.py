"""Recorded kernels while Python collects garbage, in a child process: what this is about ends the process."""

from __future__ import annotations

import gc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rstrack_util import ENGINE

from rsgen.device.arrays import recorded

ROOT = Path(__file__).parents[3]

CODE = """
import gc
import sys
import drjit as dr
import numpy as np
from rsgen.device.arrays import engine
from rsgen.device.arrays import recorded

e = engine("llvm")
freeze = {"recorded": recorded, "freeze": dr.freeze}[sys.argv[1]]


class Cycle:
    def __init__(self):
        self.cycle, self.array = self, e.Float(np.arange(1000, dtype=np.float32))


@freeze
def kernel(x):
    made = [[] for _ in range(5000)]  # enough objects for a collection
    return x + dr.sqrt(x)


x = e.Float(np.arange(3, dtype=np.float32))
gc.collect()
gc.set_threshold(2000, 1, 1)
Cycle()
first = kernel(x).numpy()
print((first == kernel(x).numpy()).all(), gc.isenabled())
"""


@pytest.mark.parametrize(("decorator", "status"), [("recorded", 0), ("freeze", -6)])
def test_garbage_is_not_collected_while_a_kernel_is_traced(decorator: str, status: int) -> None:
    # With Dr.Jit's own decorator it dies; once it does not, ours has no reason to be.
    done = subprocess.run([sys.executable, "-c", CODE, decorator], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    assert "cannot be recorded" in done.stderr if status else done.stdout == "True True\n"


def test_the_collector_is_left_as_it_was_found() -> None:
    meanwhile = []

    @recorded
    def broken(x: object) -> object:
        meanwhile.append(gc.isenabled())
        raise ValueError("no")

    for found in (True, False):
        (gc.enable if found else gc.disable)()
        try:
            with pytest.raises((ValueError, RuntimeError)):
                broken(ENGINE.upload(np.ones(3)))
            assert gc.isenabled() == found
        finally:
            gc.enable()
    assert meanwhile == [False, False]
